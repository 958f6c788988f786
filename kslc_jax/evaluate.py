"""How well a policy walks and runs: python -m kslc_jax.evaluate POLICY [--speeds 0.5 1.0 ...]

Sweeps commanded forward speeds x seeds with the deterministic policy, in the engine it was
trained in, or with --fidelity high in full C MuJoCo: 1 ms, elliptic cones, converged solver,
self-collision, joint friction. Prints a table with 95 % confidence intervals; --json keeps it.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import files, runtime
from kslc_jax.config import ConfigError, Fidelity, require_seed

HEADLINE = (
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

ASIDE = (
    *HEADLINE[:3],
    ("lateral_mean", "mean vy [m/s]", "{:.2f}"),
    ("yaw_rate_mean", "mean yaw rate [rad/s]", "{:.2f}"),
    *HEADLINE[3:],
)
"""The same where a side step or a turn is asked for, too: they follow the mean forward speed."""

MOST_SAMPLES = 2_000_000
"""Control steps of all trials whose traces are held in memory at once, about 300 bytes each."""

SHORTEST = 3.0
"""Seconds below which nothing is left of a trial after the time to gather speed."""

LONGEST = 86_400.0
"""A day."""


@dataclass(frozen=True)
class Args:
    """What to try."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    speeds: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Commanded forward speeds [m/s]."""
    seeds: int = 8
    """Trials per speed."""
    seconds: float = 20.0
    """Length of a trial."""
    fidelity: Fidelity = "train"
    """train: the training engine. high: full C MuJoCo at 1 ms."""
    noise: bool = False
    """Sensor noise, action delay and action noise, the most that training has."""
    seed: int = 0
    """Of initial states."""
    json: Path | None = None
    """Where to keep the numbers."""

    def __post_init__(self):
        check(self.speeds, self.seeds, self.seconds)
        require_seed(self.seed)


def check(speeds: Sequence[float], seeds: int, seconds: float) -> None:
    """ConfigError where there is nothing to try or to measure."""
    if not (speeds and all(map(math.isfinite, speeds))):
        raise ConfigError("speeds: name at least one, finite")
    if seeds <= 0:
        raise ConfigError("seeds must be positive")
    if not (SHORTEST <= seconds <= LONGEST and seconds == round(seconds)):
        raise ConfigError(f"seconds must be a whole number from {SHORTEST:g} to {LONGEST:g}")


def measure(
    policy,
    setting,
    speeds,
    seeds: int,
    seed: int = 0,
    progress=lambda share: None,
    describe=None,
    beside: tuple[float, float] = (0.0, 0.0),
) -> list[dict[str, float]]:
    """One row of metrics per commanded forward speed [m/s], over `seeds` trials each.

    Args:
      policy: who is tried.
      setting: conditions, a `trials.Setting`.
      speeds: commands.
      seeds: trials per command.
      seed: of initial states and randomisation.
      progress: told the share that is done.
      describe: the metrics of a trace; None: all of them, `gait_metrics.summary`.
      beside: side step [m/s, to the left] and turn [rad/s, to the left] commanded with every speed.
    """
    import jax
    import numpy as np

    from kslc_jax import gait_metrics, physics, trials

    describe = describe or gait_metrics.summary
    robot, dt = physics.robot_for(setting.physics), setting.physics.control_dt
    at_once = max(1, MOST_SAMPLES // (seeds * round(setting.seconds / dt)))
    rows = []
    for start in range(0, len(speeds), at_once):
        group = speeds[start : start + at_once]
        velocities = np.array([(speed, *beside) for speed in group for _ in range(seeds)])
        pieces = []
        for piece in trials.run(policy, setting, velocities, seed):
            pieces.append(piece)
            done = len(pieces) / round(setting.seconds)
            progress((start + done * len(group)) / len(speeds))
        for i, speed in enumerate(group):
            mine = slice(i * seeds, (i + 1) * seeds)
            part = [jax.tree.map(lambda x, mine=mine: x[:, mine], piece) for piece in pieces]
            numbers = describe(trials.join(part), speed, robot, dt)
            rows.append({"command": speed} | numbers)
    return rows


def sweep(args: Args, policy, progress=lambda share: None) -> list[dict[str, float]]:
    """One row of metrics per commanded speed."""
    from kslc_jax import trials

    engine = trials.engine(policy, args.fidelity)
    setting = trials.Setting(engine, seconds=args.seconds, noise=args.noise)
    return measure(policy, setting, args.speeds, args.seeds, args.seed, progress)


def table(rows: list[dict[str, float]], title: str, columns=HEADLINE):
    """The numbers of those columns as a rich table."""
    from rich.markup import escape
    from rich.table import Table

    marked = any("beyond" in row for row in rows)
    caption = "* beyond what the policy was trained for" if marked else None
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for label in ("command [m/s]", *(label for _, label, _ in columns)):
        out.add_column(escape(label), justify="right")  # rich would take [m/s] for a style
    for row in rows:
        cells = [form.format(row[name]) if name in row else "-" for name, _, form in columns]
        out.add_row(f"{row['command']:.1f}" + "*" * ("beyond" in row), *cells)
    return out


def console():
    """A rich console as wide as the terminal, or where there is none as wide as the table."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else 180)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    runtime.prepare()
    from kslc_jax.checkpoint import CheckpointError

    try:
        _report(tyro.cli(Args, args=argv, description=__doc__, prog="python -m kslc_jax.evaluate"))
    except (CheckpointError, ConfigError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _report(args: Args) -> None:
    """Tries the policy, prints the table, keeps the numbers."""
    from rich.progress import Progress

    from kslc_jax.checkpoint import load_policy

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    screen = console()
    with Progress(console=screen, transient=True) as bar:
        task = bar.add_task("trying", total=1.0)
        rows = sweep(args, policy, lambda share: bar.update(task, completed=share))
    title = f"{args.policy}, train step {policy.step}, {args.fidelity} fidelity"
    screen.print(table(rows, title))
    if args.json is not None:
        what = {"policy": str(args.policy), "step": policy.step}
        how = {n: getattr(args, n) for n in ("fidelity", "seeds", "seconds", "noise", "seed")}
        files.write_json(args.json, {**what, **how, "rows": rows})


if __name__ == "__main__":
    sys.exit(main())
