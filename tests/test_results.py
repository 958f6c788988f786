"""The tables of docs/results.md and docs/lab_notebook.md agree with the stored data."""

import dataclasses
import itertools
import json
from pathlib import Path

import pytest

from kslc_jax import compare, records, reproduce
from kslc_jax.config import preset
from kslc_jax.evaluation import tables
from kslc_jax.policy import POLICIES, load_policy

DOCS = Path(__file__).parents[1] / "docs"
PAGES = ("results.md", "lab_notebook.md")

FORMS = {
    "survived": ("survival", "{:.0%}"),
    "mean vx [m/s]": ("forward_mean", "{:.2f}"),
    "lateral std [m/s]": ("lateral_std", "{:.2f}"),
    "yaw-rate std [rad/s]": ("yaw_rate_std", "{:.2f}"),
    "strides/s": ("stride_frequency", "{:.2f}"),
    "flight": ("flight_share", "{:.0%}"),
    "clearance [m]": ("clearance", "{:.3f}"),
    "arm-leg correlation": ("shoulder_hip_correlation", "{:.2f}"),
    "within speed limits": ("within_speed_limits", "{:.1%}"),
    "cost of transport": ("cost_of_transport", "{:.2f}"),
}
"""Column headings of the documents, with metric and format. Command 0 has no cost of transport."""


@pytest.mark.parametrize("name", sorted(p.parent.name for p in POLICIES.glob("*/CARD.md")), ids=str)
def test_a_card_says_if_its_policy_is_of_an_older_recipe(name):
    """When the preset changes, this test fails until the card says so, or a new policy ships."""
    config, card = load_policy(name).config, (POLICIES / name / "CARD.md").read_text()
    assert reproduce.of_an_older_recipe(config) == ("of an older recipe" in card)
    assert not reproduce.of_an_older_recipe(dataclasses.replace(preset("laptop"), seed=3))


def table(section: str) -> list[list[str]]:
    """Cells of the first table in a section, header first. Exactly one page has the section."""
    (text,) = (
        part.partition("\n## ")[0]
        for page in PAGES
        for part in (DOCS / page).read_text().split(f"\n## {section}\n")[1:]
    )
    lines = itertools.dropwhile(lambda line: not line.startswith("|"), text.splitlines())
    head, _, *rows = itertools.takewhile(lambda line: line.startswith("|"), lines)
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in (head, *rows)]


def assert_column_per_command(head, rows, stored, forms):
    """The table has a row per metric and a column per command. Labels may start with a condition
    and a colon."""
    assert [float(command) for command in head[1:]] == [n["command"] for n in stored]
    for label, *cells in rows:
        name, form = forms[label.split(": ")[-1]]
        assert cells == [form.format(numbers[name]) for numbers in stored]


def conditions(name: str) -> dict:
    return json.loads((DOCS / "results" / f"{name}.json").read_text())["conditions"]


@pytest.mark.parametrize(
    ("section", "name"),
    [("Full C MuJoCo, high fidelity", "sim2sim"), ("On a GPU", "h200-sim2sim")],
)
def test_high_fidelity(section, name):
    head, *rows = table(section)
    stored = conditions(name)["nominal"]
    assert set(head) == {"command [m/s]", *FORMS} and len(rows) == len(stored)
    for cells, numbers in zip(rows, stored, strict=True):
        assert cells[0] == f"{numbers['command']:.1f}"
        for label, cell in zip(head[1:], cells[1:], strict=True):
            key, form = FORMS[label]
            assert cell == (form.format(numbers[key]) if key in numbers else "-"), (label, cells)


def test_perturbed():
    head, *rows = table("Perturbed")
    stored = conditions("perturbed")
    assert [cells[0] for cells in rows] == list(stored)
    for cells in rows:
        for command, cell, numbers in zip(head[1:], cells[1:], stored[cells[0]], strict=True):
            assert float(command) == numbers["command"]
            assert cell == f"{numbers['survival']:.0%} {numbers['forward_mean']:.2f}"


def test_turning_and_side_steps():
    head, *rows = table("Turning and side steps")
    forms = {label: (name, form) for name, label, form in tables.SIDEWAYS_COLUMNS}
    labels = [label.split(": ")[-1] for label, *_ in rows]
    assert labels[:3] == ["survived", "mean vx [m/s]", "mean yaw rate [rad/s]"]
    assert labels[3:] == ["survived", "mean vx [m/s]", "mean vy [m/s]"]
    for name, part in (("turning", rows[:3]), ("sideways", rows[3:])):
        assert_column_per_command(head, part, conditions(name)["nominal"], forms)


def test_drake():
    head, *rows = table("A second engine: Drake")
    (stored,) = conditions("drake").values()
    stored = [numbers for numbers in stored if numbers["command"] > 0]
    assert_column_per_command(head, rows, stored, FORMS)


def test_compare():
    shown = compare.table(compare.finished(DOCS / "results" / "compare"))
    head, *rows = table("KSLC, its baseline and its ablations")
    assert head == [column.header for column in shown.columns]
    assert rows == [list(cells) for cells in zip(*(c.cells for c in shown.columns), strict=True)]


def test_what_to_expect():
    """README's table and the policy's milestones agree with the stored training."""
    metrics = records.read_metrics(DOCS / "training" / "laptop-seed0.jsonl")
    reached = records.milestones(metrics)
    policy = json.loads((POLICIES / "xbot_l_run" / "milestones.json").read_text())
    assert {f"{v:g}": steps for v, steps, _ in reached} == policy
    lines = (DOCS.parent / "README.md").read_text().splitlines()
    said = [line.removeprefix("| commands up to ") for line in lines if "| commands up to" in line]
    assert len(said) == len(reached)
    for line, (v, steps, seconds) in zip(said, reached, strict=True):
        assert line.startswith(f"{v:.1f} m/s"), line
        assert line.endswith(f"| {steps / 1e6:.1f} M | {seconds / 60:.0f} min |"), line
