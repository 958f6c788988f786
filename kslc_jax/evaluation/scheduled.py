"""Trials of a policy under schedules, and the table of their metrics."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kslc_jax.evaluation import reaction, tables, trained, trials
from kslc_jax.evaluation.schedules import Schedule
from kslc_jax.policy import Policy

COLUMNS = (
    ("survival", "survived", "{:.0%}"),
    ("seconds_to_fall", "fell at [s]", "{:.0f}"),
    ("way_points", "way-points a minute", "{:.1f}"),
    ("given_up", "given up", "{:.1f}"),
    ("changes", "changes", "{:.1f}"),
    ("forward_mean", "mean vx [m/s]", "{:.2f}"),
    ("change_error", "error after a change [m/s]", "{:.2f}"),
    ("settled", "settled", "{:.0%}"),
    ("settle_seconds", "after [s]", "{:.1f}"),
    ("stopped", "stopped", "{:.0%}"),
    ("stop_seconds", "within [s]", "{:.1f}"),
    ("stop_metres", "within [m]", "{:.2f}"),
    ("drift", "drift at rest [m/s]", "{:.3f}"),
    ("yaw_rate_std", "yaw std", "{:.2f}"),
)
"""(metric, heading, format) of the columns. A table has those that one of its rows needs."""


def measure(
    policy: Policy,
    setting: trials.Setting,
    schedules: Sequence[Schedule],
    robots: int,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> list[dict[str, Any]]:
    """One row per schedule: metrics of `reaction`, falls, and the speeds of a few robots.

    Args:
      policy: acts deterministically.
      setting: conditions; `schedules` replaces its schedule.
      schedules: commands over time.
      robots: trials per schedule.
      seed: seed of initial states, robots and drawn commands.
      progress: called with the share [] that is done.
    """
    dt, rows = setting.physics.control_dt, []
    for i, schedule in enumerate(schedules):
        tried = replace(setting, schedule=schedule)
        pieces = []
        for piece in trials.run(policy, tried, np.zeros((robots, 3)), seed):
            pieces.append(piece)
            progress((i + len(pieces) / round(setting.seconds)) / len(schedules))
        trace = trials.join(pieces)
        what = {"schedule": schedule.name, "top": schedule.top}
        how = {"falls": reaction.falls(trace, dt), "series": reaction.series(trace, dt)}
        numbers = (reaction.tour if schedule.tour else reaction.summary)(trace, dt)
        rows.append(what | numbers | how | trained.beyond(policy, tried))
    return rows


def table(results: dict[str, list[dict[str, Any]]], title: str):
    """All schedules under all conditions as one rich table. * marks rows beyond the training."""
    from rich.markup import escape
    from rich.table import Table

    found = {name for rows in results.values() for row in rows for name in row}
    columns = [column for column in COLUMNS if column[0] in found]
    caption = tables.caption(row for rows in results.values() for row in rows)
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    out.add_column("condition")
    out.add_column("schedule")
    for _, label, _ in columns:
        out.add_column(escape(label), justify="right")  # rich would read [m/s] as a style
    for condition, rows in results.items():
        for row in rows:
            cells = [form.format(row[name]) if name in row else "-" for name, _, form in columns]
            out.add_row(condition, row["schedule"] + "*" * ("beyond" in row), *cells)
    return out
