"""Records beside the reference list of released files, and what names stand for."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from recorded import reference

from navrep_data import zoo
from navrep_data.errors import UnknownNameError
from navrep_data.schema import SensorContract
from navrep_data.zoo import names, registry
from navrep_data.zoo.names import alias_line

RECORDS = registry.records()
# what this project trained is tested in tests/train/test_shipping.py
THEIRS = {name: r for name, r in RECORDS.items() if not r.ours}
INPUTS = {"z": lambda r: r.z_size + 5, "h": lambda r: 5 + r.h_size, "zh": lambda r: r.z_size + 5 + r.h_size}


@pytest.fixture(scope="module")
def released_files():
    return reference("released.json")


def test_sixty_one_checkpoints_and_two_pairs():
    assert sum(r.is_checkpoint for r in THEIRS.values()) == 61
    assert [r.name for r in RECORDS.values() if not r.is_checkpoint] == [
        "modular_1d.released",
        "modular_rings.released",
    ]
    kinds = Counter(r.kind for r in THEIRS.values() if r.is_checkpoint)
    assert kinds == {"policy": 52, "controller": 1, "world_model": 4, "vae": 2, "memory": 2}


def test_every_released_file_has_its_record(released_files):
    wanted = {f["path"]: f for f in released_files["files"] if f["kind"] in ("V", "M", "W", "C", "E2E")}
    found = {f.path: (r, f) for r in THEIRS.values() for f in r.files}
    assert set(found) == set(wanted)
    for path, f in wanted.items():
        record, entry = found[path]
        assert (entry.bytes, entry.sha256, entry.git_blob_sha1) == (f["size_bytes"], f["sha256"], f["git_blob_sha1"])
        assert record.source["commit"] == released_files["commit"]
        assert record.source["repository"] == released_files["repo"]
        assert record.n_inputs == f["obs_dim"]
        assert record.z_size == f["z_dim"]
        if f["kind"] == "C":
            assert record.n_parameters == f["n_parameters_stored"]
            assert record.started == f["date"]
        if f["kind"] in ("C", "E2E") and f["zoo_group"] != "unlabelled":
            assert record.variant == f["zoo_group"]


def test_file_names_of_records_are_their_names():
    folder = Path(registry.__file__).parent / "records"
    assert {p.stem for p in folder.glob("*.json")} == set(RECORDS)
    for path in folder.glob("*.json"):
        assert json.loads(path.read_text())["name"] == path.stem


@pytest.mark.parametrize("name", sorted(RECORDS))
def test_records_agree_with_themselves(name):
    r = RECORDS[name]
    assert r.name == f"{r.variant}.{r.tag}"
    assert r.kind in registry.KINDS
    assert SensorContract(**r.sensor) == SensorContract()
    assert all(part in RECORDS for part in r.parts.values())
    if r.features:
        assert r.n_inputs == INPUTS[r.features](r)
        hidden = r.training["settings"]["hidden"] if r.ours else 64
        # two perceptrons of two layers; heads for mean, value and q; log std
        assert r.n_parameters == 2 * hidden * (r.n_inputs + hidden + 2) + 5 * (hidden + 1) + 2
        assert (r.context_rule is not None) == (r.action_alignment is not None) == ("h" in r.features)
    for part in r.parts.values():
        assert RECORDS[part].lidar == r.lidar
        assert RECORDS[part].architecture == r.architecture
    assert (r.training is not None) == r.ours
    if r.ours:
        assert all(RECORDS[part].ours for part in r.parts.values())
    elif r.kind == "policy" and r.architecture != "e2e":
        roles = {"modular": {"vae"} if r.features == "z" else {"vae", "memory"}}.get(r.architecture, {"world_model"})
        assert set(r.parts) == roles
    if r.context_rule and not r.ours:
        assert r.context_rule == ("carried-state" if r.architecture == "modular" else "oldest-32")
    assert registry.Record.from_dict(json.loads(json.dumps(r.to_dict()))) == r


def test_released_is_one_run_of_each_variant_by_the_stated_rule():
    for runs in registry.variants().values():
        assert sum(r.released for r in runs) == 1
        last = max((r for r in runs if "partial" not in r.tag and not r.ours), key=lambda r: r.started or "")
        assert last.released
    assert "started last" in names.RELEASED_RULE


def test_which_policies_need_what_is_missing():
    need = {
        name: {r.name for r in registry.dependants(RECORDS[name])}
        for name in (
            f"{v}.released" for v in ("joint_rings", "transformer_rings", "modular_rings_v", "modular_rings_m")
        )
    }
    assert {name: len(of) for name, of in need.items()} == {
        "joint_rings.released": 7,
        "transformer_rings.released": 11,
        "modular_rings_v.released": 9,
        "modular_rings_m.released": 6,
    }
    assert len(registry.dependants(RECORDS["modular_1d_m.released"])) == 6
    every = set().union(*need.values()) | {r.name for r in registry.dependants(RECORDS["modular_1d_m.released"])}
    assert len(every) == 33


# --- names -------------------------------------------------------------------------------------------------------


def test_list_models():
    everything = zoo.list_models()
    assert everything == sorted(everything)
    assert len([name for name in everything if not name.endswith(".v1")]) == 85
    assert {"e2e_1d.20201026", "e2e_1d.released", "transformer_rings.released"} <= set(everything)
    assert all("rings" in name for name in zoo.list_models("*rings*"))
    assert len(zoo.list_models("*.released")) == 32
    runs = [f"e2e_rings.{tag}" for tag in ("20201026", "20201027", "released")]
    assert [name for name in zoo.list_models("e2e_rings") if not name.endswith(".v1")] == runs
    assert zoo.list_models("e2e_1d.20201026") == ["e2e_1d.20201026"]
    assert zoo.list_models("nothing*") == []


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("transformer_ring_z", "transformer_rings_z"),
        ("Joint_1d_zh", "joint_1d_zh"),
        ("e2e1d", "e2e_1d"),
        ("transformer_1dz.released", "transformer_1d_z.released"),
    ],
)
def test_did_you_mean(wrong, meant):
    words = f"Unknown model '{wrong}'. Did you mean '{meant}'? List all: navrep-data models"
    for function in (zoo.list_models, zoo.show, zoo.load, zoo.fetch, zoo.verify):
        with pytest.raises(UnknownNameError) as caught:
            function(wrong)
        assert str(caught.value) == words


def test_unknown_tag_lists_the_runs():
    with pytest.raises(
        UnknownNameError, match=r"e2e_rings has no tag '2020'\. Its runs: e2e_rings.20201026, e2e_rings"
    ):
        zoo.show("e2e_rings.2020")


def test_short_tag_of_two_runs_lists_them():
    with pytest.raises(UnknownNameError) as caught:
        zoo.show("joint_rings_zh.20201015")
    assert str(caught.value) == (
        "'joint_rings_zh.20201015' is ambiguous: 2 runs began on that day. "
        "Name one of: joint_rings_zh.20201015-1216, joint_rings_zh.20201015-1450"
    )
    assert zoo.show("joint_rings_zh.20201015-1450").started.startswith("2020-10-15T14:50")
    # alone on its day, the day will do
    assert zoo.show("transformer_rings_z.20200907").tag == "20200907-maybepartial"


def test_full_names_say_nothing_untagged_ones_say_whose_weights(capsys):
    assert zoo.show("e2e_1d.released").name == "e2e_1d.20201027"
    assert capsys.readouterr().err == ""
    zoo.show("modular_1d_h")
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "modular_1d_h -> modular_1d_h.20200920: the NavRep authors' weights (modular_1d_h.released)\n"


def test_the_line_for_own_weights():
    assert alias_line("transformer_rings_z", "transformer_rings_z.v1") == (
        "transformer_rings_z -> transformer_rings_z.v1: trained by navrep-data, "
        "NOT the NavRep authors' weights (those: transformer_rings_z.released)"
    )


def test_untagged_name_of_a_variant_about_to_ship_never_means_the_authors(capsys):
    if "transformer_rings_z.v1" in RECORDS:
        assert zoo.show("transformer_rings_z").ours
        assert "NOT the NavRep authors' weights" in capsys.readouterr().err
        return
    with pytest.raises(
        UnknownNameError, match=r"means transformer_rings_z\.v1.*weights: transformer_rings_z\.released"
    ):
        zoo.load("transformer_rings_z")


@pytest.mark.slow
def test_listing_needs_no_torch_and_no_network():
    code = (
        "import sys, navrep_data.zoo as z; z.list_models(); z.show('e2e_1d.20201026'); "
        "print([m for m in ('torch', 'stable_baselines3', 'huggingface_hub', 'httpx2', 'numba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
