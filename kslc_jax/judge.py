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
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from kslc_jax import cli, files
from kslc_jax.config import ConfigError, require_seed
from kslc_jax.evaluation import options, tables
from kslc_jax.evaluation.bars import HARSH, Bar, bars, ranked
from kslc_jax.evaluation.perturbations import left_out
from kslc_jax.evaluation.size import FULL, QUICK, Size


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
    """Also try the policy under punches of 300 N and of 500 N (only reported), with arms that
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


def table(found: list[Bar], title: str):
    """The bars as a rich table. An asterisk marks conditions beyond the training."""
    from rich.markup import escape
    from rich.table import Table

    caption = tables.BEYOND if any("*" in bar.where for bar in found) else None
    out = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for label in ("bar", "wanted", "worst", "where", "met"):
        out.add_column(label)
    for bar in found:
        met = ("yes" if bar.met else "NO") if bar.requires else "-"
        out.add_row(escape(bar.name), bar.wanted, bar.shown(), bar.where, met)
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
    names = ranked(judged)
    median = names[len(names) // 2]
    met = [bar.met for bar in judged[median] if bar.requires]
    caption = f"median: {median}, which misses {met.count(False)} of {len(met)} bars. *: missed"
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
    """Names of the conditions that differ between the files of --json that tell them."""
    found: dict[str, list[Any]] = {}
    for one in kept:
        told = {name: one[name] for name in ("robot", "seed") if name in one}
        for name, value in (told | one.get("size", {})).items():
            found.setdefault(name, []).append(value)
    return [name for name, values in found.items() if any(v != values[0] for v in values)]


def _report(args: Args, path: Path) -> None:
    """Measures the policy, prints the table, writes the numbers."""
    from rich.progress import Progress

    from kslc_jax import physics, similar
    from kslc_jax.evaluation import judging, trials, variation
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    engine = "drake" if args.drake else "mujoco"
    options.simulator(engine)  # fails now if its package is missing
    policy = load_policy(path)
    robot = physics.robot_for(trials.engine(policy, "high"))
    options.require_engine(engine, robot)
    size, factors = judging.for_robot(args.size, robot), similar.factors(robot)
    left = {name for name in ("harsh", "drake") if not getattr(args, name)}
    names = [name for name in judging.PARTS if name not in left]
    about: Results = {"policy": policy_name(path), "step": policy.step, "quick": args.quick}
    about |= {"robot": robot.name, "seed": args.seed, "size": dataclasses.asdict(size)}

    def keep(found: Results) -> None:
        if args.json is not None:
            files.write_json(args.json, about | found)

    def keep_part(found: Results) -> None:
        with contextlib.suppress(ConfigError):  # a full disk may have room again in the end
            keep(found)

    screen = tables.console()
    harsh = tuple(HARSH) if args.harsh else ()
    tried = *size.perturbations, *variation.for_robot(harsh, robot)
    if missing := left_out((*args.size.perturbations, *harsh), tried):
        screen.print(missing)
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in names}

        def progress(name: str, share: float) -> None:
            bar.start_task(tasks[name])
            bar.update(tasks[name], completed=share)

        found = judging.measure(policy, size, args.seed, names, progress, keep_part)
    against = bars(found, factors[similar.SPEED], arms=bool(robot.is_arm.any()))
    screen.print(table(against, f"{path}, train step {policy.step}"))
    keep(found | {"bars": [dataclasses.asdict(one) for one in against]})


if __name__ == "__main__":
    sys.exit(main())
