"""Find out who falls: python -m kslc_jax.falls POLICY [--robots 128] [--json out.json]

Robots whose masses, motors and friction differ get random commands, with stops and reversals from
the top speed: the same robots and the same commands in the engine of the training and at high
fidelity. Prints for both which share of them fell, which commands came before, and the numbers that
decide: those in which robots that fell differ from the others by 3 standard errors or more. For
each it gives the share that fell of the quarter of robots with the least of it, and so on to the
quarter with the most.

If more robots fall in the training than at high fidelity, the training is harder than what it
prepares for; if fewer, it misses something. Either way the number that decides says where to look.
More robots show more: with 64, only a strong effect stands out.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.

Examples:
  python -m kslc_jax.falls runs/laptop-seed0
  python -m kslc_jax.falls runs/laptop-seed0 --robots 256 --fidelity train
  python -m kslc_jax.falls xbot_l_run --schedule jitter --top 3.5 --json falls.json
"""

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from kslc_jax import cli, files
from kslc_jax.config import ConfigError, Fidelity, require_seed
from kslc_jax.evaluation import options, tables

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from kslc_jax.evaluation.schedules import Schedule
    from kslc_jax.policy import Policy

LEAST_ROBOTS = 16


@dataclass(frozen=True)
class Args:
    """The policy, the robots, and their commands."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    robots: int = 64
    """Number of robots."""
    seconds: float = 60.0
    """Length of a trial [s]."""
    fidelity: tuple[Fidelity, ...] = ("train", "high")
    """train: the engine of the training. high: full C MuJoCo at 1 ms, some ten times slower."""
    schedule: str = "random"
    """Commands, as of sim2sim --schedule."""
    top: float | None = None
    """Fastest command [m/s]; None: the fastest command of the policy's training."""
    seed: int = 0
    """Seed of the robots, their initial states and commands."""
    json: Path | None = None
    """JSON file to write the numbers to, with each fall."""

    def __post_init__(self):
        require_seed(self.seed)
        if self.robots < LEAST_ROBOTS:
            raise ConfigError(f"robots must be at least {LEAST_ROBOTS}")
        if not self.fidelity or len(set(self.fidelity)) < len(self.fidelity):
            raise ConfigError("fidelity: name train, high, or both")
        options.check_trials(None, self.robots, self.seconds)
        options.check_disturbances(0.0, self.top, scheduled=True)


def measure(
    policy: "Policy",
    args: Args,
    schedule: "Schedule",
    fidelity: Fidelity,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """What `suspects.report` says of the trials of one fidelity.

    It calls `progress` with the share [] that is done.
    """
    import numpy as np

    from kslc_jax.evaluation import judging, reaction, suspects, trials

    setting = trials.Setting(
        trials.engine(policy, fidelity),
        randomize=judging.robots_that_differ(policy.config.physics.robot),
        seconds=args.seconds,
        schedule=schedule,
    )
    pieces, commands = [], np.zeros((args.robots, 3))
    for piece in trials.run(policy, setting, commands, args.seed):
        pieces.append(piece)
        progress(len(pieces) / args.seconds)
    trace = trials.join(pieces)
    falls = reaction.falls(trace, setting.physics.control_dt)
    drawn = trials.drawn(policy, setting, args.robots, args.seed)
    return suspects.report(~np.asarray(trace.alive)[-1], drawn, falls)


def table(found: dict[str, dict[str, Any]], title: str):
    """Who fell, as a rich table: one line for each number that stands out."""
    from rich.markup import escape
    from rich.table import Table

    caption = "Quarters: of the robots with the least of the number, to those with the most."
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for label in ("fidelity", "fell", "after commands [m/s]", "decides"):
        out.add_column(escape(label))
    for label in ("least", "", "", "most"):
        out.add_column(label, justify="right")
    for fidelity, of in found.items():
        told = ", ".join(f"{name} ({times})" for name, times in of["commands"])
        first = (fidelity, f"{of['fell']:.0%} of {of['robots']}", told)
        nothing: dict[str, Any] = {"name": "no number" if of["falls"] else "-", "shares": ()}
        for i, suspect in enumerate(of["suspects"] or [nothing]):
            shares = (f"{share:.0%}" for share in suspect["shares"])
            out.add_row(*(first if i == 0 else ("", "", "")), escape(suspect["name"]), *shares)
    return out


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _report(cli.parse("falls", Args, argv, __doc__)))


def _report(args: Args) -> None:
    """Tries the robots, prints the table, writes the numbers."""
    from rich.progress import Progress

    from kslc_jax.evaluation import schedules
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    v_max = float(policy.curriculum.v_max)
    schedule = schedules.named(args.schedule, policy.config, v_max, args.top)
    screen, found = tables.console(), {}
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in args.fidelity}
        for name in args.fidelity:
            bar.start_task(tasks[name])

            told = functools.partial(_advance, bar, tasks[name])
            found[name] = measure(policy, args, schedule, name, told)
    title = f"{args.policy}, train step {policy.step}, schedule {schedule.name}"
    screen.print(table(found, f"{title} to {schedule.top:g} m/s, {args.seconds:g} s"))
    if args.json is not None:
        about = {"policy": policy_name(args.policy), "step": policy.step}
        asked = {"schedule": schedule.name, "top": schedule.top, "seconds": args.seconds}
        files.write_json(args.json, about | asked | {"seed": args.seed, "fidelities": found})


def _advance(bar: "Progress", task: "TaskID", share: float) -> None:
    bar.update(task, completed=share)


if __name__ == "__main__":
    sys.exit(main())
