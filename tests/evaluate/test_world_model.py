"""The world-model error against a loop over single rows."""

import numpy as np
import pytest
import torch

from navrep_data._version import __version__
from navrep_data.datasets import SequenceDataset
from navrep_data.errors import ConfigError, CorruptDataError
from navrep_data.evaluate.world_model import dream, world_model_error
from navrep_data.evaluate.world_model_results import figure, load, save, table
from navrep_data.models import checkpoint
from navrep_data.testing import tiny_dataset

SMALL = {
    "transformer": {"lidar": "1d", "z_size": 16, "n_blocks": 1, "n_heads": 2, "action_alignment": "taken"},
    "joint": {"lidar": "1d", "z_size": 8, "h_size": 16, "residual": True},
    "modular": {"lidar": "rings", "z_size": 8, "h_size": 16},
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("data") / "tiny", n=3)


def make(kind):
    torch.manual_seed(0)
    return checkpoint.make(kind, SMALL[kind]).eval()


@torch.no_grad()
def by_rows(model, data, split, steps):
    """Every window by itself, every row by itself; memory run anew for each row."""
    lidar = model.lidar
    name = "rings" if lidar == "rings" else "scan"
    windows = SequenceDataset(
        data, lidar, window=33, stride=32, split=split, action=model.config.action_alignment, scan_unit="normalized",
        invalid="range_max",
    )  # fmt: skip
    scan, goal, dreamed = [], [], [[] for _ in range(steps)]
    for i in range(len(windows)):
        b = windows[i]
        n = int(b["mask"].sum())
        obs, goals, actions = b[name][:n].clone(), b["robot_state"][:n, :2], b["action"][:n]
        if lidar == "rings":
            obs[..., 0] = 0.0
        z = model.encode(obs)
        for t in range(n - 1):
            h, _ = model.hidden(z[None, : t + 1], goals[None, : t + 1], actions[None, : t + 1])
            next_z, next_goal = model.heads(z[None, t], goals[None, t], h[:, -1])
            scan.append(float(((model.decode(next_z)[0] - obs[t + 1]) ** 2).mean()))
            goal.append(float(((next_goal[0] - goals[t + 1]) ** 2).mean()))
        if n > 16:
            codes, where = list(z[:16]), list(goals[:16])
            for k in range(min(steps, n - 16)):
                h, _ = model.hidden(torch.stack(codes)[None], torch.stack(where)[None], actions[None, : 16 + k])
                next_z, next_goal = model.heads(codes[-1][None], where[-1][None], h[:, -1])
                codes.append(next_z[0])
                where.append(next_goal[0])
                dreamed[k].append(float(((model.decode(next_z)[0] - obs[16 + k]) ** 2).mean()))
    return np.mean(scan), np.mean(goal), [np.mean(d) for d in dreamed], [len(d) for d in dreamed], len(scan)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["transformer", "joint", "modular"])
def test_error_is_that_of_single_rows(kind, dataset):
    model = make(kind)
    found = world_model_error(model, dataset, split="train", steps=3, name=kind)
    scan, goal, dreamed, counts, rows = by_rows(model, dataset, "train", 3)
    assert (found.rows, found.dreams) == (rows, counts)
    assert found.scan_mse == pytest.approx(scan, rel=1e-4)
    assert found.goal_mse == pytest.approx(goal, rel=1e-4)
    assert found.dream_scan_mse == pytest.approx(dreamed, rel=1e-4)
    assert 0 < found.still_goal_mse < goal  # nothing was learnt


def test_a_dream_is_fed_itself_and_the_real_actions():
    model = make("transformer")
    torch.manual_seed(1)
    z, goal, action = torch.randn(2, 5, 16), torch.randn(2, 5, 2), torch.randn(2, 8, 3)
    a, _ = dream(model, z, goal, action, 4)
    other = action.clone()
    other[:, 6] += 1.0
    b, _ = dream(model, z, goal, other, 4)
    assert torch.equal(a[:, :2], b[:, :2])
    assert not torch.equal(a[:, 2:], b[:, 2:])


@pytest.mark.slow
def test_table_and_figure(dataset, tmp_path):
    results = [
        world_model_error(make(k), dataset, split="val", steps=2, limit=2, name=k) for k in ("joint", "transformer")
    ]
    lines = table(results)
    assert len(lines) == 5
    assert "standing still" in lines[2]
    figure(results, tmp_path / "errors.png")
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    for name, start in (("errors.pdf", b"%PDF"), ("errors.svg", b"<?xml")):
        figure(results, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(ConfigError, match=r"--figure is .*errors.jpg, expected a name .* \.png, \.pdf, \.svg"):
        figure(results, tmp_path / "errors.jpg")


@pytest.mark.slow
def test_of_v_alone_the_reconstruction_is_measured_over_the_same_rows(dataset, tmp_path):
    model = make("transformer")
    whole = world_model_error(model, dataset, split="train", steps=2, name="W")
    alone = world_model_error(model.vae, dataset, split="train", steps=2, name="V")
    assert (alone.rows, alone.scan_mse, alone.goal_mse, alone.dream_scan_mse) == (whole.rows, None, None, [])
    assert alone.reconstruction_mse == pytest.approx(whole.reconstruction_mse, rel=1e-5)
    assert alone.still_scan_mse == pytest.approx(whole.still_scan_mse)
    lines = table([whole, alone])
    assert lines[3].split()[2:4] == ["-", "-"]
    with pytest.raises(ConfigError, match="no world model to draw"):
        figure([alone], tmp_path / "none.png")


def test_results_are_files(dataset, tmp_path):
    found = world_model_error(make("joint"), dataset, split="val", steps=2, name="./models/joint 1")
    path = save(found, tmp_path, {"name": "d", "content_hash": "0"}, {"model": "1"})
    assert path == tmp_path / "world-model" / ".-models-joint-1.val.json"
    about = {"data": {"name": "d", "content_hash": "0"}, "files": {"model": "1"}, "navrep_data": __version__}
    assert load(path) == (found, {**about, "limit": None})
    assert load(save(found, tmp_path, about["data"], about["files"], 40)) == (found, {**about, "limit": 40})
    path.write_text(path.read_text().replace(": 40", ': "40 and more"'))
    with pytest.raises(CorruptDataError, match="limit '40 and more'"):
        load(path)
    save(found, tmp_path, about["data"], about["files"])
    path.write_text(path.read_text().replace('"rows"', '"lines"'))
    with pytest.raises(CorruptDataError, match="no world-model result of this version"):
        load(path)


def test_bad_input(dataset):
    with pytest.raises(ConfigError, match="expected a world model"):
        world_model_error(checkpoint.make("memory", {}), dataset)
    with pytest.raises(ConfigError, match="steps is 40"):
        world_model_error(make("transformer"), dataset, steps=40)
