"""``train``, ``encode`` and ``evaluate`` as commands, in this process."""

import json

import pytest
import torch

from navrep_data.cli.main import run
from navrep_data.testing import tiny_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("data") / "tiny", n=3)


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        run([str(a) for a in arguments])
    streams = capsys.readouterr()
    return end.value.code, streams.out, streams.err


FAST = ["--threads", 1, "--set", "validate_batches=1"]


@pytest.mark.slow
def test_v_codes_m_and_their_error(dataset, tmp_path, capsys):
    v, codes, m = tmp_path / "v", tmp_path / "codes", tmp_path / "m"
    small = ["--set", "z_size=4", "--set", "micro_batch=8"]
    code, out, err = call(
        capsys, "train", "v", "--lidar", "1d", "--data", dataset, "--out", v, "--steps", 2, "--batch", 8, *FAST, *small
    )
    assert (code, out) == (0, f"next: navrep-data encode {dataset} --model {v} --out LATENTS\n"), err
    assert "step 2 of 2" in err
    code, out, err = call(capsys, "encode", dataset, "--model", v, "--out", codes, "--json")
    assert (code, json.loads(out)["rows"]) == (0, 180), err
    done = call(
        capsys, "train", "m", "--data", codes, "--out", m, "--v", v, "--steps", 2, "--batch", 2, *FAST, "--set",
        "h_size=8", "--set", "window=16", "--set", "stride=16", "--json",
    )  # fmt: skip
    assert done[0] == 0, done[2]
    assert json.loads(done[1])["step"] == 2
    figure = tmp_path / "f.png"
    code, out, err = call(
        capsys, "evaluate", "world-model", m / "world_model", "--data", dataset, "--split", "val", "--steps", 2,
        "--json", "--figure", figure,
    )  # fmt: skip
    assert code == 0, err
    assert json.loads(out)["results"][0]["rows"] > 0
    assert figure.is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "lrr=1"], "Did you mean 'lr'"),
        (["--set", "lr=fast"], "is no float"),
        (["--steps", "0"], "steps of a recipe is 0"),
        (["--device", "warp"], "--device 'warp' cannot be used"),
        (["--init", "no_such_model"], "Unknown model"),
        (["--resume"], "no training to resume"),
        (["--lidar", "2d"], "lidar is '2d'"),
        (["--epochs", "nan"], "--epochs is nan, expected more than 0"),
        (["--epochs", "-3"], "--epochs is -3, expected more than 0"),
    ],
)
def test_errors_are_one_line(arguments, words, dataset, tmp_path, capsys):
    code, out, err = call(capsys, "train", "joint", "--data", dataset, "--out", tmp_path / "out", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
    assert err.startswith("Error: ")
