"""Try a policy in another simulator: python -m kslc_jax.sim2sim POLICY [--perturb all]

Runs trials of the deterministic policy over commanded forward speeds and seeds. The simulator is
full C MuJoCo (1 ms, PD torque at every step, elliptic cones, converged solver, self-collision,
joint friction). With --engine drake it is Drake, which has another contact model and solver. Prints
the table of kslc_jax.evaluate. The options --perturb and --ground repeat the trials with a changed
robot and on uneven ground. With --schedule the commands change during a trial, and the table shows
the robots' reaction. docs/sim2sim.md explains both tables. A * marks conditions beyond the policy's
training.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.

Examples:
  python -m kslc_jax.sim2sim runs/laptop-seed0
  python -m kslc_jax.sim2sim runs/laptop-seed0 --noise --latency --perturb all --json out.json
  python -m kslc_jax.sim2sim runs/laptop-seed0 --perturb friction=0.2 payload=8 --speeds 1 2
  python -m kslc_jax.sim2sim runs/laptop-seed0 --speeds -0.3 0 0.5 --turn 1
  python -m kslc_jax.sim2sim runs/laptop-seed0 --schedule stop random --seeds 16 --json out.json
  python -m kslc_jax.sim2sim runs/laptop-seed0 --schedule my.json --punch 300 --heading 0 3.14159
  python -m kslc_jax.sim2sim runs/laptop-seed0 --ground rough:0.05 slope:10 stairs:0.1 --speeds 1 2
  python -m kslc_jax.sim2sim runs/laptop-seed0 --engine drake --seconds 20 --seeds 2

Your own schedule is a JSON list; it repeats after its end. vy, yaw_rate and heading are optional. A
step has either a yaw_rate or a heading [rad, world]:
  [{"seconds": 5, "vx": 3, "vy": 0, "yaw_rate": 0}, {"seconds": 4, "vx": 0, "heading": 1.57}]
"""

import dataclasses
import functools
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from kslc_jax import cli, files
from kslc_jax.config import ConfigError, PhysicsConfig, require_seed
from kslc_jax.evaluation import options, tables
from kslc_jax.evaluation.perturbations import (
    ALL,
    changes,
    disturbed,
    left_out,
    terrain,
)

if TYPE_CHECKING:
    from kslc_jax.evaluation.trials import Setting
    from kslc_jax.policy import Policy
    from kslc_jax.robot import Robot

MOST_LATENCY = 50
"""Largest delay of the actions [control steps]."""


MUJOCO_ONLY = ("variation", "terrain", "punch")
"""Changes of `perturbations.changes` that Drake does not have."""


@dataclass(frozen=True)
class Args:
    """The policy and the conditions of its trials."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    engine: options.Engine = "mujoco"
    """mujoco: C MuJoCo on all cores. drake: one robot at a time, slow; it needs the package drake
    (pip install 'kslc_jax[drake]')."""
    speeds: tuple[float, ...] | None = None
    """Commanded forward speeds [m/s]. None: 0.5 to 4.0 in steps of 0.5, scaled to the robot's
    size."""
    sideways: float = 0.0
    """Sideways velocity commanded with every speed [m/s], positive to the left."""
    turn: float = 0.0
    """Yaw rate commanded with every speed [rad/s], positive to the left; 0 keeps the heading."""
    seeds: int = 32
    """Trials per speed."""
    seconds: float = 60.0
    """Length of a trial [s]."""
    noise: bool = False
    """Sensor noise, action delay and action noise at the full level of training."""
    latency: int = 0
    """Delay of every action [control steps]; --latency alone means 1."""
    schedule: tuple[str, ...] = ()
    """Commands that change during a trial, in place of --speeds: stop (top speed 5 s, rest 4 s),
    reverse (top speed 5 s, backwards 4 s), box (a new command as in training every 4 s), random
    (the same every 1 to 4 s, with stops and reversals from the top speed), jitter (as random, every
    0.3 to 4 s), turns (at three speeds), tour (way-points), or the path of a JSON file."""
    top: float | None = None
    """Fastest command of a schedule [m/s]; None: the fastest command of the policy's training."""
    heading: tuple[float, ...] = (0.0,)
    """Heading of the robots at the start [rad]. The first value is the nominal one; each further
    value repeats the trials."""
    punch: float = 0.0
    """Force [N] for 0.08 s at a random link in a random direction every 4 s."""
    hold_arms: bool = False
    """The arms follow random targets, at most 0.3 rad/s fast, in place of the policy's actions."""
    ground: tuple[str, ...] = ()
    """Repeat the trials on each of these, as height fields: rough:M (random waves of up to M metres
    up and down), slope:DEGREES (a plane), stairs:M (steps of M metres). Each robot draws the
    direction. The first 0.5 m are flat."""
    perturb: tuple[str, ...] = ()
    """Repeat the trials with each of these: friction=MU, payload=KG on the trunk, com=M (shift
    of the trunk's centre of mass along each of its axes), push=M/S (largest push along x and y,
    every 4 s), gains=FACTOR on kp and kd, strength=FACTOR on the motors' torque, imu=RAD (constant
    error of roll and pitch), links=SHARE (largest change of each link's mass), hands=KG at each
    hand, sole=M (largest distance of a sole's sides from the foot's outline), joints=X (each joint
    gets up to X N m more friction and X N m s/rad more damping), punch=NEWTONS, arms=1 (as
    --hold-arms), heading=RAD at the start; all: sixteen of these, with values that fit the robot's
    size."""
    seed: int = 0
    """Seed of the initial states."""
    json: Path | None = None
    """JSON file to write the numbers to."""

    def __post_init__(self):
        options.check_trials(self.speeds, self.seeds, self.seconds)
        require_seed(self.seed)
        if not all(map(math.isfinite, (self.sideways, self.turn))):
            raise ConfigError("sideways and turn must be finite")
        if not (self.heading and all(map(math.isfinite, self.heading))):
            raise ConfigError("heading: name at least one, finite")
        if not 0 <= self.latency <= MOST_LATENCY:
            raise ConfigError(f"latency must lie in 0 to {MOST_LATENCY} control steps")
        options.check_disturbances(self.punch, self.top, bool(self.schedule))
        if self.schedule and (self.speeds is not None or self.sideways or self.turn):
            raise ConfigError(
                "a schedule has its own commands: leave out speeds, sideways and turn"
            )
        for ground in self.ground:
            terrain(ground)
        for name in self.conditions:
            made = changes(name) if name != "all" else {}
            if self.engine == "drake" and (self.punch or not made.keys().isdisjoint(MUJOCO_ONLY)):
                raise ConfigError("punches, hands, sole, joints and ground need --engine mujoco")

    @property
    def conditions(self) -> tuple[str, ...]:
        """All conditions to try, the nominal one first."""
        turned = (f"heading={yaw:g}" for yaw in self.heading[1:])
        return tuple(dict.fromkeys(("nominal", *turned, *self.ground, *self.perturb)))


def named(args: Args, robot: "Robot") -> tuple[str, ...]:
    """`args.perturb`, with the conditions that fit the robot and the engine in place of "all"."""
    from kslc_jax.evaluation import variation

    possible = [c for c in ALL if args.engine == "mujoco" or "variation" not in changes(c)]
    every = variation.for_robot(possible, robot)
    return tuple(c for name in args.perturb for c in (every if name == "all" else (name,)))


def setting(args: Args, physics: PhysicsConfig, condition: str) -> "Setting":
    """The setting of the trials under one condition."""
    from kslc_jax.evaluation import trials

    plain = trials.Setting(
        physics,
        randomize=disturbed(trials.NOMINAL, args.punch, args.hold_arms),
        seconds=args.seconds,
        noise=args.noise,
        latency=args.latency,
        heading=args.heading[0],
        simulate=options.simulator(args.engine),
    )
    return trials.under(plain, condition)


CONDITIONS = (
    *("engine", "sideways", "turn", "seeds", "seconds", "noise", "latency", "seed"),
    *("schedule", "top", "heading", "punch", "hold_arms"),
)
"""Options that the JSON file records."""

Results = dict[str, list[dict[str, Any]]]


def sweeps(
    args: Args,
    policy: "Policy",
    progress: Callable[[str, float], None] = lambda condition, share: None,
) -> Results:
    """The rows of `measure`, or with a schedule of `scheduled.measure`, for every condition.

    It calls `progress` with the condition and the share [] of it that is done.
    """
    return {
        condition: _rows(args, policy, condition, functools.partial(progress, condition))
        for condition in args.conditions
    }


def _rows(
    args: Args, policy: "Policy", condition: str, progress: Callable[[float], None]
) -> list[dict[str, Any]]:
    """The rows of one condition, with the reasons of `trained.beyond`."""
    from kslc_jax.evaluation import scheduled, schedules, trained, trials
    from kslc_jax.evaluation.measure import measure

    conditions = setting(args, trials.engine(policy, "high"), condition)
    if args.schedule:
        v_max = float(policy.curriculum.v_max)
        plans = [schedules.named(n, policy.config, v_max, args.top) for n in args.schedule]
        return scheduled.measure(policy, conditions, plans, args.seeds, args.seed, progress)
    vy, yaw_rate = args.sideways, args.turn
    speeds = options.speeds_for(policy.config.physics.robot, args.speeds, options.SPEEDS)
    rows = measure(
        policy, conditions, speeds, args.seeds, args.seed, progress, vy=vy, yaw_rate=yaw_rate
    )
    return [
        row | trained.beyond(policy, conditions, (row["command"], vy, yaw_rate)) for row in rows
    ]


def summary(results: Results, title: str) -> Table:
    """Survival and mean speed of every condition and commanded speed."""
    caption = tables.caption(row for rows in results.values() for row in rows)
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    out.add_column(escape("survived, mean vx [m/s]"))
    for row in results["nominal"]:
        out.add_column(tables.speed(row["command"]), justify="right")
    for condition, rows in results.items():
        cells = [
            f"{row['survival']:.0%} {row['forward_mean']:.2f}" + "*" * ("beyond" in row)
            for row in rows
        ]
        out.add_row(condition, *cells)
    return out


def with_latency(argv: list[str]) -> list[str]:
    """Adds a 1 to the command line after a `--latency` that has no number."""
    out: list[str] = []
    for word, after in zip(argv, [*argv[1:], ""], strict=True):
        out += [word, "1"] if word == "--latency" and not after.isdigit() else [word]
    return out


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    argv = with_latency(sys.argv[1:] if argv is None else argv)
    return cli.run(lambda: _report(cli.parse("sim2sim", Args, argv, __doc__)))


def _report(args: Args) -> None:
    """Tries the policy under all conditions, prints the tables, writes the numbers."""
    options.simulator(args.engine)  # fails now if the engine's package is missing
    from kslc_jax import physics
    from kslc_jax.evaluation import schedules, trials
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    engine = trials.engine(policy, "high")
    robot = physics.robot_for(engine)
    wanted = ALL if "all" in args.perturb else ()
    args = dataclasses.replace(args, perturb=named(args, robot))
    options.require_engine(args.engine, robot)  # what is impossible fails before any trial
    for condition in args.conditions:
        trials.require(setting(args, engine, condition), robot)
    v_max = float(policy.curriculum.v_max)
    plans = [schedules.named(name, policy.config, v_max, args.top) for name in args.schedule]
    screen = tables.console()
    if missing := left_out(wanted, args.perturb):
        screen.print(missing)
    # One report per simulated second: the estimate of the remaining time needs a long window.
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in args.conditions}

        def progress(condition: str, share: float) -> None:
            bar.start_task(tasks[condition])
            bar.update(tasks[condition], completed=share)

        results = sweeps(args, policy, progress)
    _show(args, screen, results, f"{args.policy}, train step {policy.step}, {args.engine}")
    if args.json is not None:
        what = {"policy": policy_name(args.policy), "step": policy.step}
        how = {name: getattr(args, name) for name in CONDITIONS}
        how["schedule"] = [plan.name for plan in plans]  # a file's name, not its path
        files.write_json(args.json, {**what, **how, "conditions": results})


def _show(args: Args, screen: Console, results: Results, title: str) -> None:
    """Prints the tables."""
    if args.schedule:
        from kslc_jax.evaluation import scheduled

        screen.print(scheduled.table(results, title))
        return
    columns = tables.HEADLINE
    if args.sideways or args.turn:
        title += f", with {args.sideways:g} m/s sideways and {args.turn:g} rad/s"
        columns = tables.SIDEWAYS_COLUMNS
    for condition, rows in results.items():
        screen.print(tables.table(rows, f"{title}, {condition}", columns))
    if len(results) > 1:
        screen.print(summary(results, title))


if __name__ == "__main__":
    sys.exit(main())
