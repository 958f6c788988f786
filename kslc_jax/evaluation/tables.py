"""Prints metrics as tables. Imports no JAX."""

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

Row = dict[str, float]
"""Metrics of one commanded speed, by name; `command` is that speed [m/s]."""

Columns = tuple[tuple[str, str, str], ...]
"""(metric, heading, format) of each column."""

HEADLINE: Columns = (
    ("survival", "survived", "{:.0%}"),
    ("forward_mean", "mean vx [m/s]", "{:.2f}"),
    ("forward_mean_ci", "+-", "{:.2f}"),
    ("forward_std", "vx std", "{:.2f}"),
    ("lateral_std", "vy std", "{:.2f}"),
    ("yaw_rate_std", "yaw std", "{:.2f}"),
    ("stride_frequency", "strides/s", "{:.2f}"),
    ("flight_share", "flight", "{:.0%}"),
    ("clearance", "clearance [m]", "{:.3f}"),
    ("shoulder_hip_correlation", "arm-leg corr", "{:.2f}"),
    ("stance_difference", "L-R stance", "{:.0%}"),
    ("within_speed_limits", "in speed limits", "{:.1%}"),
    ("cost_of_transport", "CoT", "{:.2f}"),
    ("momentum_yaw_rms", "Lz rms", "{:.2f}"),
)

SIDEWAYS_COLUMNS: Columns = (
    *HEADLINE[:3],
    ("lateral_mean", "mean vy [m/s]", "{:.2f}"),
    ("yaw_rate_mean", "mean yaw rate [rad/s]", "{:.2f}"),
    *HEADLINE[3:],
)
"""Columns for commands with a side step or a turn. They add mean vy and mean yaw rate."""

BEYOND = "* beyond what the policy was trained for; 'beyond' in the JSON says what"
"""Caption of a table with marked rows."""


def caption(rows: Iterable[Mapping[str, Any]]) -> str | None:
    """What an asterisk means, if one of the rows goes beyond the training."""
    return BEYOND if any("beyond" in row for row in rows) else None


def speed(command: float) -> str:
    """A commanded speed [m/s] with one digit, or with as many as it has: 0.5, 0.45."""
    return f"{command:.1f}" if math.isclose(command, round(command, 1)) else f"{command:g}"


def table(rows: Sequence[Row], title: str, columns: Columns = HEADLINE) -> Table:
    """A table with one line per commanded speed. An asterisk marks rows with the entry `beyond`."""
    out = Table(title=title, title_justify="left", caption=caption(rows), caption_justify="left")
    for label in ("command [m/s]", *(label for _, label, _ in columns)):
        out.add_column(escape(label), justify="right")  # rich would read [m/s] as a style
    for row in rows:
        cells = [form.format(row[name]) if name in row else "-" for name, _, form in columns]
        out.add_row(speed(row["command"]) + "*" * ("beyond" in row), *cells)
    return out


def console() -> Console:
    """A console as wide as the terminal; without a terminal, as wide as the table needs."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else 180)
