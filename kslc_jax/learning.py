"""Measure the learning curve of each commanded speed: python -m kslc_jax.learning RUN [RUN ...]

Evaluates the policies that a training kept along the way (--run.snapshots). They run at fixed
commands in full C MuJoCo, because a policy that runs well in the training engine may fall there.
With --fidelity train they run in the training engine, which is faster. Writes learning.json into
the run folder. `python -m kslc_jax.plots learning` draws it, and groups the seeds of one method.

Examples:
  python -m kslc_jax.learning runs/laptop-seed0 runs/laptop-seed1
  python -m kslc_jax.plots learning runs/laptop-seed0 runs/laptop-seed1 --out learning.png
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import Progress

from kslc_jax import cli, files
from kslc_jax.cli import Paths
from kslc_jax.config import ConfigError, Fidelity
from kslc_jax.evaluation import options

SPEEDS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
"""Commanded speeds [m/s] of XBot-L, if none are given."""


@dataclass(frozen=True)
class Args:
    """The runs, and the trials of their policies."""

    runs: Paths
    """Run folders."""
    speeds: tuple[float, ...] | None = None
    """Commanded forward speeds [m/s]. None: 0.5 to 3.5 in steps of 0.5, scaled to the robot's
    size."""
    seeds: int = 4
    """Trials per speed and policy."""
    seconds: float = 10.0
    """Length of a trial [s]."""
    fidelity: Fidelity = "high"
    """high: full C MuJoCo at 1 ms. train: the engine of the training."""

    def __post_init__(self):
        if not self.runs:
            raise ConfigError("name at least one run")
        options.check_trials(self.speeds, self.seeds, self.seconds)


def snapshots(run: Path) -> list[Path]:
    """The policies that a run kept, oldest first; ConfigError if there is none."""
    found = sorted((p for p in run.glob(f"{files.SNAPSHOTS}/*") if p.name.isdigit()), key=_step)
    if not found:
        raise ConfigError(f"{run} holds no snapshots (trained with --run.snapshots 0?)")
    return found


def _step(folder: Path) -> int:
    return int(folder.name)


def curve(
    run: Path, args: Args, progress: Callable[[float], None] = lambda share: None
) -> dict[str, Any]:
    """The content of learning.json: metrics of each snapshot at each speed.

    Args:
      run: run folder.
      args: speeds, number and length of the trials.
      progress: called with the share [] that is done.
    """
    from kslc_jax.evaluation import gait_metrics, trials
    from kslc_jax.evaluation.measure import measure
    from kslc_jax.policy import load_policy

    points = []
    folders = snapshots(run)
    for i, folder in enumerate(folders):
        policy = load_policy(folder)
        setting = trials.Setting(trials.engine(policy, args.fidelity), seconds=args.seconds)
        rows = measure(
            policy,
            setting,
            options.speeds_for(policy.config.physics.robot, args.speeds, SPEEDS),
            args.seeds,
            describe=lambda trace, speed, robot, dt: gait_metrics.speed(trace, speed, dt),
        )
        points.append({"env_steps": policy.step * policy.config.batch_size, "rows": rows})
        progress((i + 1) / len(folders))
    return {
        "run": files.run_name(run),
        "seeds": args.seeds,
        "seconds": args.seconds,
        "fidelity": args.fidelity,
        "points": points,
    }


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _write(cli.parse("learning", Args, argv, __doc__)))


def _write(args: Args) -> None:
    """Evaluates the policies of every run and writes learning.json into the run folders."""
    for run in args.runs:
        snapshots(run)
        files.require_writable(run / files.LEARNING)
    with Progress(transient=True) as bar:
        for run in args.runs:
            task = bar.add_task(str(run), total=1.0)
            found = curve(run, args, lambda done, task=task: bar.update(task, completed=done))
            files.write_json(run / files.LEARNING, found)
            bar.console.print(f"wrote {run / files.LEARNING}")


if __name__ == "__main__":
    sys.exit(main())
