"""Measure how well a policy walks and runs: python -m kslc_jax.evaluate POLICY [--speeds 0.5 1.0]

Runs trials of the deterministic policy over commanded forward speeds and seeds. The physics is that
of the policy's training. With --fidelity high it is full C MuJoCo: 1 ms, elliptic cones, converged
solver, self-collision, joint friction. With --ground the floor is uneven. Prints a table with 95 %
confidence intervals; --json writes the numbers to a file.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.progress import Progress

from kslc_jax import cli, files
from kslc_jax.config import Fidelity, require_seed
from kslc_jax.evaluation import options, perturbations
from kslc_jax.evaluation.tables import console, table

if TYPE_CHECKING:
    from kslc_jax.policy import Policy

SPEEDS = (0.0, *options.SPEEDS)
"""Commanded speeds [m/s] of XBot-L, if none are given."""

CONDITIONS = ("fidelity", "ground", "seeds", "seconds", "noise", "seed")
"""Options that the JSON file records."""


@dataclass(frozen=True)
class Args:
    """The trials to run."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    speeds: tuple[float, ...] | None = None
    """Commanded forward speeds [m/s]. None: 0 to 4.0 in steps of 0.5, scaled to the robot's
    size."""
    seeds: int = 8
    """Trials per speed."""
    seconds: float = 20.0
    """Length of a trial [s]."""
    fidelity: Fidelity = "train"
    """train: the training engine. high: full C MuJoCo at 1 ms."""
    ground: str | None = None
    """Uneven ground: rough:M (random waves of up to M metres up and down), slope:DEGREES, or
    stairs:M (steps of M metres). None: the flat floor. kslc_jax.sim2sim compares several."""
    noise: bool = False
    """Sensor noise, action delay and action noise at the full level of training."""
    seed: int = 0
    """Seed of the initial states."""
    json: Path | None = None
    """JSON file to write the numbers to."""

    def __post_init__(self):
        options.check_trials(self.speeds, self.seeds, self.seconds)
        require_seed(self.seed)
        if self.ground is not None:
            perturbations.terrain(self.ground)


def sweep(
    args: Args, policy: "Policy", progress: Callable[[float], None] = lambda share: None
) -> list[dict[str, Any]]:
    """One row of metrics per commanded speed; `beyond`: what the policy was not trained for."""
    from kslc_jax.evaluation import trained, trials
    from kslc_jax.evaluation.measure import measure

    terrain = None if args.ground is None else perturbations.terrain(args.ground)
    engine = trials.engine(policy, args.fidelity, terrain)
    setting = trials.Setting(engine, seconds=args.seconds, noise=args.noise)
    speeds = options.speeds_for(policy.config.physics.robot, args.speeds, SPEEDS)
    rows = measure(policy, setting, speeds, args.seeds, args.seed, progress)
    return [row | trained.beyond(policy, setting, (row["command"], 0.0, 0.0)) for row in rows]


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _report(cli.parse("evaluate", Args, argv, __doc__)))


def _report(args: Args) -> None:
    """Tries the policy, prints the table, writes the numbers."""
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    screen = console()
    with Progress(console=screen, transient=True) as bar:
        task = bar.add_task("trying", total=1.0)
        rows = sweep(args, policy, lambda share: bar.update(task, completed=share))
    title = f"{args.policy}, train step {policy.step}, {args.fidelity} fidelity"
    title += f", {args.ground}" if args.ground else ""
    screen.print(table(rows, title))
    if args.json is not None:
        what = {"policy": policy_name(args.policy), "step": policy.step}
        how = {name: getattr(args, name) for name in CONDITIONS}
        files.write_json(args.json, {**what, **how, "rows": rows})


if __name__ == "__main__":
    sys.exit(main())
