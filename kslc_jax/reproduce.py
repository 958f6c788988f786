"""Compare this machine's numbers with the published ones: python -m kslc_jax.reproduce [POLICY]

Evaluates a shipped policy again, under the conditions of its stored evaluation. Each number must
lie within a band around its stored value. With --train it also trains the policy's config from
scratch, and compares the environment steps at which the range of commanded speeds grew. The exit
code is 1 if a number lies outside its band.

Examples:
  python -m kslc_jax.reproduce                   # minutes
  python -m kslc_jax.reproduce --train --seed 1  # an hour on two CPU cores
"""

import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.progress import Progress
from rich.table import Table

from kslc_jax import cli, evaluate, files, runtime
from kslc_jax import config as config_lib
from kslc_jax.config import Config, ConfigError
from kslc_jax.evaluation.tables import console

SHIPPED = "xbot_l_run"

BANDS = {
    "survival": 0.15,
    "forward_mean": 0.05,
    "forward_std": 0.03,
    "lateral_std": 0.03,
    "yaw_rate_std": 0.05,
    "stride_frequency": 0.1,
    "flight_share": 0.05,
    "shoulder_hip_correlation": 0.1,
}
"""Largest allowed difference between a metric and its stored value, in the metric's unit. For the
policy of a smaller robot than XBot-L, whose speeds are lower, these are wide."""

LATER = 1.5
"""Allowed factor on the environment steps of a milestone: seeds differ by about as much."""


class Stopped(RuntimeError):
    """A signal stopped the training; it has saved its state."""


Row = tuple[str, float, float, bool]
"""(description, stored value, value found here, True if they agree)"""


@dataclass(frozen=True)
class Args:
    """The policy to evaluate again, and its training."""

    policy: tyro.conf.Positional[str] = SHIPPED
    """Name of a shipped policy."""
    train: bool = False
    """Also train from scratch."""
    seed: int = 0
    """Seed of the training."""
    run_dir: Path = Path("runs/reproduce")
    """Run folder of the training."""

    def __post_init__(self):
        config_lib.require_seed(self.seed)


def stored(folder: Path, name: str) -> dict[str, Any]:
    """The content of a JSON file in the folder of a policy; ConfigError if it is not readable."""
    try:
        return json.loads((folder / name).read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder} holds no readable {name}: nothing to compare with") from error


def of_an_older_recipe(config: Config) -> bool:
    """True if the default preset differs from the config, in more than seed and run options."""
    from kslc_jax import similar

    today = similar.preset("laptop", config.physics.robot)
    return dataclasses.replace(today, seed=config.seed, run=config.run) != config


def compare_rows(old: list[dict[str, float]], new: list[dict[str, float]]) -> list[Row]:
    """One row for each metric of `BANDS` and each commanded speed."""
    out = []
    for before, now in zip(old, new, strict=True):
        for name in (n for n in BANDS if n in before):
            found = now.get(name, float("nan"))
            agrees = abs(found - before[name]) <= BANDS[name]
            out.append((f"{name} at {before['command']:g} m/s", before[name], found, agrees))
    return out


def compare_milestones(old: dict[str, float], new: dict[str, float]) -> list[Row]:
    """One row for each speed: millions of environment steps until the commands reached it."""
    out = []
    for speed, steps in old.items():
        found = new.get(speed, float("inf"))
        row = f"commands up to {speed} m/s, M steps"
        out.append((row, steps / 1e6, found / 1e6, found <= LATER * steps))
    return out


def retrain(args: Args, config: Config, until: float) -> dict[str, float]:
    """Trains `config` up to `until` environment steps: from scratch, or from its checkpoint.

    Returns the environment steps at which the commands reached each speed [m/s]. Raises the errors
    of `loop.train`, and Stopped.
    """
    from kslc_jax import records
    from kslc_jax.checkpoint_format import has_checkpoints
    from kslc_jax.training import loop, run_folder
    from kslc_jax.training.logs import Progress

    run = dataclasses.replace(config.run, steps=round(until))
    config = dataclasses.replace(config, seed=args.seed, run=run)
    going_on = has_checkpoints(args.run_dir)
    progress = Progress(config)
    if going_on:
        here = run_folder.circumstances(config, 1)
        progress.say(f"resume {run_folder.what_changed(args.run_dir, here)}".rstrip())
    state = loop.train(config, args.run_dir, going_on, progress)
    if int(state.step) < config.num_updates:
        raise Stopped("stopped; the same command tries the policy again and goes on training")
    return records.milestone_steps(records.read_metrics(args.run_dir))


def report(rows: list[Row], title: str) -> Table:
    """The compared numbers as a table."""
    out = Table(title=title, title_justify="left")
    for column in ("what", "published", "here", ""):
        out.add_column(column, justify="left" if column == "what" else "right")
    for what, before, now, agrees in rows:
        out.add_row(what, f"{before:.3f}", f"{now:.3f}", "ok" if agrees else "[red]differs")
    return out


def repeat(args: Args) -> list[Row]:
    """Evaluates, and with --train also trains. Prints a table of each, and returns the rows.

    Raises:
      ConfigError, CheckpointError: the policy or its stored numbers cannot be read; with --train
        also the errors of `retrain`.
    """
    from kslc_jax.policy import POLICIES, load_policy

    policy = load_policy(args.policy)
    shipped = [path.name for path in sorted(POLICIES.glob("*/"))]
    if args.policy not in shipped:
        known = ", ".join(shipped)
        raise ConfigError(f"{args.policy}: only shipped policies have published numbers: {known}")
    folder = POLICIES / args.policy
    old = stored(folder, files.EVALUATION)
    how = evaluate.Args(
        Path(args.policy),
        speeds=tuple(row["command"] for row in old["rows"]),
        seeds=old["seeds"],
        seconds=old["seconds"],
        fidelity=old["fidelity"],
        noise=old.get("noise", False),
        ground=old.get("ground"),
        seed=old.get("seed", 0),
    )
    screen = console()
    with Progress(console=screen, transient=True) as bar:
        task = bar.add_task("trying", total=1.0)
        new = evaluate.sweep(how, policy, lambda share: bar.update(task, completed=share))
    rows = compare_rows(old["rows"], new)
    screen.print(report(rows, f"{args.policy}: evaluation"))
    if args.train:
        if of_an_older_recipe(policy.config):
            print(f"{args.policy} is of an older recipe: --train uses it, not today's preset")
        milestones = stored(folder, files.MILESTONES)
        found = retrain(args, policy.config, LATER * max(milestones.values()))
        trained = compare_milestones(milestones, found)
        screen.print(report(trained, f"{args.policy}: training, at most {LATER:g} times as long"))
        rows += trained
    return rows


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _compare(cli.parse("reproduce", Args, argv, __doc__)))


def _compare(args: Args) -> int:
    """Compares and reports; the exit code is 1 if a number lies outside its band."""
    if args.train:
        runtime.require_good_jax()
        files.require_writable(args.run_dir / files.CONFIG)
    try:
        rows = repeat(args)
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        return 130
    differing = [what for what, _, _, agrees in rows if not agrees]
    if differing:
        print(f"{len(differing)} of {len(rows)} numbers lie outside their band")
        return 1
    print(f"all {len(rows)} numbers lie within their bands")
    return 0


if __name__ == "__main__":
    sys.exit(main())
