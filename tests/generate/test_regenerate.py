"""`verify --regenerate`: datasets prove themselves, and false ones are found out."""

import json
import shutil

import h5py
import numpy as np
import pytest

from navrep_data.errors import ConfigError, DatasetError, PolicyError
from navrep_data.generate import generate, regenerate
from navrep_data.shards import Manifest, ShardWriter, publish

SMALL = {"humans": 4, "obstacles": 3, "length": 40, "shard_size": 2, "seed": 5}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("regenerate") / "d"
    generate(n=5, out=root, **SMALL)
    return root


def rewrite(root, harm):
    """Publish the shard of sequences 0 and 3 again with changed columns, hashes and all, as a forger would."""
    manifest = Manifest.read(root)
    with h5py.File(root / manifest.shards[0].file) as file:
        columns = {name: file[name][:] for name in manifest.columns}
    harm(columns)
    writer = ShardWriter(
        env=manifest.env, config=manifest.config, seed=manifest.seed, sensor=manifest.sensor,
        scan_dtype=manifest.scan_dtype, columns=manifest.columns, max_humans=manifest.max_humans,
        length=manifest.length, split="train",
    )  # fmt: skip
    for k, number in enumerate((0, 3)):
        writer.append(number, {name: values[40 * k : 40 * k + 40] for name, values in columns.items()})
    entry = publish(root, 0, writer.finish())
    manifest.with_shards([entry, *manifest.shards[1:]], complete=True).save(root)


@pytest.mark.slow
def test_a_true_dataset_is_equal_to_the_byte(dataset):
    report = regenerate(dataset, 5)
    assert [c.sequence for c in report.comparisons] == [0, 1, 2, 3, 4]
    assert {c.verdict for c in report.comparisons} == {"equal bytes"}
    assert report.ok


@pytest.mark.slow
def test_the_choice_can_be_repeated(dataset):
    chosen = [[c.sequence for c in regenerate(dataset, 2, seed=s).comparisons] for s in (1, 1, 2, 3, 4)]
    assert chosen[0] == chosen[1]
    assert any(c != chosen[0] for c in chosen[2:])


@pytest.mark.slow
def test_a_forged_reward_is_found(dataset, tmp_path):
    root = tmp_path / "d"
    shutil.copytree(dataset, root)

    def harm(columns):
        row = np.flatnonzero(~columns["is_last"][40:])[3] + 40
        columns["reward"][row] += 0.5

    rewrite(root, harm)
    first, second = (regenerate(root, 5).comparisons[k] for k in (0, 3))
    assert first.verdict == "equal bytes"
    assert (second.verdict, second.values, second.columns) == ("different", 1, {"reward": 1})
    assert second.largest == pytest.approx(0.5, abs=1e-6)


@pytest.mark.slow
def test_a_millimetre_is_counted_and_passes(dataset, tmp_path):
    root = tmp_path / "d"
    shutil.copytree(dataset, root)

    def harm(columns):
        columns["scan"][7, 100:103] += 1
        from navrep_data.observations import scan_to_rings

        columns["rings"] = scan_to_rings(columns["scan"])

    rewrite(root, harm)
    report = regenerate(root, 5)
    first = report.comparisons[0]
    assert first.verdict == "equal within 1 mm"
    assert first.columns["scan"] == 3
    assert first.largest == pytest.approx(0.001)
    assert report.ok


def test_odd_lengths_compare_columns(tmp_path):
    generate(n=3, out=tmp_path / "d", **{**SMALL, "length": 41})
    assert {c.verdict for c in regenerate(tmp_path / "d", 3).comparisons} <= {"equal bytes", "equal columns"}


@pytest.mark.slow
def test_python_policies_need_their_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "regen_policy.py").write_text(
        "import numpy as np\n\ndef creep(scan, robot_state):\n    return robot_state[:, :2] * 0.05\n"
    )
    generate(n=4, out="d", policy="regen_policy:creep", policy_batch=2, **SMALL)
    assert {c.verdict for c in regenerate("d", 4).comparisons} == {"equal bytes"}
    manifest = Manifest.read("d")
    from dataclasses import replace

    replace(manifest, policy={"name": "gone_policy:creep", "batch": 2}).save("d")
    with pytest.raises(PolicyError, match="gone_policy:creep"):
        regenerate("d", 1)


def test_what_has_no_recipe_is_refused(dataset, tmp_path):
    from dataclasses import replace

    root = tmp_path / "d"
    shutil.copytree(dataset, root)
    replace(Manifest.read(root), config={}, policy={}).save(root)
    with pytest.raises(DatasetError, match="no recipe"):
        regenerate(root, 1)
    for k in (0, -1, True):
        with pytest.raises(ConfigError, match="--regenerate is"):
            regenerate(dataset, k)


@pytest.mark.slow
def test_command_line(dataset, capsys):
    from navrep_data.cli.main import run

    with pytest.raises(SystemExit) as stop:
        run(["verify", str(dataset), "--regenerate", "2", "--seed", "1"])
    assert stop.value.code == 0
    out = capsys.readouterr().out.splitlines()
    assert "all well" in out[0]
    assert [line.split(": ")[1] for line in out[1:]] == ["equal bytes"] * 2
    with pytest.raises(SystemExit):
        run(["verify", str(dataset), "--regenerate", "1", "--json"])
    assert json.loads(capsys.readouterr().out)["regenerated"]["ok"]
