"""The gymnasium ids of the environments, as strings: nothing else is loaded before somebody makes one.

``gymnasium.make("navrep_data:NavRepTest-v0")`` imports this package, whose ``__init__`` calls :func:`register_soon`;
``import navrep_data`` beside ``import gymnasium`` does the same, in either order and without importing gymnasium.
"""

from __future__ import annotations

import importlib.util
import sys
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


_SQUASHED = {name.replace("-", ""): name for name in ENVIRONMENTS}


def camel_case(name: str) -> str:
    """Return a kebab-case name in CamelCase, as gymnasium spells ids: ``mark-train-1`` -> ``MarkTrain1``."""
    return "".join(_SPELLED.get(word, word.capitalize()) for word in name.split("-"))


def environment_of(name: str) -> str:
    """Return an environment's name however it is spelt: ``NavRepTest-v0``, ``navreptest`` -> ``navrep-test``.

    A name that is none is returned as it is.
    """
    bare = name.rpartition(":")[2].removesuffix(f"-v{VERSION}")
    return _SQUASHED.get(bare.replace("-", "").replace("_", "").lower(), name)


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
