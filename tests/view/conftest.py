"""Pages for the tests: of a small simulated dataset, of an import, of benchmark results."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from chromium import Chromium, find_chromium
from view_pages import HOSTILE, write_results

from navrep_data.datasets import import_npz
from navrep_data.datasets.npz import FILE_SUFFIX
from navrep_data.testing import tiny_dataset
from navrep_data.view import dataset_page, results_page


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_dataset(tmp_path_factory.mktemp("view") / "crowd", n=4, length=150, humans=6)


@pytest.fixture(scope="session")
def page_file(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset_page(dataset).write(tmp_path_factory.mktemp("pages") / "dataset.html")


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "navrep27-original"
    write_results(folder, "first", seed=0)
    write_results(folder, "second", seed=1)
    (folder / "other.json").write_text("[1, 2]")
    return folder


@pytest.fixture(scope="session")
def results_file(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return results_page(results).write(tmp_path_factory.mktemp("pages") / "results.html")


@pytest.fixture(scope="session")
def imported(tmp_path_factory):
    rng = np.random.default_rng(0)
    source = tmp_path_factory.mktemp("npz")
    dones = np.zeros(80, bool)
    dones[[29, 79]] = True
    np.savez_compressed(
        source / f"000_{FILE_SUFFIX}", scans=rng.uniform(0.3, 25, (80, 1080)).astype(np.float32),
        robotstates=rng.normal(size=(80, 5)), actions=rng.normal(size=(80, 3)), rewards=rng.normal(size=80),
        dones=dones,
    )  # fmt: skip
    root = tmp_path_factory.mktemp("imported") / "imported"
    import_npz(source, root, env=HOSTILE)
    return root


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    program = find_chromium()
    if program is None:
        pytest.skip("needs Chromium (Debian: apt-get install chromium, or CHROMIUM=path)")
    with Chromium(tmp_path_factory.mktemp("profile"), program) as running:
        yield running
