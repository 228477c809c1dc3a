"""Cues: what the head on z is asked for, and that z learns to tell it."""

import math

import numpy as np
import pytest
import torch

from navrep_data.models import VAE, VAEConfig, observation_from_scan
from navrep_data.schema import N_RAYS, RANGE_MAX
from navrep_data.shards import DatasetFolder
from navrep_data.train import cues, default_recipe, original_recipe, train_world_model
from navrep_data.train.data import has_people
from navrep_data.train.losses import Counts, vae_loss


def scan_with(metres, ray):
    """Return a scan with a return over some rays around `ray`, nothing elsewhere."""
    scan = np.full((1, N_RAYS), RANGE_MAX, np.float32)
    scan[0, ray - 3 : ray + 4] = metres
    return scan


@pytest.mark.parametrize("lidar", ["rings", "1d"])
@pytest.mark.parametrize("metres", [0.7, 2.0, 6.0])
def test_nearness_of_ranges_is_that_of_the_scan(lidar, metres):
    ray = 270
    found = cues.range_nearness(observation_from_scan(scan_with(metres, ray), lidar), lidar)[0]
    section = ray * cues.N_RANGES[lidar] // N_RAYS
    # a cell of the rings says its near edge
    assert 1.0 / (0.5 + metres) - 1e-6 <= float(found[section]) <= 1.15 / (0.5 + metres)
    others = torch.cat([found[: section - 1], found[section + 2 :]])
    assert float(others.max()) <= 1.0 / (0.5 + 20.0)


def test_people_are_where_they_are_and_only_if_seen():
    humans = torch.full((3, 2, 6), math.nan)
    angle = 2.0 * math.pi * 5 / cues.N_PEOPLE
    humans[0, 0] = torch.tensor([1.5 * math.cos(angle), 1.5 * math.sin(angle), 0.0, 0.0, 0.3, 1.0])
    humans[1] = humans[0]
    humans[1, 0, 5] = 0.0  # not in sight
    between = 2.0 * math.pi * 31.5 / cues.N_PEOPLE
    humans[2, 1] = torch.tensor([3.5 * math.cos(between), 3.5 * math.sin(between), 0.0, 0.0, 0.3, 1.0])
    found = cues.people_nearness(humans)
    assert float(found[0, 5]) == pytest.approx(0.5)
    assert int((found[0] > 1e-3).sum()) == 1
    assert float(found[1].max()) == 0.0
    assert found[2, [31, 0]].tolist() == pytest.approx([0.125, 0.125], abs=1e-4)


def test_the_nearest_of_two_in_a_sector_counts():
    humans = torch.tensor([[[2.0, 0.0, 0.0, 0.0, 0.3, 1.0], [1.0, 0.0, 0.0, 0.0, 0.3, 1.0]]])
    assert float(cues.people_nearness(humans)[0, 0]) == pytest.approx(1 / 1.5)


def test_the_authors_ask_for_nothing():
    assert cues.wanted(default_recipe("v", "rings"))
    assert not cues.wanted(original_recipe("v", "rings"))
    assert not cues.wanted(default_recipe("m", "rings"))


@pytest.mark.slow
def test_asking_teaches_z_to_tell():
    """On one batch, over and over: both errors fall, and the gradient goes through z into V."""
    torch.manual_seed(0)
    vae = VAE(VAEConfig("1d", 16))
    head = cues.Cues(16, "1d")
    around = torch.arange(8) * (2.0 * math.pi / 8)
    humans = torch.zeros(8, 1, 6)
    humans[:, 0, :2] = torch.stack([torch.cos(around), torch.sin(around)], 1)
    humans[:, 0, 5] = 1.0
    # someone at 1 m, all else at 10 m
    away = torch.arange(1080) * (2.0 * math.pi / 1080) - around[:, None]
    batch = {"obs": torch.where(torch.cos(away) > 0.98, 0.04, 0.4), "humans": humans}
    recipe = default_recipe("v", "1d").replace(ranges_weight=1.0, people_weight=1.0, precision="float32")
    optimizer = torch.optim.Adam([*vae.parameters(), *head.parameters()], 3e-3)
    found = []
    for _ in range(200):
        optimizer.zero_grad()
        terms = vae_loss(vae, batch, recipe, 0, None, Counts(8, 0, 8, 0), head)
        terms.total.backward()
        optimizer.step()
        found.append(terms.parts)
    assert float(vae.fc1.weight.grad.abs().sum()) > 0.0
    assert all(found[-1][name] < 0.5 * found[0][name] for name in ("cue_ranges", "cue_people")), found[-1]
    with torch.no_grad():  # each row's own sector, not what is right on average
        said = head(vae.distribution(batch["obs"])[0])[:, cues.N_RANGES["1d"] :]
    assert said.argmax(1).tolist() == [4 * k for k in range(8)]


@pytest.mark.slow
def test_world_models_are_asked_too(dataset, tmp_path):
    recipe = default_recipe("transformer", "1d").replace(
        steps=2, z_size=8, h_size=8, batch=2, micro_batch=2, seed=1, validate_batches=1
    )
    found = train_world_model(recipe, dataset, tmp_path / "asked", preload=False).validation
    assert all(0.0 < found[name] < 10.0 for name in ("cue_ranges", "cue_people"))
    mute = recipe.replace(ranges_weight=0.0, people_weight=0.0)
    assert "cue_people" not in train_world_model(mute, dataset, tmp_path / "mute", preload=False).validation


@pytest.mark.slow
def test_a_resume_keeps_the_head(dataset, tmp_path):
    recipe = default_recipe("v", "1d").replace(
        steps=6, z_size=4, batch=4, micro_batch=4, seed=2, validate_batches=1, validate_every=3, save_every=3
    )
    whole = train_world_model(recipe, dataset, tmp_path / "whole", preload=False)
    train_world_model(recipe, dataset, tmp_path / "parts", preload=False, stop_after=3)
    rest = train_world_model(recipe, dataset, tmp_path / "parts", preload=False, resume=True)
    assert rest.losses == whole.losses[3:]


def test_datasets_without_people_are_trained_on_too(dataset, tmp_path):
    recipe = default_recipe("v", "1d")
    assert has_people(dataset, recipe)
    assert not has_people(dataset, recipe.replace(people_weight=0.0))
    with DatasetFolder(dataset) as folder:
        assert "humans" in folder.manifest.columns
