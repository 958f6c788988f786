"""Compare KSLC with its baseline and its ablations: python -m kslc_jax.compare [--seeds 0 1 2]

Trains every variant from scratch, one after the other, and evaluates it over the commanded speeds.
KSLC and the baseline train with every seed. The command runs unattended. If you repeat it, it skips
finished runs and resumes interrupted ones from their checkpoints. It ends with one Markdown table.
`python -m kslc_jax.plots` draws performance, momentum, and the learning curve of each speed.

Examples:
  python -m kslc_jax.compare --steps 20000000
  python -m kslc_jax.compare --preset paper --baseline baseline --seeds 0 1 2 3 4
  python -m kslc_jax.compare --variants kslc no-arms --seeds 0 --keep docs/results/compare
"""

import dataclasses
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from kslc_jax import cli, evaluate, files, records, train
from kslc_jax import config as config_lib
from kslc_jax.config import XBOT_L, Config, ConfigError, Fidelity
from kslc_jax.evaluation import options, tables
from kslc_jax.training import stopping

WIDTH = 200
"""Width of the table in characters, independent of the terminal: no line may break."""

VARIANTS = ("kslc", "baseline", *(f"no-{part}" for part in config_lib.ABLATIONS))


@dataclass(frozen=True)
class Args:
    """The trainings, their length, and their evaluation."""

    out: Path = Path("runs/compare")
    """Folder for the run folders, one per variant and seed."""
    keep: Path | None = None
    """Folder for copies of the finished runs. A copy has only the data of the table and the
    figures: 40 kB per run."""
    variants: tuple[str, ...] = VARIANTS
    """kslc, baseline, and no-PART for each ablation."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of kslc and baseline."""
    ablation_seeds: tuple[int, ...] = (0,)
    """Seeds of the ablations."""
    robot: str = XBOT_L
    """A shipped robot, or the path of a description; see `train --robot`."""
    preset: str = "laptop"
    """Preset of kslc and the ablations."""
    baseline: str = "baseline-laptop"
    """Preset of the baseline."""
    steps: int = 40_000_000
    """Environment steps of each training."""
    snapshots: int = 16
    """Policies that each training keeps along the way, for the learning curves."""
    speeds: tuple[float, ...] | None = None
    """Commanded speeds of the evaluation [m/s]. None: 0.5 to 4.0 in steps of 0.5, scaled to the
    robot's size."""
    trials: int = 8
    """Trials per speed."""
    fidelity: Fidelity = "high"
    """Physics of the evaluation, as in `evaluate`; high: the same physics for every preset."""

    def __post_init__(self):
        if self.keep and self.keep.resolve() == self.out.resolve():
            raise ConfigError("keep must not be out: a copy drops most of a training's metrics")
        unknown = sorted(set(self.variants) - set(VARIANTS))
        if unknown:
            raise ConfigError(f"variants: unknown {unknown[0]!r} (known: {', '.join(VARIANTS)})")
        for name in (self.preset, self.baseline):
            train.preset_for(name, self.robot)
        for name in ("steps", "snapshots", "trials"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1")
        for name in ("seeds", "ablation_seeds"):
            for seed in getattr(self, name):
                config_lib.require_seed(seed, name)
        options.check_trials(self.speeds, self.trials, evaluate.Args.seconds)


@dataclass(frozen=True)
class Job:
    """One training and its evaluation."""

    variant: str
    seed: int
    folder: Path
    config: Config  # of the training; its `run` part is the preset's
    train: tuple[str, ...]  # arguments of kslc_jax.train
    learning: tuple[str, ...]  # arguments of kslc_jax.learning
    evaluate: tuple[str, ...]  # arguments of kslc_jax.evaluate


def jobs(args: Args) -> Iterator[Job]:
    """All jobs. Every variant trains its first seed first, so that a first table comes early."""
    for seed in sorted({*args.seeds, *args.ablation_seeds}):
        for variant in args.variants:
            ablation = variant.removeprefix("no-") if variant.startswith("no-") else None
            if seed in (args.ablation_seeds if ablation else args.seeds):
                yield _job(args, variant, ablation, seed)


def _commanded(args: Args) -> tuple[float, ...]:
    """The speeds of the evaluation [m/s]."""
    return options.speeds_for(args.robot, args.speeds, options.SPEEDS)


def _job(args: Args, variant: str, ablation: str | None, seed: int) -> Job:
    from kslc_jax.checkpoint_format import has_checkpoints

    folder = args.out / f"{variant}-seed{seed}"
    preset = args.baseline if variant == "baseline" else args.preset
    parts = (ablation,) if ablation else ()
    without = ("--without", *parts) if parts else ()
    config = dataclasses.replace(train.preset_for(preset, args.robot, parts), seed=seed)
    of = () if args.robot == XBOT_L else ("--robot", args.robot)
    what = (*of, "--preset", preset, *without, "--seed", str(seed))
    length = ("--steps", str(args.steps), "--run.snapshots", str(args.snapshots))
    # A resume names its preset too: train refuses it if the run began with another preset.
    resume = ("--resume",) if has_checkpoints(folder) else ()
    run = ("--run-dir", str(folder), *length, *resume)
    speeds = ("--speeds", *map(str, _commanded(args)))
    fidelity = ("--fidelity", args.fidelity)
    trials = ("--seeds", str(args.trials), *fidelity)
    kept = ("--json", str(folder / files.EVALUATION))
    evaluation = (str(folder), *speeds, *trials, *kept)
    learning = (str(folder), *fidelity)
    return Job(variant, seed, folder, config, (*what, *run), learning, evaluation)


def require_ours(job: Job) -> None:
    """ConfigError or RunError if the folder holds a training with another config."""
    from kslc_jax.training import run_folder, same_training

    if (job.folder / files.CONFIG).exists():
        same_training.difference(run_folder.read_config(job.folder), job.config)


def run(job: Job, steps: int) -> bool:
    """Trains, then evaluates the snapshots and the last policy; False if a command failed.

    Each command is a separate process, so that its memory is free afterwards.
    """
    if trained(job.folder) < steps or not (job.folder / files.LEARNING).exists():
        for name in (files.EVALUATION, files.LEARNING):
            (job.folder / name).unlink(missing_ok=True)  # results of the shorter training
        # A training that a signal stopped has saved, and returns exit code 0 too.
        if not (call("train", job.train) and trained(job.folder) >= steps):
            return False
        if not call("learning", job.learning):
            return False
    return call("evaluate", job.evaluate)


def trained(run: Path) -> int:
    """Environment steps of a run folder, by its metrics; 0 if it has none."""
    try:
        return int(records.read_metrics(run)["env_steps"][-1])
    except ValueError:
        return 0


def is_done(job: Job, args: Args) -> bool:
    """True if the folder holds this evaluation, and its training has at least `args.steps`."""
    try:
        kept = json.loads((job.folder / files.EVALUATION).read_text())
        speeds = tuple(row["command"] for row in kept["rows"])
        how = (kept["fidelity"], kept["seeds"])
    except (OSError, ValueError, KeyError, TypeError):
        return False
    asked = (args.fidelity, args.trials)
    return how == asked and speeds == _commanded(args) and trained(job.folder) >= args.steps


def call(module: str, arguments: tuple[str, ...]) -> bool:
    """Runs a command of this package; True if it succeeded.

    A signal leaves the child time to save; then this function raises KeyboardInterrupt. The
    terminal sends Ctrl-C to the child too. Other signals are passed on to it as SIGTERM.
    """
    process = subprocess.Popen([sys.executable, "-m", f"kslc_jax.{module}", *arguments])
    signalled = False

    def terminate(number: int, _: FrameType | None) -> None:
        nonlocal signalled
        signalled = True
        if number != signal.SIGINT:  # a terminal sends that one to both
            process.terminate()

    with stopping.handling(terminate):
        code = process.wait()
    if signalled:
        raise KeyboardInterrupt
    return code == 0


def finished(out: Path) -> list[Path]:
    """The run folders with an evaluation, in the order of `VARIANTS`."""

    def place(run: Path) -> tuple[int, str]:
        variant, _, _ = run.name.rpartition("-seed")
        return (VARIANTS.index(variant) if variant in VARIANTS else len(VARIANTS)), run.name

    return sorted((path.parent for path in out.glob(f"*/{files.EVALUATION}")), key=place)


def keep(run: Path, folder: Path) -> None:
    """Copies config, versions and evaluation of a finished run, and the data that `plots` reads.

    Of the metrics it copies every tenth record, those at which the range of commands grew, and the
    last one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (files.CONFIG, files.VERSIONS, files.EVALUATION):
        files.write_atomically(folder / name, (run / name).read_text())
    learnt = json.loads((run / files.LEARNING).read_text())
    for point in learnt["points"]:
        point["rows"] = [
            {n: records.short(row[n]) for n in records.LEARNT} for row in point["rows"]
        ]
    files.write_atomically(folder / files.LEARNING, json.dumps(learnt))
    thinned = records.thinned(records.read_metrics(run), 10, records.COLUMNS)
    files.write_atomically(folder / files.METRICS, thinned)


def table(runs: Sequence[Path]) -> Table:
    """One row per run: its length, the range of commands that it reached, and the steps until then.

    Then, per command, the mean forward speed [m/s], or 'falls' if a trial fell.
    """
    shown = Table(box=box.MARKDOWN)
    for header in ("run", "steps", "v_max [m/s]", "after"):
        shown.add_column(escape(header), no_wrap=True)  # rich would read [m/s] as a style
    results = {run: _speeds(run) for run in runs}
    commands = sorted({command for speeds in results.values() for command in speeds})
    for command in commands:
        shown.add_column(tables.speed(command), justify="right")
    for run, speeds in results.items():
        shown.add_row(escape(run.name), *_reached(run), *(speeds.get(v, "-") for v in commands))
    return shown


def _speeds(run: Path) -> dict[float, str]:
    rows = json.loads((run / files.EVALUATION).read_text())["rows"]
    return {
        row["command"]: f"{row['forward_mean']:.2f}" if row["survival"] == 1.0 else "falls"
        for row in rows
    }


def _reached(run: Path) -> tuple[str, str, str]:
    metrics = records.read_metrics(run)
    length, after = f"{metrics['env_steps'][-1] / 1e6:.1f} M", "start"
    for _, steps, seconds in records.milestones(metrics):
        after = f"{steps / 1e6:.1f} M, {records.in_minutes(seconds)}"
    return length, f"{metrics['curriculum/v_max'][-1]:.1f}", after


def report(args: Args, refused: Sequence[str]) -> None:
    """Prints the table of the finished runs and, with --keep, copies them.

    OSError or ValueError if a file of a run is not readable.
    """
    done = [run for run in finished(args.out) if run.name not in refused]
    if done:
        print("mean forward speed [m/s] per command:")
        Console(highlight=False, width=WIDTH).print(table(done))
    if args.keep:
        for run_dir in done:
            keep(run_dir, args.keep / run_dir.name)


def run_all(args: Args) -> tuple[list[str], list[str]]:
    """Runs the jobs that are not done.

    Returns (the jobs that failed, the jobs whose folder holds another training), by name.
    """
    from kslc_jax.training.run_folder import RunError

    failed, refused = [], []
    todo = list(jobs(args))
    for i, job in enumerate(todo):
        name = job.folder.name
        try:
            require_ours(job)
        except (ConfigError, RunError) as error:
            print(f"error: {job.folder} is not of this comparison: {error}", file=sys.stderr)
            refused.append(name)
            continue
        if is_done(job, args):
            print(f"[{i + 1}/{len(todo)}] {name}: done before")
            continue
        print(f"[{i + 1}/{len(todo)}] {name}", flush=True)
        if not run(job, args.steps):
            failed.append(name)
    return failed, refused


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _compare(cli.parse("compare", Args, argv, __doc__)))


def _compare(args: Args) -> int:
    """Runs all jobs and reports; returns the exit code."""
    for folder in filter(None, (args.out, args.keep)):
        files.require_writable(folder / files.EVALUATION)
    try:
        failed, refused = run_all(args)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return 130
    try:
        report(args, refused)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if failed:
        print(f"error: failed: {', '.join(failed)}; the same command tries again", file=sys.stderr)
    if refused:
        what = f"another training is in {', '.join(refused)} and was kept"
        print(f"error: {what}; name another --out", file=sys.stderr)
    return 1 if failed or refused else 0


if __name__ == "__main__":
    sys.exit(main())
