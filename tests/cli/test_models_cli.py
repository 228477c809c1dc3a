"""``navrep-data models`` as a user meets it: processes of their own, closed stdin."""

import json
import os
import re

import pytest
import warm_process
from recorded import golden as recorded_golden
from recorded import write_golden

from navrep_data.cli import models
from navrep_data.testing import tiny_checkpoint

pytestmark = pytest.mark.slow  # seconds each; `make test` runs them

E2E = "e2e_1d.20201026"
E2E_FILE = "e2e1dnavreptrainenv_2020_10_26__14_10_51_PPO_E2E1D_VCARCH_C64_ckpt.zip"


@pytest.fixture
def run(tmp_path):
    """The command, with an empty cache and no network."""

    def call(*arguments, cwd=None, **variables):
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("NAVREP_RELEASED", "HF_"))}
        environment |= {"COLUMNS": "200", "NAVREP_DATA_HOME": str(tmp_path / "home"), "NAVREP_DATA_OFFLINE": "1"}
        return warm_process.shared().run(["models", *arguments], cwd, {**environment, **variables})

    return call


def test_list(run):
    done = run()
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if not line.split()[0].endswith(".v1")]
    assert len(lines) == 64
    assert "transformer_rings_z.20201004" in done.stdout
    assert "= transformer_rings_z.released" in done.stdout
    done = run("*rings_z")
    assert done.stdout == "", "wildcards that match no full name"
    assert run("*rings_z.2*").stdout.count("\n") == 11
    assert len(json.loads(run("modular_1d_h", "--json").stdout)) == 3
    found = json.loads(run("--json").stdout)
    shipped = [r["name"].endswith(".v1") for r in found]
    assert shipped == sorted(shipped, reverse=True)
    assert found[0]["here"] is True
    assert found[-1]["here"] is False
    (ours,) = run("e2e_1d.v1").stdout.splitlines()[1:]
    assert ours.split()[:5] == ["e2e_1d.v1", "policy", "1d", "0.55", "MB"]
    assert re.search(r"\(68\.5\) % .* \(57\.4\) %  yes  = e2e_1d, ours$", ours)
    assert " rings " in run("modular_rings.v1").stdout


def test_several_patterns_are_one_list(run):
    found = json.loads(run("e2e_1d*", "transformer_1d_z*", "e2e_1d.v1", "--json").stdout)
    names = [r["name"] for r in found]
    assert len(names) == len(set(names))
    assert {name.split("_")[0] for name in names} == {"e2e", "transformer"}
    assert names[:2] == ["e2e_1d.v1", "transformer_1d_z.v1"]
    done = run("e2e_1d*", "nothing*")
    assert (done.returncode, done.stderr) == (2, "Error: No model matches 'nothing*'. List all: navrep-data models\n")


def test_where_only_another_feeding_was_measured_that_is_shown_and_marked(run):
    cut = {
        "suite": "navreptest", "physics": "original", "episodes": 200, "rounds": "0 to 199", "ranges": "contract",
        "scaling": "robot", "success_rate": 0.5, "contact_free_rate": 0.25,
    }  # fmt: skip
    uncut = {**cut, "ranges": "as_released", "scaling": "none", "success_rate": 0.235, "contact_free_rate": 0.2}
    assert models._score([uncut], "navreptest") == "20.0 (23.5) %*"
    assert models._score([uncut, cut], "navreptest") == "25.0 (50.0) %"
    assert models._score([uncut], "navrep27") == "-"
    assert "'*' = fed in another way than by default" in run("transformer_1d_z.20201015").stderr


def test_show_takes_a_folder(run, tmp_path):
    tiny_checkpoint(tmp_path / "mine", model="e2e")
    done = run("show", "./mine", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "kind: e2e\n" in done.stdout
    assert json.loads(run("show", "./mine", "--json", cwd=tmp_path).stdout)["kind"] == "e2e"
    done = run("show", "./gone", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "Error: There is no gone, expected a folder with a checkpoint: check the path.\n"


def test_list_tells_what_is_here(run, released):
    found = json.loads(run("--json", NAVREP_RELEASED_DIR=str(released)).stdout)
    theirs = [r for r in found if r["tag"] != "v1"]
    assert sum(r["here"] for r in theirs if r["kind"] == "policy") == 19
    assert all(r["here"] for r in found if r["tag"] == "v1")
    gone = next(r for r in found if r["name"] == "transformer_rings_z.20201004")
    assert gone["not_here"] == ["models/W/navreptraingpt"]


@pytest.mark.parametrize("verb", [(), ("show",), ("fetch",), ("verify",)])
def test_wrong_name(run, verb):
    done = run(*verb, "transformer_ring_z")
    assert done.returncode == 2
    assert done.stderr == (
        "Error: Unknown model 'transformer_ring_z'. Did you mean 'transformer_rings_z'? List all: navrep-data models\n"
    )
    assert done.stdout == ""


def test_show(run):
    done = run("show", E2E)
    assert done.returncode == 0, done.stderr
    assert E2E_FILE in done.stdout
    assert "quirk: Bang-bang control" in done.stdout
    assert "navreptest" in done.stdout
    assert "here: no; to fetch: models/gym/" in done.stdout
    found = json.loads(run("show", E2E, "--json").stdout)
    assert found["name"] == E2E
    assert found["files"][0]["bytes"] == 1017662
    done = run("show", "modular_1d_h", "--json")
    assert done.stderr == (
        "modular_1d_h -> modular_1d_h.20200920: the NavRep authors' weights (modular_1d_h.released)\n"
    )
    assert json.loads(done.stdout)["name"] == "modular_1d_h.20200920"


def test_fetch_offline(run, released, tmp_path):
    done = run("fetch", E2E)
    assert done.returncode == 2
    assert done.stderr.startswith(f"Error: {E2E} needs models/gym/{E2E_FILE} (sha256 ")
    assert str(tmp_path / "home") in done.stderr
    assert done.stderr.count("\n") == 1
    done = run("fetch", E2E, "--from", released, "--json")
    assert list(json.loads(done.stdout)["files"]) == [f"models/gym/{E2E_FILE}"]
    done = run("fetch", "transformer_rings_z.released", "--from", released)
    assert done.returncode == 1
    assert "navreptraingpt (git blob 5d4e82c51a129a8aabc45bef0a51649b9eecc56a)" in done.stderr


@pytest.mark.parametrize("verb", ["fetch", "verify"])
def test_name_or_all(run, verb):
    for arguments in ((), (E2E, "--all")):
        done = run(verb, *arguments)
        assert done.returncode == 2
        assert f"Expected either NAME or --all: navrep-data models {verb} NAME" in done.stderr


@pytest.mark.slow
def test_verify_all(run, released, tmp_path):
    done = run("verify", "--all", "--from", released, "--golden", write_golden(tmp_path / "golden"))
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert sum(line.startswith("ok ") and ".v1" not in line for line in lines) == 56
    missing = [lines[i + 1] for i, line in enumerate(lines) if line.startswith("missing ")]
    assert len(missing) == 5
    for path, blob, policies in [
        ("models/M/navreptrainrnn.json", "eaf1ec048cd4b3704924a9a81b3118c3a34ba737", 6),
        ("models/M/navreptrainrnn1d.json", "6bf6174d2a756365fcb2a3847dc825b7c6e8233b", 6),
        ("models/V/navreptrainvae.json", "a821669b98a14c7d084e681aaab076a71ad7d077", 9),
        ("models/W/navreptraingpt", "5d4e82c51a129a8aabc45bef0a51649b9eecc56a", 11),
        ("models/W/navreptrainvaelstm", "5f7ed72a7208b54f84afb3a3609810118985ffc0", 7),
    ]:
        assert any(f"{path} (git blob {blob})" in m and f"; {policies} policies need it" in m for m in missing)
    ours = sum(".v1" in line for line in lines if line.startswith("ok "))
    counts = f"{61 + ours} checkpoints: {56 + ours} right, 5 missing, 0 wrong; "
    assert any(line.startswith(counts) for line in lines)
    assert not any("no outputs of it are known" in line for line in lines)
    assert "34 policies depend on files that are not here and cannot run:" in lines


def test_verify_all_without_the_authors_files(run):
    """What is in the package is compared; what is not is told, and is no failure."""
    done = run("verify", "--all")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert "ok      e2e_1d.v1, 3 outputs that navrep-data recorded" in lines
    assert "ok      joint_rings.v1, 7 outputs that navrep-data recorded" in lines
    assert any("13 right, 61 missing, 0 wrong; 76 of 76 golden outputs within tolerance" in line for line in lines)


def test_verify_one(run, released, tmp_path):
    done = run("verify", E2E, "--from", released, "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 0
    assert found["ok"] is True
    assert (found["right"], found["missing"], found["wrong"], found["cannot_run"]) == (1, 0, 0, [])
    golden = write_golden(tmp_path / "golden")
    done = run("verify", "modular_1d_v", "--from", released, "--golden", golden, "--json")
    outputs = json.loads(done.stdout)["checks"][0]["comparisons"]
    assert {c["output"] for c in outputs} == {"mu", "logvar", "decode_mu", "decode_z", "weights"}
    assert all(0 < c["error"] < c["tolerance"] for c in outputs if c["original"])
    assert run("verify", E2E).returncode == 1, "asked for by name and missing"


@pytest.mark.slow
def test_verify_finds_flipped_bytes_and_changed_golden_outputs(run, released, tmp_path):
    import numpy as np

    folder = tmp_path / "mine"
    folder.mkdir()
    name = "e2e1dnavreptrainenv_2020_09_01__11_44_49_PPO_E2E1D_VCARCH_C64_ckpt.zip"
    data = bytearray((released / "models" / "gym" / name).read_bytes())
    data[5000] ^= 1
    (folder / name).write_bytes(data)
    done = run("verify", "e2e_1d.20200901", "--from", folder)
    assert done.returncode == 1
    assert "has sha256" in done.stdout
    assert "1 checkpoints: 0 right, 0 missing, 1 wrong" in done.stdout

    golden = tmp_path / "golden"
    golden.mkdir()
    stem = f"E2E_{name.removesuffix('.zip')}"
    arrays = recorded_golden(stem)
    np.savez(golden / f"{stem}.npz", **{**arrays, "action_mean": arrays["action_mean"] * 1.001})
    done = run("verify", "e2e_1d.20200901", "--from", released, "--golden", golden)
    assert done.returncode == 1
    assert "action_mean differs by" in done.stdout
    np.savez(golden / f"{stem}.npz", **arrays)
    assert run("verify", "e2e_1d.20200901", "--from", released, "--golden", golden).returncode == 0


@pytest.mark.slow
def test_convert(run, released, tmp_path):
    file = released / "models" / "gym" / E2E_FILE
    done = run("convert", file, "--out", tmp_path / "e2e.safetensors", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["file"] == str(file)
    assert (tmp_path / "e2e.safetensors").stat().st_size > 900_000
    done = run("convert", file, "--out", tmp_path / "e2e.safetensors")
    assert done.returncode == 2
    assert "exists already and is not overwritten" in done.stderr
    done = run("convert", tmp_path / "nothing.zip")
    assert (done.returncode, "is not a file" in done.stderr) == (2, True)
    (tmp_path / "junk.zip").write_bytes(b"junk")
    done = run("convert", tmp_path / "junk.zip", "--out", tmp_path / "junk.safetensors")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
