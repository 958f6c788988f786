"""Find out who falls: python -m kslc_jax.falls POLICY [--robots 128] [--json out.json]

Robots whose masses, motors and friction differ get random commands, with stops and reversals from
the top speed: the same robots and the same commands in the engine of the training and at high
fidelity. Prints for both which share of them fell, which commands came before (fast: above half of
the top speed), and the numbers that go with falls. The robots are sorted by each number and cut
into quarters. A number is listed if the quarters differ more than chance does once in a thousand,
with the share that fell of each quarter.

If more robots fall in training than at high fidelity, training is harder than the judgement; if
fewer, training misses something. The number that goes with the falls says where to look. More
robots show more: with 64, only a strong effect stands out.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.

Examples:
  python -m kslc_jax.falls runs/laptop-seed0
  python -m kslc_jax.falls runs/laptop-seed0 --robots 256 --fidelity train
  python -m kslc_jax.falls xbot_l_run --schedule jitter --top 3.5 --json falls.json
"""

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
    from kslc_jax.evaluation.schedules import Schedule
    from kslc_jax.evaluation.trials import Setting
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
    """train: the engine of the training. high: full C MuJoCo at 1 ms, several times slower."""
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


def setting(policy: "Policy", args: Args, schedule: "Schedule", fidelity: Fidelity) -> "Setting":
    """The setting of the trials at one fidelity. ConfigError if the policy cannot be tried so."""
    from kslc_jax.evaluation import judging, trials

    return trials.Setting(
        trials.engine(policy, fidelity),
        randomize=judging.robots_that_differ(policy.config.physics.robot),
        seconds=args.seconds,
        schedule=schedule,
    )


def measure(
    policy: "Policy",
    setting: "Setting",
    robots: int,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """What `suspects.report` says of the trials of one setting, which has a schedule.

    It calls `progress` with the share [] that is done.
    """
    import numpy as np

    from kslc_jax import physics
    from kslc_jax.evaluation import scheduled, suspects, trials

    assert setting.schedule
    (row,) = scheduled.measure(policy, setting, [setting.schedule], robots, seed, progress)
    fell = np.zeros(robots, bool)
    fell[[fall["robot"] for fall in row["falls"]]] = True
    drawn = trials.drawn(policy, setting, robots, seed)
    can_matter = suspects.numbers(drawn, physics.robot_for(setting.physics))
    return suspects.report(fell, can_matter, row["falls"], setting.schedule.top)


def table(found: dict[str, dict[str, Any]], title: str):
    """Who fell, as a rich table: one line for each number that goes with the falls."""
    from rich.markup import escape
    from rich.table import Table

    caption = "Right: share that fell in each quarter of the robots, sorted by the number."
    out = Table(title=escape(title), title_justify="left", caption=caption, caption_justify="left")
    for label in ("fidelity", "fell", "after commands", "goes with"):
        out.add_column(label)
    for label in ("least", "", "", "most"):
        out.add_column(label, justify="right")
    for fidelity, of in found.items():
        told = ", ".join(f"{name} ({times})" for name, times in of["commands"])
        first = (fidelity, f"{of['fell']:.0%} of {of['robots']}", told)
        nothing = {"name": "no number" if of["enough_to_tell"] else "too few to tell", "shares": ()}
        lines: list[dict[str, Any]] = of["suspects"] or [nothing]
        for i, suspect in enumerate(lines):
            shares = (f"{share:.0%}" for share in suspect["shares"])
            out.add_row(*(first if i == 0 else ("", "", "")), escape(suspect["name"]), *shares)
    return out


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _report(cli.parse("falls", Args, argv, __doc__)))


def _report(args: Args) -> None:
    """Tries the robots, prints the table, writes the numbers."""
    from rich.progress import Progress

    from kslc_jax import physics
    from kslc_jax.evaluation import schedules
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    v_max = float(policy.curriculum.v_max)
    plan = schedules.named(args.schedule, policy.config, v_max, args.top)
    settings = {name: setting(policy, args, plan, name) for name in args.fidelity}
    screen, found = tables.console(), {}
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in settings}
        for name, conditions in settings.items():
            bar.start_task(tasks[name])
            told = lambda share, task=tasks[name]: bar.update(task, completed=share)  # noqa: E731
            found[name] = measure(policy, conditions, args.robots, args.seed, told)
    title = f"{args.policy}, train step {policy.step}, schedule {plan.name}"
    screen.print(table(found, f"{title} to {plan.top:g} m/s, {args.seconds:g} s"))
    if args.json is not None:
        robot = physics.robot_for(policy.config.physics).name
        about = {"policy": policy_name(args.policy), "step": policy.step, "robot": robot}
        asked = {"schedule": plan.name, "top": plan.top, "seconds": args.seconds}
        files.write_json(args.json, about | asked | {"seed": args.seed, "fidelities": found})


if __name__ == "__main__":
    sys.exit(main())
