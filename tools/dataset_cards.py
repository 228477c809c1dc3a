"""Cards of the datasets that this project publishes: ``python tools/dataset_cards.py cards/datasets``.

Notes
-----
A card is a function of a manifest, so the manifests of what is published are kept beside the cards, with the pictures;
tests check that the cards are what this script makes of them, that the pictures are those the manifests list, and
that the package still generates the rows whose hashes the manifests hold. To add or renew one, change
:data:`PUBLISHED` and run ``make cards``, which generates the datasets first.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from navrep_data.datasets.hub import published
from navrep_data.errors import ConfigError
from navrep_data.io import atomic_write_bytes, json_bytes, read_json
from navrep_data.shards import Manifest, dataset_card


@dataclass(frozen=True)
class Published:
    """A dataset that we publish.

    Attributes
    ----------
    command : str
        What generates it.
    license : str
        Identifier as on the Hub.
    """

    command: str
    license: str


PUBLISHED = {
    "soadrl": Published("navrep-data generate --env soadrl --n 1000 --seed 0", "mit"),
    "navrep-train": Published("navrep-data generate --env navrep-train --n 200 --seed 0", "mit"),
    # other: its maps are those of asl-pepper-2d-sim, which states no licence; the card says so
    "ian": Published("navrep-data generate --env ian --n 200 --seed 0", "other"),
}
"""Environments whose datasets we publish: for world models, of the paper's training, and of its test on maps."""
MEDIA = "media"


def write_cards(folder: Path) -> list[Path]:
    """Write the cards of all published datasets into `folder`, from the manifests in it.

    Parameters
    ----------
    folder : pathlib.Path
        With ``<env>.json``, the published manifest, for each line of :data:`PUBLISHED`.

    Returns
    -------
    list of pathlib.Path
        The cards.
    """
    paths = []
    for env in PUBLISHED:
        path = folder / f"{env}.md"
        atomic_write_bytes(path, dataset_card(read_published(folder, env)).encode())
        paths.append(path)
    return paths


def read_published(folder: Path, env: str) -> Manifest:
    """Return the manifest of a published dataset."""
    return Manifest.from_dict(read_json(folder / f"{env}.json"), folder)


def add(folder: Path, root: Path) -> Path:
    """Take over manifest and pictures of the dataset in `root`, as a push would publish them.

    Raises
    ------
    ConfigError
        If its environment is not one that we publish.
    """
    env = Manifest.read(root).env
    if env not in PUBLISHED:
        raise ConfigError(f"{root} is a dataset of {env}, which is not in PUBLISHED: add its line.")
    manifest, files = published(root, PUBLISHED[env].license)
    (folder / MEDIA).mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        if name.startswith(f"{MEDIA}/"):
            atomic_write_bytes(folder / name, data)
    path = folder / f"{env}.json"
    atomic_write_bytes(path, json_bytes(manifest.to_dict()))
    return path


def generate(data: Path, envs: Iterable[str]) -> list[Path]:
    """Generate published datasets into folders in `data`; what is there already is gone on with.

    Returns
    -------
    list of pathlib.Path
        Their folders.
    """
    roots = []
    for env in envs:
        root = data / env
        words = [sys.executable, "-m", "navrep_data", *shlex.split(PUBLISHED[env].command)[1:], "--out", str(root)]
        subprocess.run(words, check=True)
        roots.append(root)
    return roots


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Write the cards of the datasets that this project publishes.")
    parser.add_argument("folder", type=Path, help="cards/datasets of a checkout")
    parser.add_argument("--data", type=Path, help="generate the datasets here first, and take over what they hold")
    parser.add_argument("--only", nargs="+", choices=list(PUBLISHED), default=list(PUBLISHED), help="with --data")
    options = parser.parse_args(arguments)
    if options.data is not None:
        for root in generate(options.data, options.only):
            print(add(options.folder, root))
    for path in write_cards(options.folder):
        print(path)


if __name__ == "__main__":
    main()
