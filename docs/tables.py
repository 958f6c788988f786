"""Writes the tables of the pages again, from the data beside them: python -m docs.tables [--check]

A comment above each table says how it is made, and of which files:

  <!-- table: speeds docs/results/judge.json -->

So no number is copied by hand. With --check nothing is written; the exit code is 1 if a page
differs from the data.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kslc_jax import compare, judge, records
from kslc_jax.config.physics import XBOT_L
from kslc_jax.evaluation import scheduled, tables
from kslc_jax.evaluation.bars import REPORTED

ROOT = Path(__file__).parents[1]

CARDS = "kslc_jax/policies/*/CARD.md"

PAGES = (
    "README.md",
    "docs/results.md",
    "docs/lab_notebook.md",
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob(CARDS)),
)

MARK = re.compile(r"^<!-- table: (?P<kind>\S+) (?P<files>.*) -->$")

Row = dict[str, Any]

GAIT = (
    ("survival", "survived", "{:.0%}"),
    ("forward_mean", "mean vx [m/s]", "{:.2f}"),
    ("lateral_std", "lateral std [m/s]", "{:.2f}"),
    ("yaw_rate_std", "yaw-rate std [rad/s]", "{:.2f}"),
    ("stride_frequency", "strides/s", "{:.2f}"),
    ("flight_share", "flight", "{:.0%}"),
    ("clearance", "clearance [m]", "{:.3f}"),
    ("shoulder_hip_correlation", "arm-leg correlation", "{:.2f}"),
    ("within_speed_limits", "within speed limits", "{:.1%}"),
    ("cost_of_transport", "cost of transport", "{:.2f}"),
)
"""Columns of a table of constant commands."""

SIDEWAYS = tuple(
    column
    for column in tables.SIDEWAYS_COLUMNS
    if column[0] in ("survival", "forward_mean", "lateral_mean", "yaw_rate_mean")
)

OLDER = "of an older recipe: `make train` trains another policy today"

WALKS_STEPS, WALKS_TRACKING = 2000, 0.8
"""A robot that walks has longer episodes [control steps] and more tracking [share] than these."""

LEARNT_TO_WALK = (
    f"episodes of {WALKS_STEPS} of 2400 steps, tracking above {WALKS_TRACKING:g} of its maximum"
)


def bars(path: Path) -> Table:
    """All bars of one policy."""
    return judge.table(judge.read(path)["bars"], "")


def seeds(*paths: Path) -> Table:
    """All bars of several policies, side by side."""
    return judge.side_by_side({path.stem: judge.read(path) for path in paths})


def speeds(path: Path) -> Table:
    """Constant commands: one row each."""
    stored = read(path)
    return tables.table(stored["speeds"] if "speeds" in stored else _only(path), "", GAIT)


def sideways(path: Path) -> Table:
    """Constant commands with a turn or a side step."""
    return tables.table(_only(path), "", SIDEWAYS)


def schedules(path: Path) -> Table:
    """Commands that change."""
    return scheduled.table(records.read_conditions(path), "")


def conditions(path: Path) -> Table:
    """Share of the robots that do not fall, and mean vx, by condition and commanded speed."""
    stored = read(path)
    found = stored["perturbed"] if "perturbed" in stored else records.read_conditions(path)
    return _by_speed("survived, mean vx [m/s]", found)


def harsh(path: Path) -> Table:
    """The same of the conditions of judge --harsh."""
    found = read(path)["harsh"]
    named = {f"{name}, {_wanted(part)}": part["rows"] for name, part in found.items()}
    return _by_speed("survived, mean vx [m/s]", named)


def comparison(folder: Path) -> Table:
    """The runs of `kslc_jax.compare`."""
    return compare.table(compare.finished(folder))


def milestones(path: Path) -> Table:
    """When a training reached what, by its metrics."""
    metrics = records.read_metrics(path)
    long = metrics["episode_steps"] > WALKS_STEPS
    walks = long & (metrics["curriculum/tracking"] > WALKS_TRACKING)
    found = [(LEARNT_TO_WALK, int(walks.argmax()))] if walks.any() else []
    for i in records.growth(metrics):
        found.append((f"commands up to {metrics['curriculum/v_max'][i]:.1f} m/s", int(i)))
    found.append(("the end of the run", len(walks) - 1))
    out = Table("what", "environment steps", "wall time")
    for what, i in found:
        seconds = metrics["seconds"][i]
        out.add_row(what, f"{metrics['env_steps'][i] / 1e6:.1f} M", records.in_minutes(seconds))
    return out


def card(policy: Path, training: Path) -> Table:
    """What a policy is: how it was trained, at which commit, how far."""
    from kslc_jax import reproduce
    from kslc_jax.policy import load_policy

    loaded = load_policy(policy)
    metrics = records.read_metrics(training)
    commit = read(training.with_suffix(".versions.json"))["git"]
    name = loaded.config.physics.robot
    robot = "" if name == XBOT_L else f" --robot {name}"
    older = reproduce.of_an_older_recipe(loaded.config)
    length = f"{loaded.step} train steps, {metrics['env_steps'][-1] / 1e6:.1f} M environment steps"
    out = Table("what", "this policy")
    out.add_row("trained by", f"`python -m kslc_jax.train{robot} --seed {loaded.config.seed}`")
    out.add_row("commit", commit)
    out.add_row("recipe", OLDER if older else "that of `make train` today")
    out.add_row("length", f"{length}, {records.in_minutes(metrics['seconds'][-1])}")
    out.add_row("largest command", f"{float(loaded.curriculum.v_max):g} m/s")
    out.add_row("training curve", f"`{training.relative_to(ROOT)}`")
    return out


KINDS: dict[str, Callable[..., Table]] = {
    kind.__name__: kind
    for kind in (
        bars,
        seeds,
        speeds,
        sideways,
        schedules,
        conditions,
        harsh,
        comparison,
        milestones,
        card,
    )
}


def read(path: Path) -> dict[str, Any]:
    """The content of a JSON file."""
    return json.loads(path.read_text())


def _only(path: Path) -> list[Row]:
    """The rows of the only condition of a file of sim2sim --json."""
    (rows,) = records.read_conditions(path).values()
    return rows


def _wanted(part: dict[str, Any]) -> str:
    return f"wanted {part['wanted']:.0%}" if part["wanted"] else REPORTED


def _by_speed(corner: str, found: dict[str, list[Row]]) -> Table:
    commanded = sorted({row["command"] for rows in found.values() for row in rows})
    out = Table(escape(corner), *map(tables.speed, commanded))
    for name, rows in found.items():
        by_speed = {row["command"]: row for row in rows}
        cells = (_survived(by_speed[v]) if v in by_speed else "-" for v in commanded)
        out.add_row(name, *cells)
    return out


def _survived(row: Row) -> str:
    return f"{row['survival']:.0%} {row['forward_mean']:.2f}"


def markdown(table: Table) -> list[str]:
    """The lines of a table in Markdown."""
    columns = [[_plain(str(cell)) for cell in (c.header, *c.cells)] for c in table.columns]
    head, *rows = zip(*columns, strict=True)
    return [_line(head), _line(["---"] * len(head)), *map(_line, rows)]


def _plain(cell: str) -> str:
    """A cell without rich's markup."""
    return Text.from_markup(cell).plain


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def rewritten(text: str) -> str:
    """The text of a page with each marked table made anew."""
    out: list[str] = []
    old = False  # inside the rows of a marked table
    for line in text.splitlines():
        old = old and line.startswith("|")
        if old:
            continue
        out.append(line)
        if mark := MARK.match(line):
            files = (ROOT / name for name in mark["files"].split())
            out += markdown(KINDS[mark["kind"]](*files))
            old = True
    return "\n".join(out) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing, only compare")
    check, differ = parser.parse_args(argv).check, []
    for name in PAGES:
        page = ROOT / name
        before = page.read_text()
        after = rewritten(before)
        if after != before:
            differ.append(name)
            if not check:
                page.write_text(after)
    for name in differ:
        print(f"{name}: {'differs from the data' if check else 'written'}")
    return int(check and bool(differ))


if __name__ == "__main__":
    sys.exit(main())
