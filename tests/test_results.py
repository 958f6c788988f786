"""The pages agree with the stored data, and each card with its policy."""

import dataclasses
import json
from pathlib import Path

import pytest

from docs import tables
from kslc_jax import records, reproduce
from kslc_jax.config import preset
from kslc_jax.policy import POLICIES, load_policy

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", sorted(p.parent.name for p in POLICIES.glob("*/CARD.md")), ids=str)
def test_a_card_says_if_its_policy_is_of_an_older_recipe(name):
    """When the preset changes, this test fails until the card says so, or a new policy ships."""
    config, card = load_policy(name).config, (POLICIES / name / "CARD.md").read_text()
    assert reproduce.of_an_older_recipe(config) == ("of an older recipe" in card)
    assert not reproduce.of_an_older_recipe(dataclasses.replace(preset("laptop"), seed=3))


@pytest.mark.parametrize("page", tables.PAGES)
def test_each_marked_table_is_what_the_data_say(page):
    """If this fails: python -m docs.tables writes them again."""
    text = (ROOT / page).read_text()
    assert "<!-- table: " in text
    assert tables.rewritten(text) == text


def test_no_number_of_a_marked_table_is_copied_by_hand(tmp_path, monkeypatch):
    """A changed cell, a missing row and one too many are all made good. Other tables stay."""
    rows = [
        {"command": 0.5, "survival": 1.0, "forward_mean": 0.496},
        {"command": 2.0, "survival": 0.75, "forward_mean": -1.0},
    ]
    kept = {"conditions": {"nominal": rows, "push=[0.5]": rows[1:]}}
    (tmp_path / "some.json").write_text(json.dumps(kept))
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    head = "Before.\n\n<!-- table: conditions some.json -->\n"
    tail = "\nAfter.\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    right = (
        "| survived, mean vx [m/s] | 0.5 | 2.0 |\n"
        "| --- | --- | --- |\n"
        "| nominal | 100% 0.50 | 75% -1.00 |\n"
        "| push=[0.5] | - | 75% -1.00 |\n"
    )
    for old in (right, "", right.replace("0.50", "0.51"), right + "| third | - | - |\n"):
        assert tables.rewritten(head + old + tail) == head + right + tail


def test_all_stored_results_are_on_a_page():
    pages = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    for path in (ROOT / "docs" / "results").glob("*.json"):
        assert f"results/{path.name}" in pages, path.name


def test_milestones_by_hand(tmp_path):
    """Episodes are long and tracking is good in the second record; the range grows in the third."""
    columns = {
        "env_steps": [1e6, 2e6, 3.25e6],
        "seconds": [60, 90, 660],
        "episode_steps": [2100, 2010, 2000],
        "curriculum/tracking": [0.8, 0.81, 0.9],
        "curriculum/v_max": [0.5, 0.5, 1.0],
        "steps_per_second": [1, 1, 1],
    }
    lines = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    assert tables.markdown(tables.milestones(tmp_path))[2:] == [
        f"| {tables.LEARNT_TO_WALK} | 2.0 M | 1.5 min |",
        "| commands up to 1.0 m/s | 3.2 M | 11 min |",
        "| the end of the run | 3.2 M | 11 min |",
    ]


def test_the_policy_has_the_milestones_of_its_training():
    reached = records.milestones(records.read_metrics(ROOT / "docs/training/xbot_l_run.jsonl"))
    policy = json.loads((POLICIES / "xbot_l_run" / "milestones.json").read_text())
    assert {f"{v:g}": steps for v, steps, _ in reached} == policy
