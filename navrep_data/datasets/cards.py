"""Cards of the datasets that this project publishes: ``python -m navrep_data.datasets.cards cards/datasets``.

Notes
-----
A card is a function of a manifest, so the manifests of what is published are kept beside the cards, with the pictures;
tests check that the cards are what this module makes of them, that the pictures are those the manifests list, and
that the package still generates the rows whose hashes the manifests hold. To add or renew one, add its line to
:data:`PUBLISHED`, generate the dataset and run
``python -m navrep_data.datasets.cards cards/datasets --from DIR``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from navrep_data.datasets.hub import published
from navrep_data.errors import ConfigError
from navrep_data.io import atomic_write_bytes, json_bytes, read_json
from navrep_data.shards import MANIFEST_FILE, Manifest, dataset_card

PUBLISHED = {
    "soadrl": "mit",
}
"""Environments whose datasets we publish, and under which licence: one line each."""
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
        raise ConfigError(f"{root} is a dataset of {env}, which is not in PUBLISHED: add its line, with a licence.")
    manifest, files = published(root, PUBLISHED[env])
    (folder / MEDIA).mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        if name.startswith(f"{MEDIA}/"):
            atomic_write_bytes(folder / name, data)
    path = folder / f"{env}.json"
    atomic_write_bytes(path, json_bytes(manifest.to_dict()))
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Write the cards of the datasets that this project publishes.")
    parser.add_argument("folder", type=Path, help="cards/datasets of a checkout")
    parser.add_argument("--from", dest="root", type=Path, help=f"dataset folder: take over its {MANIFEST_FILE} first")
    options = parser.parse_args(arguments)
    if options.root is not None:
        print(add(options.folder, options.root))
    for path in write_cards(options.folder):
        print(path)


if __name__ == "__main__":
    main()
