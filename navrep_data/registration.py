"""The gymnasium ids of the environments, as strings: nothing else is loaded before somebody makes one.

``gymnasium.make("navrep_data:NavRepTest-v0")`` imports this package, whose ``__init__`` calls :func:`register_soon`;
``import navrep_data`` beside ``import gymnasium`` does the same, in either order and without importing gymnasium.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Collection
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import Any

VERSION = 0
# words that are spelt otherwise than by capitals alone
_SPELLED = {"navrep": "NavRep", "soadrl": "SOADRL", "cadrl": "CADRL", "ian": "IAN", "crowdmove": "CrowdMove"}

ENVIRONMENTS = (
    "cadrl",
    *(f"crowdmove-{k}" for k in range(1, 7)),
    "empty",
    "ian",
    "map",
    *("mark-test-1", "mark-test-2", "mark-train-1", "mark-train-2"),
    *("navrep-test", "navrep-train", "navrep-val"),
    "soadrl",
)
"""Names of the environments, as in :func:`navrep_data.sim.environment_names`; listed here because that loads numba."""


def plain(name: str) -> str:
    """Return a name of an environment or suite without what its spellings differ in.

    ``navrep-test``, ``navreptest``, ``NavRepTest-v0`` and ``navrep_data:NavRepTest-v0`` are one name: the package
    before it, the version behind it, capitals, hyphens and underscores do not count.
    """
    bare = name.removeprefix("navrep_data:").lower()
    bare = bare.removesuffix(f"-v{VERSION}")
    return bare.replace("-", "").replace("_", "")


def spelled(name: object, known: Collection[str]) -> str | None:
    """Return which of the `known` names is meant in whatever spelling, None where none is.

    Parameters
    ----------
    name : str
        As somebody typed it, see :func:`plain`.
    known : collection of str
        Names in the spelling that is stored.
    """
    if not isinstance(name, str):
        return None
    return next((one for one in known if one == name), None) or next(
        (one for one in known if plain(one) == plain(name)), None
    )


def camel_case(name: str) -> str:
    """Return a kebab-case name in CamelCase, as gymnasium spells ids: ``mark-train-1`` -> ``MarkTrain1``."""
    return "".join(_SPELLED.get(word, word.capitalize()) for word in name.split("-"))


def register() -> None:
    """Register all environments with gymnasium, as strings; those that are registered stay as they are."""
    from gymnasium.envs import registration

    for env in ENVIRONMENTS:
        name = f"{camel_case(env)}-v{VERSION}"
        if name not in registration.registry:
            registration.register(
                id=name,
                entry_point="navrep_data.envs:NavRepEnv",
                vector_entry_point="navrep_data.envs:NavRepVectorEnv",
                kwargs={"env": env},
            )


def register_soon() -> None:
    """Register now where gymnasium is loaded, otherwise as soon as somebody imports it."""
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _WhenGymnasiumComes) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WhenGymnasiumComes())


class _WhenGymnasiumComes(MetaPathFinder):
    """Sits in front of the import system until gymnasium is imported, registers after that, and is gone."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: Any) -> None:
                execute(module)
                register()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
