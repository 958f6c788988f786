"""Figures from stored data: python -m kslc_jax.plots {training,learning,performance,momentum} ...

Examples:
  python -m kslc_jax.plots training runs/laptop-seed0 --out curve.png
  python -m kslc_jax.plots learning runs/compare/* --out learning.png
  python -m kslc_jax.plots performance runs/compare/*/evaluation.json --out performance.png
  python -m kslc_jax.plots momentum runs/compare/*/evaluation.json --out momentum.png
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import tyro

from kslc_jax.learning import LEARNING

Records = dict[str, np.ndarray]

PANELS: tuple[tuple[str, str, str], ...] = (
    ("curriculum/v_max", "largest commanded speed [m/s]", "C0"),
    ("curriculum/tracking", "tracking reward, share of maximum", "C1"),
    ("episode_steps", "episode length [control steps]", "C2"),
    ("steps_per_second", "throughput [control steps/s]", "C3"),
)


COLUMNS = ("env_steps", "seconds", *(name for name, _, _ in PANELS))
"""What a metrics.jsonl has to hold."""

EVALUATION = "evaluation.json"
"""What `compare` calls an evaluation in a run folder."""

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


def read_metrics(path: Path) -> Records:
    """Columns of a metrics.jsonl, or of the one in a run folder; ValueError if there is none."""
    path = path / "metrics.jsonl" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"no metrics.jsonl at {path}")
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        records = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
        _ = [records[name] for name in COLUMNS]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} holds no metrics of a training") from error
    return records


def milestones(records: Records) -> list[tuple[float, float, float]]:
    """(v_max [m/s], environment steps, seconds) at each change of the commanded-speed range."""
    v = records["curriculum/v_max"]
    changed = np.flatnonzero(np.diff(v) > 0) + 1
    return [(v[i], records["env_steps"][i], records["seconds"][i]) for i in changed]


def learning_curve(runs: dict[str, Records], out: Path) -> None:
    """One panel per quantity, one line per run; the top axis is wall time of the first run."""
    figure, axes = plt.subplots(len(PANELS), 1, figsize=(8, 10), sharex=True)
    for axis, (name, label, color) in zip(axes, PANELS, strict=True):
        for i, (run, records) in enumerate(runs.items()):
            line = color if len(runs) == 1 else f"C{i}"
            axis.plot(records["env_steps"] / 1e6, records[name], color=line, label=run)
        axis.set_ylabel(label, fontsize=8)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("environment steps [millions]")
    if len(runs) > 1:
        axes[0].legend(fontsize=8)
    first = next(iter(runs.values()))
    for v, steps, seconds in milestones(first):
        axes[0].annotate(
            f"{v:.1f} m/s\n{seconds / 60:.0f} min",
            (steps / 1e6, v),
            textcoords="offset points",
            xytext=(4, -16),
            fontsize=7,
        )
    _save(figure, out)


def read_evaluations(paths: Sequence[Path]) -> dict[str, list[list[dict[str, float]]]]:
    """Rows of evaluation files by method: the file's name, or where that is evaluation.json its
    folder's, without '-seedN'; ValueError."""
    found: dict[str, list[list[dict[str, float]]]] = {}
    for path in paths:
        try:
            rows = json.loads(path.read_text())["rows"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is no evaluation (made by evaluate --json)") from error
        name = path.resolve().parent.name if path.name == EVALUATION else path.stem
        found.setdefault(_method(name), []).append(rows)
    return found


def _method(run: str) -> str:
    return run.rsplit("-seed", 1)[0]


def read_learning(paths: Sequence[Path]) -> dict[str, list[list[dict]]]:
    """Points of learning.json files, or of those in run folders, by method; ValueError."""
    found: dict[str, list[list[dict]]] = {}
    for path in paths:
        file = path / LEARNING if path.is_dir() else path
        try:
            content = json.loads(file.read_text())
            found.setdefault(_method(content["run"]), []).append(content["points"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file} is no learning curve (made by kslc_jax.learning)") from error
    return found


def learning(methods: dict[str, list[list[dict]]], out: Path) -> None:
    """The paper's learning curves: mean forward speed at each commanded speed over environment
    steps; mean and range over seeds, up to where the shortest of a method ends."""
    speeds = [row["command"] for row in next(iter(methods.values()))[0][0]["rows"]]
    columns = min(len(speeds), 4)
    figure, axes = plt.subplots(
        *(-(-len(speeds) // columns), columns), figsize=(12, 6), sharex=True, squeeze=False
    )
    for i, (method, seeds) in enumerate(methods.items()):
        count = min(map(len, seeds))
        steps = [point["env_steps"] / 1e6 for point in seeds[0][:count]]
        for j, axis in enumerate(axes.flat[: len(speeds)]):
            reached = [[p["rows"][j]["forward_mean"] for p in points[:count]] for points in seeds]
            values = np.array(reached)
            axis.plot(steps, values.mean(0), "o-", color=f"C{i}", label=method, markersize=2)
            low, high = values.min(0), values.max(0)
            axis.fill_between(steps, low, high, color=f"C{i}", alpha=0.2, linewidth=0)
    for axis, speed in zip(axes.flat, speeds, strict=False):
        axis.axhline(speed, color="k", linestyle=":", linewidth=1)
        axis.set_title(f"{speed:g} m/s commanded", fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(speeds) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("environment steps [millions]")
    for axis in axes[:, 0]:
        axis.set_ylabel("mean forward speed [m/s]")
    axes[0, 0].legend(fontsize=8)
    _save(figure, out)


def _over_commands(axis, label: str, color: str, seeds: list[list[dict]], name: str, **style):
    """Mean over seeds of one metric over the commanded speed, and the seeds' range."""
    commands = [row["command"] for row in seeds[0]]
    values = np.array([[row.get(name, np.nan) for row in rows] for rows in seeds])
    axis.plot(commands, values.mean(0), "o-", color=color, label=label, markersize=3, **style)
    axis.fill_between(commands, values.min(0), values.max(0), color=color, alpha=0.2, linewidth=0)


def performance(methods: dict[str, list[list[dict]]], out: Path) -> None:
    """The paper's performance figure: one panel per metric, over the commanded speed."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 6.5), sharex=True)
    for axis, (name, label) in zip(axes.flat, PERFORMANCE, strict=True):
        for i, (method, seeds) in enumerate(methods.items()):
            _over_commands(axis, method, f"C{i}", seeds, name)
        axis.set_title(label, fontsize=9)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    top = max(row["command"] for seeds in methods.values() for row in seeds[0])
    axes[0, 0].plot([0, top], [0, top], "k:", linewidth=1, label="commanded")
    axes[0, 0].legend(fontsize=8)
    for axis in axes[1]:
        axis.set_xlabel("commanded speed [m/s]")
    _save(figure, out)


def momentum(methods: dict[str, list[list[dict]]], out: Path) -> None:
    """Angular momentum about the vertical of whole body, legs and arms, a panel per method."""
    figure, axes = plt.subplots(
        1, len(methods), figsize=(4.5 * len(methods), 4), sharey=True, squeeze=False
    )
    for axis, (method, seeds) in zip(axes[0], methods.items(), strict=True):
        for i, (name, label) in enumerate(MOMENTUM):
            _over_commands(axis, label, f"C{i}", seeds, name)
        axis.set_title(method)
        axis.set_xlabel("commanded speed [m/s]")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("yaw angular momentum, rms [kg m²/s]")
    axes[0, 0].set_ylim(bottom=0)
    axes[0, 0].legend()
    _save(figure, out)


def _save(figure, out: Path) -> None:
    figure.tight_layout()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=130)
    except OSError as error:
        raise ValueError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        plt.close(figure)


@dataclass(frozen=True)
class Training:
    """When the commanded-speed range grew, and the learning curve over environment steps: speed
    range, tracking, episode length, throughput."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders or metrics.jsonl files."""
    out: Path = Path("learning_curve.png")
    """Where the figure goes."""


@dataclass(frozen=True)
class Learning:
    """How each commanded speed was learnt: mean forward speed over environment steps."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders in which kslc_jax.learning was run, or learning.json files; METHOD-seedN folders
    are put together by method."""
    out: Path = Path("learning.png")
    """Where the figure goes."""


@dataclass(frozen=True)
class Performance:
    """Speed, survival and fluctuations over the commanded speed; mean and range over seeds."""

    evaluations: tyro.conf.Positional[tuple[Path, ...]]
    """JSON files of evaluate; those in METHOD-seedN folders are put together by method."""
    out: Path = Path("performance.png")
    """Where the figure goes."""


@dataclass(frozen=True)
class Momentum:
    """Yaw angular momentum of arms, legs and whole body over the commanded speed."""

    evaluations: tyro.conf.Positional[tuple[Path, ...]]
    """JSON files of evaluate; those in METHOD-seedN folders are put together by method."""
    out: Path = Path("momentum.png")
    """Where the figure goes."""


def draw(args: Training | Learning | Performance | Momentum) -> None:
    """Draws the asked figure; ValueError where the data is missing."""
    match args:
        case Training():
            _training(args)
        case Learning():
            learning(read_learning(args.runs), args.out)
        case Performance():
            performance(read_evaluations(args.evaluations), args.out)
        case Momentum():
            momentum(read_evaluations(args.evaluations), args.out)


def _training(args: Training) -> None:
    runs = {str(path): read_metrics(path) for path in args.runs}
    for run, records in runs.items():
        print(run)
        for v, steps, seconds in milestones(records):
            print(f"  v_max {v:.1f} m/s at {steps / 1e6:5.1f} M steps, {seconds / 60:3.0f} min")
    learning_curve(runs, args.out)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = tyro.cli(Training | Learning | Performance | Momentum, args=argv, description=__doc__)
    try:
        draw(args)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"wrote {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
