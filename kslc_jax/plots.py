"""Draw figures from stored data:
python -m kslc_jax.plots {training,learning,performance,momentum,schedules,conditions} ...

Examples:
  python -m kslc_jax.plots training runs/laptop-seed0 --out curve.png
  python -m kslc_jax.plots learning runs/compare/* --out learning.png
  python -m kslc_jax.plots performance runs/compare/*/evaluation.json --out performance.png
  python -m kslc_jax.plots momentum runs/compare/*/evaluation.json --out momentum.png
  python -m kslc_jax.plots schedules sim2sim.json --out schedules.png
  python -m kslc_jax.plots conditions sim2sim.json --out conditions.png
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from kslc_jax import cli, files, records
from kslc_jax.cli import Paths
from kslc_jax.errors import UserError
from kslc_jax.records import Curve, Records

PANELS: tuple[tuple[str, str, str], ...] = (
    ("curriculum/v_max", "largest commanded speed [m/s]", "C0"),
    ("curriculum/tracking", "tracking reward, share of maximum", "C1"),
    ("episode_steps", "episode length [control steps]", "C2"),
    ("steps_per_second", "throughput [control steps/s]", "C3"),
)


PERFORMANCE: tuple[tuple[str, str], ...] = (
    ("forward_mean", "mean forward speed [m/s]"),
    ("survival", "share that did not fall"),
    ("forward_std", "forward fluctuation [m/s]"),
    ("lateral_std", "lateral fluctuation [m/s]"),
    ("yaw_rate_std", "yaw-rate fluctuation [rad/s]"),
    ("cost_of_transport", "cost of transport"),
)
MOMENTUM: tuple[tuple[str, str], ...] = (
    ("momentum_yaw_rms", "whole body"),
    ("legs_momentum_yaw_rms", "legs"),
    ("arms_momentum_yaw_rms", "arms"),
)


def learning_curve(runs: dict[str, Records], out: Path) -> None:
    """Draws one panel per quantity and one line per run, with the wall times of the first run."""
    figure = Figure(figsize=(8, 10), layout="constrained")
    axes = figure.subplots(len(PANELS), 1, sharex=True)
    for axis, (name, label, color) in zip(axes, PANELS, strict=True):
        for i, (run, columns) in enumerate(runs.items()):
            line = color if len(runs) == 1 else f"C{i}"
            axis.plot(columns["env_steps"] / 1e6, columns[name], color=line, label=run)
        axis.set_ylabel(label, fontsize=8)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("environment steps [millions]")
    figure.align_ylabels(axes)
    if len(runs) > 1:
        axes[0].legend(fontsize=8)
    first = next(iter(runs.values()))
    for v, steps, seconds in records.milestones(first):
        axes[0].annotate(
            f"{v:.1f} m/s\n{records.in_minutes(seconds)}",
            (steps / 1e6, v),
            textcoords="offset points",
            xytext=(4, -16),
            fontsize=7,
        )
    _save(figure, out)


def learning(methods: dict[str, list[Curve]], out: Path) -> None:
    """Draws the paper's learning curves: mean forward speed over environment steps.

    Each commanded speed has a panel. A line is the mean over seeds, a band their range.
    """
    speeds = next(iter(methods.values()))[0].speeds
    figure, axes = _panels(len(speeds))
    for j, (axis, speed) in enumerate(zip(axes, speeds, strict=True)):
        for i, (method, seeds) in enumerate(methods.items()):
            steps, values = seeds[0].env_steps / 1e6, np.array([c.reached[:, j] for c in seeds])
            axis.plot(steps, values.mean(0), "o-", color=f"C{i}", label=method, markersize=2)
            low, high = values.min(0), values.max(0)
            axis.fill_between(steps, low, high, color=f"C{i}", alpha=0.2, linewidth=0)
        axis.axhline(speed, color="k", linestyle=":", linewidth=1)
        axis.set_title(f"{speed:g} m/s commanded", fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    figure.supxlabel("environment steps [millions]", fontsize=10)
    figure.supylabel("mean forward speed [m/s]", fontsize=10)
    _legend(figure)
    _save(figure, out)


def _panels(count: int, **style):
    """A figure of `count` panels, at most four in a row, and its axes."""
    columns = min(count, 4)
    rows = -(-count // columns)
    size = (3.5 * columns, 3 * rows + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False, **style)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    for axis in axes.flat[count - columns : count]:
        axis.tick_params(labelbottom=True)  # these panels are the lowest of their columns
    return figure, list(axes.flat[:count])


def _legend(figure) -> None:
    """Draws one legend above all panels. A label that several panels have appears once."""
    found = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    columns = min(len(found), 8)
    figure.legend(
        list(found.values()), list(found), loc="outside upper center", ncols=columns, fontsize=8
    )


def _over_commands(axis, label: str, color: str, seeds: list[list[dict]], name: str, **style):
    """Draws a metric over the commanded speed: mean over seeds, and their range."""
    commands = [row["command"] for row in seeds[0]]
    values = np.array([[row.get(name, np.nan) for row in rows] for rows in seeds])
    # A row in which all robots fell lacks the metric. Such seeds are left out, and speeds without
    # any other seed.
    known = ~np.isnan(values).all(0)
    values, commands = values[:, known], np.array(commands)[known]
    low, high = np.nanmin(values, 0), np.nanmax(values, 0)
    axis.plot(
        commands, np.nanmean(values, 0), "o-", color=color, label=label, markersize=3, **style
    )
    axis.fill_between(commands, low, high, color=color, alpha=0.2, linewidth=0)


def performance(methods: dict[str, list[list[dict]]], out: Path) -> None:
    """Draws the paper's performance figure: one panel per metric, over the commanded speed."""
    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    for axis, (name, label) in zip(axes.flat, PERFORMANCE, strict=True):
        for i, (method, seeds) in enumerate(methods.items()):
            _over_commands(axis, method, f"C{i}", seeds, name)
        axis.set_title(label, fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    top = max(row["command"] for seeds in methods.values() for row in seeds[0])
    axes[0, 0].plot([0, top], [0, top], "k:", linewidth=1, label="commanded")
    _legend(figure)
    for axis in axes[1]:
        axis.set_xlabel("commanded speed [m/s]")
    _save(figure, out)


def momentum(methods: dict[str, list[list[dict]]], out: Path) -> None:
    """Draws the yaw angular momentum of whole body, legs and arms: one panel per method."""
    figure, axes = _panels(len(methods), sharey=True)
    for axis, (method, seeds) in zip(axes, methods.items(), strict=True):
        for i, (name, label) in enumerate(MOMENTUM):
            _over_commands(axis, label, f"C{i}", seeds, name)
        axis.set_title(method, fontsize=9)
        axis.grid(alpha=0.3)
    axes[0].set_ylim(bottom=0)
    figure.supxlabel("commanded speed [m/s]", fontsize=10)
    figure.supylabel("yaw angular momentum, rms [kg m²/s]", fontsize=10)
    _legend(figure)
    _save(figure, out)


def schedules(rows: list[dict], out: Path) -> None:
    """Draws commanded and actual speed over time: a column per schedule, a row per robot."""
    robots = max(len(row["series"]["forward"]) for row in rows)
    size = (5 * len(rows), 2 * robots + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(robots, len(rows), sharex=True, sharey=True, squeeze=False)
    for column, row in zip(axes.T, rows, strict=True):
        column[0].set_title(f"{row['schedule']}: {row['survival']:.0%} survived", fontsize=9)
        lines = row["series"]
        for axis, asked, actual in zip(column, lines["commanded"], lines["forward"], strict=False):
            seconds = lines["every"] * np.arange(len(asked))
            axis.plot(seconds, np.array(asked, float), "k:", linewidth=1, label="commanded")
            axis.plot(seconds, np.array(actual, float), "C0", linewidth=1, label="actual")
            if None in actual:
                axis.axvline(lines["every"] * actual.index(None), color="C3", label="fell")
            axis.grid(alpha=0.3)
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel("forward speed [m/s]", fontsize=10)
    _legend(figure)
    _save(figure, out)


def conditions(results: dict[str, list[dict]], out: Path) -> None:
    """Draws a table: a row per condition, a column per commanded speed or schedule.

    The colour of a field is the share of the robots that did not fall. The text adds their mean
    forward speed [m/s], under constant commands.
    """
    columns = [records.row_name(row) for row in next(iter(results.values()))]
    survival = np.array([[row["survival"] for row in rows] for rows in results.values()])
    size = (2.5 + 1.1 * len(columns), 1.2 + 0.45 * len(results))
    figure = Figure(figsize=size, layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(survival, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
    for i, rows in enumerate(results.values()):
        for j, row in enumerate(rows):
            text = f"{row['survival']:.0%}" + "*" * ("beyond" in row)
            if "schedule" not in row and "forward_mean" in row:
                text += f"\n{row['forward_mean']:.2f}"
            color = "black" if row["survival"] > 0.5 else "white"
            axis.text(j, i, text, ha="center", va="center", fontsize=8, color=color)
    axis.set_xticks(range(len(columns)), columns)
    axis.set_yticks(range(len(results)), list(results))
    axis.tick_params(length=0)
    figure.colorbar(image, label="share that did not fall", format="{x:.0%}")
    figure.supxlabel("commanded; below the share: mean speed [m/s]; *: beyond training", fontsize=8)
    _save(figure, out)


def _save(figure: Figure, out: Path) -> None:
    files.require_writable(out)
    with files.saving(out) as part:
        figure.savefig(part, dpi=130)


@dataclass(frozen=True)
class Training:
    """The course of a training over its environment steps: range of commanded speeds, tracking,
    episode length, throughput. Also prints when the range grew."""

    runs: Paths
    """Run folders or metrics.jsonl files."""
    out: Path = Path("learning_curve.png")
    """File of the figure."""


@dataclass(frozen=True)
class Learning:
    """Mean forward speed over environment steps, one panel per commanded speed."""

    runs: Paths
    """learning.json files, or run folders in which kslc_jax.learning has written one. Runs of the
    name METHOD-seedN are grouped by method."""
    out: Path = Path("learning.png")
    """File of the figure."""


@dataclass(frozen=True)
class Performance:
    """Speed, survival and fluctuations over the commanded speed; mean and range over seeds."""

    evaluations: Paths
    """JSON files of evaluate or sim2sim; those in METHOD-seedN folders are grouped by method."""
    out: Path = Path("performance.png")
    """File of the figure."""


@dataclass(frozen=True)
class Momentum:
    """Yaw angular momentum of arms, legs and whole body over the commanded speed."""

    evaluations: Paths
    """JSON files of evaluate or sim2sim; those in METHOD-seedN folders are grouped by method."""
    out: Path = Path("momentum.png")
    """File of the figure."""


@dataclass(frozen=True)
class Schedules:
    """Commanded and actual speed of a few robots over time, under each schedule."""

    results: tyro.conf.Positional[Path]
    """JSON file of sim2sim --schedule."""
    condition: str = "nominal"
    """The perturbation, ground or heading to draw."""
    out: Path = Path("schedules.png")
    """File of the figure."""


@dataclass(frozen=True)
class Conditions:
    """Survival and mean speed under each condition: perturbations, grounds, starting headings."""

    results: tyro.conf.Positional[Path]
    """JSON file of sim2sim."""
    out: Path = Path("conditions.png")
    """File of the figure."""


Drawing = Training | Learning | Performance | Momentum | Schedules | Conditions


def draw(args: Drawing) -> None:
    """Draws the figure of `args`.

    Raises:
      ValueError: its data are missing or unreadable.
      ConfigError: the file cannot be written.
    """
    files.require_suffix(args.out, files.FIGURES)
    if isinstance(args, Schedules):
        return schedules(records.read_schedules(args.results, args.condition), args.out)
    if isinstance(args, Conditions):
        return conditions(records.read_conditions(args.results), args.out)
    if not (args.runs if isinstance(args, Training | Learning) else args.evaluations):
        raise ValueError("name at least one file or run folder")
    match args:
        case Training():
            _training(args)
        case Learning():
            learning(records.read_learning(args.runs), args.out)
        case Performance():
            performance(records.read_evaluations(args.evaluations), args.out)
        case Momentum():
            momentum(records.read_evaluations(args.evaluations), args.out)


def _training(args: Training) -> None:
    runs = {str(path): records.read_metrics(path) for path in args.runs}
    for run, columns in runs.items():
        print(run)
        for v, steps, seconds in records.milestones(columns):
            after = f"{steps / 1e6:5.1f} M steps, {records.in_minutes(seconds):>7}"
            print(f"  v_max {v:.1f} m/s at {after}")
    learning_curve(runs, args.out)


def _run(args: Drawing) -> None:
    try:
        draw(args)
    except ValueError as error:
        raise UserError(str(error)) from error
    print(f"wrote {args.out}")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    kinds: Any = Drawing
    return cli.run(lambda: _run(cli.parse("plots", kinds, argv, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
