"""Compare a policy with all bars: python -m kslc_jax.judge POLICY [--quick] [--json out.json]
Compare several seeds: python -m kslc_jax.judge seed0.json seed1.json seed2.json

A bar is a requirement on a metric. The policy runs in full C MuJoCo at high fidelity: at each
commanded speed, under random changes of the command from four starting headings (16 robots whose
masses, motors and friction differ), and with each perturbation of sim2sim. A robot of another size
than XBot-L gets other speeds and perturbations, by dynamic similarity. --harsh adds punches (forces
of 0.08 s), arms that follow random targets, and uneven ground. Prints one table: each bar, its
required value, the worst measured value, and the condition of that value. The exit code is 0 even
if the policy misses a bar. docs/sim2sim.md describes the measurements.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy. Files that --json has
written are read instead: a table shows them side by side, and names the median. One run decides
nothing.

Examples:
  python -m kslc_jax.judge xbot_l_run --quick
  python -m kslc_jax.judge runs/laptop-seed0 --json judged.json
  python -m kslc_jax.judge runs/laptop-seed0 --seeds 32 --harsh --drake
  python -m kslc_jax.judge judged-seed0.json judged-seed1.json judged-seed2.json
"""

import contextlib
import dataclasses
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from kslc_jax import cli, files
from kslc_jax.config import ConfigError, RandomizeConfig, require_seed
from kslc_jax.evaluation import bars as bars_lib
from kslc_jax.evaluation import options, tables
from kslc_jax.evaluation.bars import PERTURBED_TOP, TOP, Bar, bars
from kslc_jax.evaluation.perturbations import ALL, changes, left_out, settings

if TYPE_CHECKING:
    from kslc_jax.robot import Robot

SPEEDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
"""Commanded speeds [m/s]. No bar uses the last one; only --json has its numbers."""

HEADINGS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Starting headings [rad] of the schedule. At pi the measured yaw jumps between pi and -pi."""

SCHEDULE = "random"

DRAKE_SECONDS = 20.0


@dataclass(frozen=True)
class Size:
    """Size of the measurement: speeds [m/s], headings [rad], robots per condition, seconds."""

    speeds: tuple[float, ...]
    seeds: int
    seconds: float
    headings: tuple[float, ...]
    schedule_robots: int
    schedule_seconds: float
    perturbations: tuple[str, ...]
    perturbed_speeds: tuple[float, ...]
    perturbed_seeds: int
    perturbed_seconds: float
    harsh_seeds: int
    harsh_seconds: float
    top: float = TOP  # fastest speed that Drake tries

    def for_robot(self, robot: "Robot") -> "Size":
        """The size for another robot: other speeds, other perturbations."""
        from kslc_jax import similar
        from kslc_jax.evaluation import variation

        factors = similar.factors(robot)

        def own(speeds: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(bars_lib.scaled(speed, factors[similar.SPEED]) for speed in speeds)

        return dataclasses.replace(
            self,
            speeds=own(self.speeds),
            perturbations=variation.for_robot(self.perturbations, robot),
            perturbed_speeds=own(self.perturbed_speeds),
            top=own((self.top,))[0],
        )


FULL = Size(SPEEDS, 4, 60.0, HEADINGS, 16, 60.0, ALL, (1.0, 2.0, PERTURBED_TOP), 4, 20.0, 32, 30.0)
QUICK = Size(
    (0.0, 0.5, 2.0, 3.5, 4.0),
    2,
    15.0,
    (0.0, math.pi),
    8,
    20.0,
    ("push=0.5",),
    (PERTURBED_TOP,),
    2,
    8.0,
    4,
    8.0,
)


@dataclass(frozen=True)
class Args:
    """The policy, and the size of the measurement."""

    policies: tyro.conf.Positional[tuple[Path, ...]]
    """Run folder, checkpoint folder, or name of a shipped policy; or files of --json."""
    quick: bool = False
    """A first look: few speeds, robots and seconds."""
    seeds: int | None = None
    """Trials per speed; None: 4, with --quick 2."""
    seconds: float | None = None
    """Length of the trials at constant speeds [s]; None: 60, with --quick 15."""
    harsh: bool = False
    """Also try the policy under punches of 300 N and of 500 N (reported, no bar), with arms that
    follow random targets, and on uneven ground: 18 times 32 trials of 30 s."""
    drake: bool = False
    """Also try the policy in Drake. This is slow, and needs the package drake."""
    seed: int = 0
    """Seed of initial states, robots and random commands."""
    json: Path | None = None
    """JSON file to write the numbers to, after each part of the measurement."""

    def __post_init__(self):
        require_seed(self.seed)
        if not self.policies:
            raise ConfigError("policies: name a policy, or files of --json")
        if not self.stored and len(self.policies) > 1:
            raise ConfigError(
                "policies: judge one at a time, each with --json; then name those files to compare"
            )
        options.check_trials(self.size.speeds, self.size.seeds, self.size.seconds)

    @property
    def stored(self) -> bool:
        """True if all are files of earlier judgements."""
        return all(path.suffix == ".json" for path in self.policies)

    @property
    def size(self) -> Size:
        """Size of the measurement."""
        asked = {"seeds": self.seeds, "seconds": self.seconds}
        given = {name: value for name, value in asked.items() if value is not None}
        return dataclasses.replace(QUICK if self.quick else FULL, **given)


Results = dict[str, Any]
Progress = Callable[[str, float], None]


def measure(
    size: Size,
    args: Args,
    policy,
    progress: Progress,
    keep: Callable[[Results], None] = lambda found: None,
) -> Results:
    """Measures everything that `bars` reads. Calls `keep` with the results after each part."""
    found: Results = {}
    for name, part in PARTS.items():
        if name not in ("harsh", "drake") or getattr(args, name):
            found[name] = part(size, args, policy, progress)
            keep(found)
    return found


def _speeds(size: Size, args: Args, policy, progress: Progress) -> list[dict[str, float]]:
    from kslc_jax.evaluation import trials
    from kslc_jax.evaluation.measure import measure as measured

    plain = trials.Setting(trials.engine(policy, "high"), seconds=size.seconds)

    def told(share: float) -> None:
        progress("speeds", share)

    rows = measured(policy, plain, size.speeds, size.seeds, args.seed, told)
    return _marked(rows, policy, plain)


def robots_that_differ(name: str) -> RandomizeConfig:
    """The randomisation of the laptop preset for the robot of this name, without pushes, punches.

    All policies of a robot are tried with it, also those of another recipe.
    """
    from kslc_jax import similar

    drawn = similar.preset("laptop", name).randomize
    return dataclasses.replace(drawn, push_seconds=0.0, punch=(0.0, 0.0), held_arms=0.0)


def _schedules(
    size: Size, args: Args, policy, progress: Progress
) -> dict[str, list[dict[str, Any]]]:
    from kslc_jax.evaluation import scheduled, schedules, trials

    found, robots = {}, robots_that_differ(policy.config.physics.robot)
    schedule = schedules.named(SCHEDULE, policy.config, float(policy.curriculum.v_max))
    for i, heading in enumerate(size.headings):

        def told(share: float, i: int = i) -> None:
            progress("schedules", (i + share) / len(size.headings))

        setting = trials.Setting(
            trials.engine(policy, "high"),
            randomize=robots,
            seconds=size.schedule_seconds,
            heading=heading,
        )
        found[f"heading={heading:.2f}"] = scheduled.measure(
            policy, setting, [schedule], size.schedule_robots, args.seed, told
        )
    return found


def _perturbed(
    size: Size, args: Args, policy, progress: Progress
) -> dict[str, list[dict[str, float]]]:
    found = {}
    for i, condition in enumerate(size.perturbations):

        def told(share: float, i: int = i) -> None:
            progress("perturbed", (i + share) / len(size.perturbations))

        trial = condition, size.perturbed_speeds, size.perturbed_seeds, size.perturbed_seconds
        found[condition] = _tried(args, policy, *trial, told)
    return found


def _harsh(size: Size, args: Args, policy, progress: Progress) -> dict[str, dict[str, Any]]:
    """The wanted share and the rows of each condition of `bars.HARSH` that the robot can have."""
    from kslc_jax import physics, similar
    from kslc_jax.evaluation import variation

    robot = physics.robot_for(policy.config.physics)
    factor, found = similar.factors(robot)[similar.SPEED], {}
    for i, (condition, (wanted, speeds)) in enumerate(bars_lib.HARSH.items()):

        def told(share: float, i: int = i) -> None:
            progress("harsh", (i + share) / len(bars_lib.HARSH))

        own = tuple(bars_lib.scaled(speed, factor) for speed in speeds)
        for name in variation.for_robot([condition], robot):
            trial = name, own, size.harsh_seeds, size.harsh_seconds
            found[name] = {"wanted": wanted, "rows": _tried(args, policy, *trial, told)}
    return found


def _tried(
    args: Args,
    policy,
    condition: str,
    speeds: tuple[float, ...],
    seeds: int,
    seconds: float,
    told: Callable[[float], None],
) -> list[dict[str, float]]:
    """Survival and mean speed at each commanded speed [m/s] under one condition."""
    from kslc_jax.evaluation import gait_metrics, trials
    from kslc_jax.evaluation.measure import measure as measured

    def speed(trace, command: float, robot, dt: float) -> dict[str, float]:
        return gait_metrics.speed(trace, command, dt)

    made = changes(condition)
    engine = trials.engine(policy, "high", made.pop("terrain", None))
    plain = trials.Setting(engine, seconds=seconds)
    setting = dataclasses.replace(plain, **settings(made, plain.randomize))
    rows = measured(policy, setting, speeds, seeds, args.seed, told, speed)
    return _marked(rows, policy, setting)


def _marked(rows: list[dict[str, Any]], policy, setting) -> list[dict[str, Any]]:
    """The rows, each with the reasons of `trained.beyond`."""
    from kslc_jax.evaluation import trained

    return [row | trained.beyond(policy, setting, (row["command"], 0.0, 0.0)) for row in rows]


def _drake(size: Size, args: Args, policy, progress: Progress) -> list[dict[str, float]]:
    from kslc_jax.evaluation import trials
    from kslc_jax.evaluation.measure import measure as measured

    setting = trials.Setting(
        trials.engine(policy, "high"), seconds=DRAKE_SECONDS, simulate=options.simulator("drake")
    )
    speeds = [speed for speed in size.speeds if speed <= size.top]
    return measured(policy, setting, speeds, 1, args.seed, lambda share: progress("drake", share))


PARTS = {
    "speeds": _speeds,
    "schedules": _schedules,
    "perturbed": _perturbed,
    "harsh": _harsh,
    "drake": _drake,
}
"""Parts of the measurement, in their order."""


def table(found: list[Bar], title: str):
    """The bars as a rich table. An asterisk marks conditions beyond the training."""
    from rich.markup import escape
    from rich.table import Table

    caption = tables.BEYOND if any("*" in bar.where for bar in found) else None
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for label in ("bar", "wanted", "worst", "where", "met"):
        out.add_column(label)
    for bar in found:
        out.add_row(
            escape(bar.name), bar.wanted, bar.shown(), bar.where, "yes" if bar.met else "NO"
        )
    return out


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _run(cli.parse("judge", Args, argv, __doc__)))


def _run(args: Args) -> None:
    if args.stored:
        tables.console().print(side_by_side(_named(args.policies)))
    else:
        _report(args, args.policies[0])


def _named(paths: tuple[Path, ...]) -> dict[str, Results]:
    """The content of each file, by its name; by its path where two files have the same name."""
    short = len({path.stem for path in paths}) == len(paths)
    return {path.stem if short else str(path): read(path) for path in paths}


def read(path: Path) -> Results:
    """The content of a file of --json. ConfigError if there is none, or if it has no bars."""
    try:
        kept: Results = json.loads(path.read_text())
        return kept | {"bars": [Bar(**bar) for bar in kept["bars"]]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no file of a finished judge --json") from error


def side_by_side(kept: dict[str, Results]):
    """The worst values of several policies as a rich table, the best policy first."""
    from rich.markup import escape
    from rich.table import Table

    judged: dict[str, list[Bar]] = {name: one["bars"] for name, one in kept.items()}
    names = bars_lib.ranked(judged)
    median = names[len(names) // 2]
    missed = sum(not bar.met for bar in judged[median])
    caption = f"median: {median}, which misses {missed} of {len(judged[median])} bars. *: missed"
    if differ := _unlike(list(kept.values())):
        caption += f"\nNot comparable: the files differ in {', '.join(differ)}."
    out = Table("bar", "wanted", *map(escape, names), caption=caption, caption_justify="left")
    by_name = {name: {bar.name: bar for bar in judged[name]} for name in names}
    for bar in judged[names[0]]:
        found = [by_name[name].get(bar.name) for name in names]
        cells = ["-" if one is None else one.shown() + "*" * (not one.met) for one in found]
        out.add_row(escape(bar.name), bar.wanted, *cells)
    return out


def _unlike(kept: list[Results]) -> list[str]:
    """Names of the conditions that differ between the contents of files of --json."""
    conditions = [one.get("size", {}) | {k: one.get(k) for k in ("robot", "seed")} for one in kept]
    names = dict.fromkeys(name for one in conditions for name in one)
    return [
        name for name in names if any(c.get(name) != conditions[0].get(name) for c in conditions)
    ]


def _report(args: Args, path: Path) -> None:
    """Measures the policy, prints the table, writes the numbers."""
    from rich.progress import Progress

    from kslc_jax import physics, similar
    from kslc_jax.evaluation import trials
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    engine = "drake" if args.drake else "mujoco"
    options.simulator(engine)  # fails now if its package is missing
    policy = load_policy(path)
    robot = physics.robot_for(trials.engine(policy, "high"))
    options.require_engine(engine, robot)
    size, factors = args.size.for_robot(robot), similar.factors(robot)
    about: Results = {"policy": policy_name(path), "step": policy.step, "quick": args.quick}
    about |= {"robot": robot.name, "seed": args.seed, "size": dataclasses.asdict(size)}

    def keep(found: Results) -> None:
        if args.json is not None:
            files.write_json(args.json, about | found)

    def keep_part(found: Results) -> None:
        with contextlib.suppress(ConfigError):  # a full disk may have room again in the end
            keep(found)

    screen = tables.console()
    if missing := left_out(args.size.perturbations, size.perturbations):
        screen.print(missing)
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in PARTS}
        for name in ("harsh", "drake"):
            bar.update(tasks[name], visible=getattr(args, name))

        def progress(name: str, share: float) -> None:
            bar.start_task(tasks[name])
            bar.update(tasks[name], completed=share)

        found = measure(size, args, policy, progress, keep_part)
    against = bars(found, factors[similar.SPEED], arms=bool(robot.is_arm.any()))
    screen.print(table(against, f"{path}, train step {policy.step}"))
    keep(found | {"bars": [dataclasses.asdict(one) for one in against]})


if __name__ == "__main__":
    sys.exit(main())
