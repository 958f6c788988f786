"""Figures from stored data: python -m kslc_jax.plots RUN... --out curve.png

Each RUN is a run folder or a metrics.jsonl. Prints when the commanded-speed range grew, and draws
the learning curve over environment steps: speed range, tracking, episode length, throughput.
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

Records = dict[str, np.ndarray]

PANELS: tuple[tuple[str, str, str], ...] = (
    ("curriculum/v_max", "largest commanded speed [m/s]", "C0"),
    ("curriculum/tracking", "tracking reward, share of maximum", "C1"),
    ("episode_steps", "episode length [control steps]", "C2"),
    ("steps_per_second", "throughput [control steps/s]", "C3"),
)


def read_metrics(path: Path) -> Records:
    """Columns of a metrics.jsonl, or of the one in a run folder; ValueError if there is none."""
    path = path / "metrics.jsonl" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"no metrics.jsonl at {path}")
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    if not rows:
        raise ValueError(f"{path} is empty")
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


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
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)
    plt.close(figure)


@dataclass(frozen=True)
class Args:
    """Learning curves of one or more runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders or metrics.jsonl files."""
    out: Path = Path("learning_curve.png")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__)
    try:
        runs = {str(path): read_metrics(path) for path in args.runs}
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for run, records in runs.items():
        print(run)
        for v, steps, seconds in milestones(records):
            print(f"  v_max {v:.1f} m/s at {steps / 1e6:5.1f} M steps, {seconds / 60:3.0f} min")
    learning_curve(runs, args.out)
    print(f"wrote {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
