"""How our checkpoints were trained, as their cards tell it."""

import dataclasses

import pytest
import training_stages as stages
from own_model_cards import own_card

from navrep_data.zoo import registry

OURS = sorted((r for r in registry.records().values() if r.ours), key=lambda r: r.name)
WORLD_MODELS = [r for r in OURS if r.kind == "world_model"]


@pytest.mark.parametrize("record", OURS, ids=lambda r: r.name)
def test_every_stage_has_its_command_and_its_settings(record):
    """A command goes with the settings that it was run with: the number that it says is the number they hold."""
    found = stages.stages(record)
    assert [s.command for s in found] == [c for c in record.training["commands"] if " train " in c]
    for s in found:
        assert s.trains in ("v", "m", "joint", "transformer", "controller", "e2e")
        assert f"--seed {s.settings['seed']} " in f"{s.command} "
        assert 0 < s.steps <= s.settings["steps"]
    assert found[0].init is None or found[0].init in registry.records()
    table = stages.stages_table(record)
    assert all(f"| {k} | {s.trains} |" in table for k, s in enumerate(found, 1))


@pytest.mark.parametrize("record", WORLD_MODELS, ids=lambda r: r.name)
def test_a_v_that_was_told_where_people_are_says_so(record):
    told = [k for k, s in enumerate(stages.stages(record), 1) if s.people_weight > 0]
    assert told, "all six world models were: one that was not would be the first: say so here"
    text = stages.supervision(record)
    assert "trained with true positions of people" in text
    assert all(f"{k} of " in text for k in told)
    assert "Supervision" in own_card(record)


def test_what_was_not_told_where_people_are_says_that():
    e2e = registry.records()["e2e_1d.v1"]
    assert "never told where people are" in stages.supervision(e2e)
    record = WORLD_MODELS[0]
    training = {
        **record.training,
        "settings": {**record.training["settings"], "people_weight": 0.0},
        "stages_before": [],
    }
    training["commands"] = [c for c in training["commands"] if " train " in c][-1:]
    assert "was not told" in stages.supervision(dataclasses.replace(record, training=training))


def test_a_controller_names_the_world_model_and_its_supervision():
    text = own_card(registry.records()["joint_1d_z.v1"])
    assert "`joint_1d.v1`, whose V was trained with true positions of people" in text
    assert "These episodes chose the weights." in text
    assert "not looked at" not in text


def test_a_card_says_what_its_start_had_learned():
    found = registry.records()
    text = stages.earlier_stages(found["modular_1d_z.v1"])
    assert "22,500,000 steps before, 5,000,000 + 7,500,000 + 10,000,000" in text
    assert stages.earlier_stages(found["transformer_rings_z.v1"]) == ""
    assert stages.earlier_stages(found["e2e_1d.v1"]) == ""
