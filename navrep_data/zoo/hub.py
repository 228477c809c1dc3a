"""Models on the Hugging Face Hub: push a checkpoint or a policy, and bring one here."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, CorruptDataError, ModelNotFoundError
from navrep_data.hub import client
from navrep_data.hub.upload import upload
from navrep_data.io import is_offline, json_bytes, parse_repo, read_json, sha256_file
from navrep_data.models import checkpoint
from navrep_data.shards import CARD_FILE, FileEntry
from navrep_data.shards.card import CITATION
from navrep_data.shards.manifest import check_license
from navrep_data.zoo.folders import PART_FOLDERS, POLICY_FILE, is_training, load_folder, read_policy, save_policy

LIST_FILE = "navrep-model.json"
LIST_FORMAT = "navrep-data-model-files"
MAX_MODEL_BYTES = 2 << 30
_MAX_LIST_BYTES = 1 << 20
_NAMES = re.compile(
    rf"(?:({'|'.join(PART_FOLDERS)})/)?({re.escape(checkpoint.WEIGHTS_NAME)}|{re.escape(checkpoint.CONFIG_NAME)})"
    rf"|{re.escape(POLICY_FILE)}"
)


@dataclass(frozen=True)
class PushedModel:
    """What :func:`push_model` did.

    Attributes
    ----------
    repo, revision, commit, url : str
        Where the model is.
    files, bytes : int
        What it has there.
    """

    repo: str
    revision: str
    commit: str
    url: str
    files: int
    bytes: int

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)


def push_model(
    path: str | os.PathLike[str],
    repo: str,
    *,
    license: str | None = None,
    private: bool = False,
    revision: str | None = None,
    message: str | None = None,
    token: str | bool | None = None,
) -> PushedModel:
    """Publish a checkpoint or a policy, loaded and checked first, in one commit.

    Parameters
    ----------
    path : path-like
        Folder with a checkpoint or a policy (:func:`navrep_data.zoo.save_policy`), output folder of a training, or
        ``FILE.safetensors``.
    repo : str
        ``user/name``; made if there is none.
    license : str
        Identifier as on the Hub.
    private, revision, message, token
        As for :func:`navrep_data.datasets.push`.

    Raises
    ------
    ConfigError
        If there is no licence, or the repository's name is none.
    CheckpointError, ModelNotFoundError
        If there is no model at `path`, or it cannot be loaded: nothing is published.
    HubError, OfflineError
        If the Hub refuses or cannot be reached.
    """
    name, branch = parse_repo(repo, revision)
    if license is None:
        raise ConfigError(
            f"{os.fspath(path)} has no licence, expected one to publish it under: --license mit (or other)."
        )
    if problem := check_license(license):
        raise ConfigError(f"{problem[0].upper()}{problem[1:]}.")
    client.require_network(f"push {os.fspath(path)} to {name}")
    path = Path(path)
    loaded = load_folder(path)  # what cannot be loaded is not published
    if is_training(path):
        with tempfile.TemporaryDirectory() as scratch:
            made = Path(scratch) / "policy"
            save_policy(loaded, made, checkpoint.read_config(path)["metadata"])
            return push_model(
                made, repo, license=license, private=private, revision=revision, message=message, token=token
            )
    files: dict[str, bytes | Path] = dict(_files(path))
    entries = {n: FileEntry(n, sha256_file(p), p.stat().st_size) for n, p in files.items() if isinstance(p, Path)}
    listed = {"format": LIST_FORMAT, "files": [asdict(entry) for entry in entries.values()]}
    files[LIST_FILE] = json_bytes(listed)
    files[CARD_FILE] = _card(path, name, license).encode()
    at = upload(
        name,
        "model",
        files,
        entries,
        branch=branch,
        private=private,
        message=message or "A model of navrep-data",
        token=token,
        ours=_NAMES,
    )
    size = sum(entry.bytes for entry in entries.values())
    return PushedModel(name, branch, at.commit, f"{at.endpoint}/{name}", len(files), size)


def _files(path: Path) -> dict[str, Path]:
    """Return the files of a model by their names in a repository."""
    if (path / POLICY_FILE).is_file():
        found = {POLICY_FILE: path / POLICY_FILE}
        for part in read_policy(path)["parts"]:
            found |= {f"{part}/{name}": file for name, file in _files(path / part).items()}
        return found
    weights, config = checkpoint.paths(path)
    return {checkpoint.WEIGHTS_NAME: weights, checkpoint.CONFIG_NAME: config}


def fetch_model(text: str, *, token: str | bool | None = None, progress: bool | None = None) -> Path:
    """Bring a model of the Hub into huggingface_hub's cache, every file checked by its SHA-256.

    Parameters
    ----------
    text : str
        ``hf://user/name`` or ``hf://user/name@revision``.
    token, progress
        As for :func:`navrep_data.datasets.pull`.

    Returns
    -------
    pathlib.Path
        Its folder.

    Raises
    ------
    ModelNotFoundError
        If the repository holds no model that ``push-model`` put there.
    CorruptDataError
        If a file does not have its hash, or names and sizes are not those of a model.
    HubError, OfflineError
        If it cannot be had. Offline, a model that is in the cache is taken.
    """
    at = client.resolve(text, "model", token=token)
    there: Mapping[str, client.RemoteFile] | None = None
    if not is_offline():
        there = client.remote_files(at)
        if LIST_FILE not in there:
            raise ModelNotFoundError(
                f"{at} has no {LIST_FILE}, expected a model that `navrep-data push-model` put there."
            )
        if there[LIST_FILE].bytes > _MAX_LIST_BYTES:
            raise CorruptDataError(
                f"{at} has a {LIST_FILE} of {there[LIST_FILE].bytes:,} bytes, expected at most 1 MiB."
            )
    found: list[Path] = []
    size = there[LIST_FILE].bytes if there is not None else _MAX_LIST_BYTES
    client.bring(
        at,
        [FileEntry(LIST_FILE, "", size)],
        None,
        done=lambda _, path: found.append(path),
        checked=lambda path, entry: path.stat().st_size <= entry.bytes,
        progress=progress,
    )
    wanted = _wanted(at, found[0])
    if there is not None:
        client.check_listed(at, there, wanted)
    client.bring(at, wanted, None, progress=progress)
    return found[0].parent


def _wanted(at: client.Revision, path: Path) -> list[FileEntry]:
    values = read_json(path, _MAX_LIST_BYTES)
    listed = values.get("files") if isinstance(values, dict) and values.get("format") == LIST_FORMAT else None
    if not isinstance(listed, list) or not 1 <= len(listed) <= 1 + 2 * len(PART_FOLDERS):
        raise CorruptDataError(f"{at}: {LIST_FILE} is not a list of a model's files; get another revision.")
    wanted = []
    for entry in listed:
        name, digest, size = (entry.get(k) if isinstance(entry, dict) else None for k in ("file", "sha256", "bytes"))
        if not isinstance(name, str) or not _NAMES.fullmatch(name):
            raise CorruptDataError(f"{at} names a file {str(name)!r}, expected one of a checkpoint or policy.")
        if (
            not isinstance(digest, str)
            or not re.fullmatch(r"[0-9a-f]{64}", digest)
            or type(size) is not int
            or size < 0
        ):
            raise CorruptDataError(f"{at}: {LIST_FILE} has no SHA-256 or size for {name}; get another revision.")
        wanted.append(FileEntry(name, digest, size))
    if sum(entry.bytes for entry in wanted) > MAX_MODEL_BYTES:
        raise CorruptDataError(f"{at} lists more than {MAX_MODEL_BYTES:,} bytes, expected a model of navrep-data.")
    return wanted


def _card(path: Path, repo: str, license: str) -> str:
    """Return the card: what it is, how to load it, what it was trained on."""
    policy = read_policy(path) if (path / POLICY_FILE).is_file() else None
    described = policy or checkpoint.read_config(path)
    metadata = described.get("metadata") or {}
    dataset = metadata.get("dataset") if isinstance(metadata, dict) else None
    kind = "policy" if policy else str(described.get("kind"))
    if policy:
        fields = ("name", "features", "lidar", "context", "parts")
        facts = {key: policy[key] for key in fields}
    else:
        facts = {"kind": kind, **described.get("config", {})}
    task = "reinforcement-learning" if kind in ("policy", "controller", "e2e") else "feature-extraction"
    world_model = " world model" if kind in ("joint", "modular", "transformer") else ""
    lines = [
        "---", f"license: {license}", "library_name: navrep-data", f"pipeline_tag: {task}", "tags:",
        *(f"- {tag}" for tag in ("navrep", "robot-navigation", "lidar", "crowd")), "---", "",
        f"# {repo.split('/')[1]}", "",
        f"A {kind}{world_model} for robots that navigate among people, made with navrep-data: an independent "
        "re-implementation of NavRep (Dugas et al. 2020), not made or endorsed by its authors.", "",
        "```python", "import navrep_data", "", f'model = navrep_data.zoo.load("hf://{repo}")', "```", "",
        "| setting | value |", "|---|---|",
        *(f"| {key} | `{json.dumps(value, ensure_ascii=False)}` |" for key, value in facts.items()), "",
        "## Trained on", "",
    ]  # fmt: skip
    if isinstance(dataset, dict):
        lines += ["| dataset | value |", "|---|---|"]
        lines += [f"| {key} | `{json.dumps(value, ensure_ascii=False)}` |" for key, value in dataset.items()]
    else:
        lines.append("Not recorded.")
    lines += ["", "Weights are safetensors; nothing is unpickled.", "", "## Cite", "", "```bibtex", CITATION, "```", ""]
    return "\n".join(lines)


__all__ = ["LIST_FILE", "PushedModel", "fetch_model", "push_model"]
