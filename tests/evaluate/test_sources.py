"""From results files to the entries of a record: one per way of playing, each with its whole command."""

import json

import pytest

from navrep_data.cli.models import _score
from navrep_data.evaluate import get_suite
from navrep_data.evaluate.metrics import METRICS, Contacts
from navrep_data.evaluate.results import Results, file_name, header_of
from navrep_data.evaluate.sources import benchmark_entries
from navrep_data.policies import resolve_policy
from navrep_data.zoo import measured, registry

NAME = "e2e_1d.20201026"
COMMAND = f"navrep-data benchmark {NAME} --suite navreptest --episodes 3"
WAYS = {
    "": {},
    " --first-round 400": {"first_round": 400},
    " --ranges as_released": {"ranges": "as_released"},
    " --scaling none": {"scaling": "none"},
    " --inference as_released": {"inference": "as_released"},
}


def play(folder, name, outcome, first_round=0, **how):
    suite, spec = get_suite("navreptest"), resolve_policy(name, **how)
    made = Results(header_of(spec, suite, "original", first_round))
    n = len(outcome)
    made.outcome, made.events, made.steps = list(outcome), ["goal"] * n, [10] * n
    made.metrics = {m.name: [1.0] * n for m in METRICS}
    made.contacts = [Contacts()] * n
    home = folder / suite.folder("original", first_round)
    home.mkdir(parents=True, exist_ok=True)
    made.save(home / file_name(spec))


@pytest.fixture
def entries(tmp_path):
    """What a record says of one policy that was played in every way, three episodes each."""
    for k, how in enumerate(WAYS.values()):
        play(tmp_path, NAME, "SSSSS"[: k % 3] + "TTTTT"[k % 3 : 3], **how)
    for first_round in (0, 400):
        play(tmp_path, "goal", "STT", first_round)
    return benchmark_entries(tmp_path, registry.find(NAME))


def test_every_way_of_playing_reaches_the_record_with_its_whole_command(entries):
    found = {e["command"]: e for e in entries}
    assert set(found) == {COMMAND + options for options in WAYS}
    later, uncut = found[f"{COMMAND} --first-round 400"], found[f"{COMMAND} --ranges as_released"]
    assert (later["rounds"], later["ranges"], later["scaling"]) == ("400 to 402", "contract", "robot")
    assert (uncut["rounds"], uncut["ranges"], uncut["scaling"]) == ("0 to 2", "as_released", "none")
    assert found[f"{COMMAND} --scaling none"]["scaling"] == "none"
    assert found[f"{COMMAND} --inference as_released"]["inference"] == "as_released"
    assert all(e["goal_success_rate"] == pytest.approx(1 / 3, abs=1e-6) for e in entries)


def test_a_record_keeps_them_apart_and_a_new_measurement_replaces_its_own_alone(entries):
    old = {
        "suite": "navreptest",
        "physics": "original",
        "episodes": 200,
        "rounds": "0 to 199",
        "success_rate": 0.5,
        "command": "old",
    }
    consistent = {**entries[0], "physics": "consistent"}
    error = {"suite": "world-model", "split": "test", "scan_mse": 0.1, "command": "errors"}
    kept = measured.merged([old, consistent, error], entries)
    assert [e["command"] for e in kept] == [
        entries[0]["command"], entries[0]["command"], "errors", *(e["command"] for e in entries[1:]),
    ]  # fmt: skip
    assert measured.merged(kept, entries) == kept
    longer = {**entries[0], "rounds": "0 to 199", "episodes": 200}
    assert measured.merged(kept, [longer])[0] == longer


def test_lists_show_the_main_result_alone(entries):
    later, main = ({**e} for e in sorted(entries, key=lambda e: "--first-round" not in e["command"])[:2])
    assert measured.main_result([later], "navreptest", "original") is None
    assert measured.main_result([*entries[1:], main], "navreptest", "original")["command"] == COMMAND
    old = {"suite": "navreptest", "physics": "original", "rounds": "0 to 199", "success_rate": 0.5}
    assert measured.main_result([later, old], "navreptest", "original") == old
    assert _score([later, {**main, "contact_free_rate": 0.25, "success_rate": 0.5}], "navreptest") == "25.0 (50.0) %"
    assert _score([later], "navreptest") == "-"


@pytest.mark.slow
@pytest.mark.parametrize("name", [NAME, "e2e_1d.v1"])
def test_no_two_rows_or_lines_of_a_card_say_the_same(entries, name, monkeypatch):
    from dataclasses import replace

    import model_cards
    from own_model_cards import own_card

    from navrep_data.zoo.describe import describe

    maps = {"asl": 0.5}
    results = [{**e, "per_map": maps, "per_map_contact_free": maps, "command": "c"} for e in entries]
    for e in results:  # so that only what was played can tell them apart
        e.update({k: 0.5 for k in e if "rate" in k} | {"contacts_per_km": 1.0})
    record = replace(registry.find(name), results=tuple(json.loads(json.dumps(results))))
    card = own_card(record) if record.ours else model_cards._results([record])
    told = [line for line in card.splitlines() if "50.0%" in line]
    assert len(told) == len(set(told)) == len(results) * (3 if record.ours else 1)
    described = [line for line in describe(record) if line.startswith("result:")]
    assert len(described) == len(set(described)) == len(results)
    for words in ("original", "400 to 402", "contract, scaled", "as trained", "ranges as the authors fed them",
                  "noise of the release"):  # fmt: skip
        assert words in card
        assert any(words in line for line in described)
