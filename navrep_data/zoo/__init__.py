"""Every released checkpoint by name: list, fetch, check and load.

Notes
-----
Listing and fetching are light; torch is imported when something is loaded.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from navrep_data.io import HUB_SCHEME, is_path
from navrep_data.sb3_file import ORIGIN
from navrep_data.zoo import fetching as _fetching
from navrep_data.zoo import folders as _folders
from navrep_data.zoo import registry as _registry
from navrep_data.zoo.fetching import fetch
from navrep_data.zoo.folders import save_policy
from navrep_data.zoo.registry import Record, list_models
from navrep_data.zoo.verification import Check, Report, verify

__all__ = [
    "Check",
    "Record",
    "Report",
    "fetch",
    "list_models",
    "load",
    "load_sb3",
    "push_model",
    "save_policy",
    "show",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name == "push_model":  # needs torch
        from navrep_data.zoo.hub import push_model

        return push_model
    raise AttributeError(f"module 'navrep_data.zoo' has no attribute {name!r}")


def show(name: str) -> Record:
    """Return what is known of a checkpoint, present or not.

    Parameters
    ----------
    name : str
        Full name such as ``transformer_1d_z.20201015``, or a variant.

    Raises
    ------
    UnknownNameError
        If there is no such name, or it fits several runs.
    """
    return _registry.resolve(name)


def load(
    name: str | os.PathLike[str],
    source: str | os.PathLike[str] | None = None,
    inference: str = "deterministic",
    seed: int = 0,
    **options: Any,
) -> Any:
    """Load a checkpoint and everything it needs, resolved and checked as one.

    Parameters
    ----------
    name : str or path-like
        Full name such as ``transformer_1d_z.released``, or a variant (then a line on stderr says whose weights it is);
        ``hf://user/name`` or ``hf://user/name@revision``, put there by ``navrep-data push-model``; or a place on this
        machine: ``./folder`` with a checkpoint or a policy (:func:`save_policy`), ``FILE.safetensors``, a path object.
    source : path-like or str, optional
        Folder, ``https://...`` or ``hf://user/name`` to look in before the cache and the authors' repository.
        Default: ``NAVREP_RELEASED_DIR`` where it is set.
    inference : str
        ``"deterministic"``: no dropout, z = mu, memory starts at zero. ``"as_released"``: memories with the noise
        of the release (dropout, sampled z and a random start), under `seed`. Nothing else is changed by it: ranges are
        cut at the contract's unless `ranges` says otherwise.
    seed : int
        Seed of ``"as_released"``.
    **options
        Passed on: ``dtype``, ``compile``, ``device``; of policies ``ranges``, see
        :class:`navrep_data.zoo.policy.Policy`.

    Returns
    -------
    navrep_data.zoo.policy.Policy or torch.nn.Module
        A policy for names with features and for ``e2e_*``; otherwise a world model, a V or an M. A policy is for the
        robot of its training (1 m/s); ``policy.for_robot(max_speed=0.55, radius=0.3)`` is the same for a slower one.

    Raises
    ------
    UnknownNameError
        If there is no such name, or it fits several runs.
    CorruptDataError, OfflineError, DownloadError, HubError
        If a file is not what it must be, or cannot be had.
    ModelNotFoundError, CheckpointError
        If there is no model in the folder or repository, or it is not one of this package.
    """
    place = _folders.place_of(name)
    if place is not None:
        return _folders.load_folder(place, inference=inference, seed=seed, **options)
    name = os.fspath(name)
    record = _registry.resolve(name)
    where = _fetching.Source.of(source)
    # all files first: a part that cannot be had is told before seconds are spent on torch
    files = {r.name: _fetching.get_files(r, where) for r in _registry.with_parts(record)}
    from navrep_data.zoo.assemble import build

    built: dict[str, Any] = {}
    for r in _registry.with_parts(record):
        if r.name not in built:
            parts = {role: built[part] for role, part in r.parts.items()}
            built[r.name] = build(r.to_dict(), files[r.name], parts, inference=inference, seed=seed, **options)
    return built[record.name]


def load_sb3(name: str, source: str | os.PathLike[str] | None = None, env: Any = None, **options: Any) -> Any:
    """Load a controller as a stable-baselines3 PPO with the same weights, ready to predict and to train on.

    Parameters
    ----------
    name : str
        Name of a policy.
    source : path-like or str, optional
        As for :func:`load`.
    env : str, SimConfig, gymnasium.Env, gymnasium.vector.VectorEnv or VecEnv, optional
        Environment to train in: a name such as ``"navrep-train"``, of which ``n_envs`` worlds (6) are made, or a NavRep
        environment, whose scans the policy's encoder turns into features. Without one the model predicts, until
        ``set_env`` gives it one.
    **options
        Passed on to ``stable_baselines3.PPO``, but for ``n_envs``.

    Returns
    -------
    stable_baselines3.PPO
        Its observations are the controller's features, or the raw vector of end-to-end policies. ``learn`` trains the
        controller alone, not the encoder (of end-to-end policies all); ``save`` and ``load`` are stable-baselines3's.

    Raises
    ------
    ConfigError
        If the environment's observations, actions or sensor are not what the policy takes.
    UnknownNameError, CorruptDataError, OfflineError, DownloadError
        As :func:`load`.
    """
    from navrep_data.zoo.sb3 import to_sb3

    model = to_sb3(load(name, source), env=env, **options)
    place = is_path(name) and not name.startswith(HUB_SCHEME)
    # kept by save as plain text, so that a refusal to open the file can say how its controller comes back
    setattr(model, ORIGIN, str(Path(name).expanduser().absolute()) if place else name)
    return model
