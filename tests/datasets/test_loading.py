"""make_loader yields what a plain DataLoader yields."""

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from navrep_data.datasets import ScanDataset, SequenceDataset, make_loader
from navrep_data.errors import ConfigError
from navrep_data.testing import tiny_dataset


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("loading") / "d")


@pytest.mark.slow
@pytest.mark.parametrize(
    "dataset_of", [lambda r: SequenceDataset(r, "rings", window=8), lambda r: ScanDataset(r, "1d")]
)
@pytest.mark.parametrize("num_workers", [0, 2])
def test_batches_are_those_of_a_plain_loader(root, dataset_of, num_workers):
    dataset = dataset_of(root)
    plain = list(DataLoader(dataset, batch_size=5))
    ours = list(make_loader(dataset, 5, shuffle=False, num_workers=num_workers))
    assert len(plain) == len(ours) == -(-len(dataset) // 5)
    for a, b in zip(plain, ours, strict=True):
        assert a.keys() == b.keys()
        for name in a:
            assert torch.equal(a[name], b[name])


def test_a_dataset_opened_by_a_relative_path_is_read_from_any_working_folder(root, tmp_path, monkeypatch):
    monkeypatch.chdir(root.parent)
    dataset = SequenceDataset(root.name, None, window=8)
    monkeypatch.chdir(tmp_path)
    expected = SequenceDataset(root, None, window=8)[0]["robot_state"]
    assert torch.equal(dataset[0]["robot_state"], expected)


def test_shuffling_is_seeded_and_new_each_epoch(root):
    dataset = SequenceDataset(root, None, window=8)

    def order(loader):
        return torch.cat([batch["robot_state"][:, 0, 0] for batch in loader]).tolist()

    loader = make_loader(dataset, 4, seed=1)
    first, second = order(loader), order(loader)
    assert first != second
    assert sorted(first) == sorted(second)
    assert order(make_loader(dataset, 4, seed=1)) == first
    assert sum(len(b["mask"]) for b in make_loader(dataset, 4, drop_last=True)) == len(dataset) // 4 * 4


@pytest.mark.parametrize("kind", [np.int64, np.uint8, np.array, torch.tensor])
def test_whole_numbers_of_any_kind(root, kind):
    dataset = SequenceDataset(root, None, window=8)
    plain, other = make_loader(dataset, 2, seed=4), make_loader(dataset, kind(2), seed=kind(4), num_workers=kind(0))
    for batch, same in zip(plain, other, strict=True):
        assert torch.equal(batch["robot_state"], same["robot_state"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"batch_size": 0}, "batch_size is 0, expected a whole number of at least 1"),
        ({"seed": 2.0}, "seed is 2.0, expected a whole number from 0"),
        ({"seed": torch.tensor([1, 2])}, "seed is tensor"),
        ({"num_workers": -1}, "num_workers is -1, expected a whole number of at least 0"),
    ],
)
def test_numbers_are_checked(root, settings, words):
    with pytest.raises(ConfigError, match=words):
        make_loader(SequenceDataset(root, None), **{"batch_size": 2, **settings})
