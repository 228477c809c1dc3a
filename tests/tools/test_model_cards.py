"""Model cards: current, complete, with front matter that the Hub reads."""

import dataclasses
from pathlib import Path

import model_cards
import pytest
import yaml

from navrep_data.zoo import registry
from navrep_data.zoo.describe import describe

FOLDER = Path(__file__).resolve().parents[2] / "cards" / "models"
VARIANTS = sorted(registry.variants())


def test_cards_are_current(tmp_path):
    made = {path.name: path.read_text() for path in model_cards.write_cards(tmp_path)}
    there = {path.name: path.read_text() for path in FOLDER.glob("*.md")}
    assert set(made) == set(there), "run: python tools/model_cards.py cards/models"
    stale = [name for name in made if made[name] != there[name]]
    assert stale == [], "run: python tools/model_cards.py cards/models"


@pytest.mark.parametrize("variant", VARIANTS)
def test_card(variant):
    text = model_cards.card(variant)
    _, front, body = text.split("---\n", 2)
    head = yaml.safe_load(front)
    assert head["license"] == "mit"
    assert head["library_name"] == "navrep-data"
    assert "navrep" in head["tags"]
    for title in ("Use", "Inputs and outputs", "Runs", "Needs", "Results", "Known quirks", "Provenance", "Cite"):
        assert f"\n## {title}\n" in body
    for record in (r for r in registry.variants()[variant] if not r.ours):
        assert record.name in body
        for f in record.files:
            assert f.path in body
            assert str(f.id) in body
        assert all(note in body for note in record.notes)
    assert "not made or endorsed by the authors" in body
    assert "f824612cc2649fa7d396647f1abc4516e10fae88" in body
    assert str(Path(__file__).resolve().parents[2]) not in text
    assert str(Path.home()) not in text


def test_cards_tell_the_quirks_where_they_apply():
    def told(words):
        return {v for v in VARIANTS if words in model_cards.card(v)}

    policies = {v for v, runs in registry.variants().items() if runs[-1].kind in ("policy", "controller")}
    assert told("Bang-bang control") == policies - {"e2e_1d_carch"}
    frozen = {f"{a}_{lidar}_{f}" for a in ("joint", "transformer") for lidar in ("1d", "rings") for f in ("h", "zh")}
    assert told("Frozen context") == told("Noisy h") == frozen
    assert told("z has 64 numbers; the paper says 32") == {v for v in VARIANTS if v.startswith("transformer")}
    h512 = {f"modular_{lidar}{end}" for lidar in ("1d", "rings") for end in ("", "_m", "_h", "_zh")}
    assert told("h has 512 numbers") == h512
    assert told("MAYBEPARTIAL") == {"transformer_rings_z"}
    several = {v for v, runs in registry.variants().items() if sum(not r.ours for r in runs) > 1}
    assert told("started last") == several


def test_results_are_shown_with_command_and_baseline(monkeypatch):
    assert "Not measured yet." in model_cards.card("modular_1d_z")
    runs = registry.variants()["e2e_1d"]
    result = {
        "suite": "navreptest", "physics": "original", "episodes": 200, "rounds": "0 to 199",
        "ranges": "as_released", "scaling": "none", "success_rate": 0.625, "goal_success_rate": 0.15,
        "command": "navrep-data benchmark zoo:e2e_1d.20201026 --suite navreptest",
    }  # fmt: skip
    measured = tuple(dataclasses.replace(r, results=(result,)) if r.tag == "20201026" else r for r in runs)
    monkeypatch.setattr(model_cards, "variants", lambda: {"e2e_1d": measured})
    text = model_cards.card("e2e_1d")
    assert (
        "| `e2e_1d.20201026` | navreptest | original | 200 (0 to 199) | ranges as the authors fed them | - | "
        "62.5% | - / 15.0% | `navrep-data benchmark zoo:e2e_1d.20201026 --suite navreptest` |"
    ) in text
    one = next(r for r in measured if r.tag == "20201026")
    words = "\n".join(describe(one))
    assert "success contact-free -, as released 62.5%; `goal` on the same episodes - and 15.0%" in words


@pytest.mark.parametrize("name", sorted(registry.records()))
def test_describe(name):
    record = registry.records()[name]
    text = "\n".join(describe(record))
    assert text.startswith(name)
    assert ("results: not measured yet" in text) == (not record.results)
    assert all(f.path in text for f in record.files)
