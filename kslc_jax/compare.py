"""KSLC against its baseline and its ablations: python -m kslc_jax.compare [--seeds 0 1 2]

Trains every variant from scratch, one after the other, KSLC and baseline with every seed, and
evaluates it over the commanded speeds. Unattended and resumable: what is finished is skipped, what
was interrupted goes on from its checkpoint. Ends with one table; `python -m kslc_jax.plots` draws
performance, momentum, and how each speed was learnt.

Examples:
  python -m kslc_jax.compare --steps 20000000
  python -m kslc_jax.compare --preset paper --baseline baseline --seeds 0 1 2 3 4
  python -m kslc_jax.compare --variants kslc no-arms --seeds 0
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import config as config_lib
from kslc_jax import evaluate
from kslc_jax.config import ConfigError, Fidelity
from kslc_jax.plots import EVALUATION

VARIANTS = ("kslc", "baseline", *(f"no-{part}" for part in config_lib.ABLATIONS))


@dataclass(frozen=True)
class Args:
    """What to train and how long."""

    out: Path = Path("runs/compare")
    """One run folder per variant and seed goes in here."""
    variants: tuple[str, ...] = VARIANTS
    """kslc, baseline, and no-PART for each ablation."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of kslc and baseline."""
    ablation_seeds: tuple[int, ...] = (0,)
    """Seeds of the ablations."""
    preset: str = "laptop"
    """Preset of kslc and the ablations."""
    baseline: str = "baseline-laptop"
    """Preset of the baseline."""
    steps: int = 40_000_000
    """Environment steps of each training."""
    snapshots: int = 16
    """Policies that each keeps on its way, for the learning curves."""
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Commanded speeds of the evaluation [m/s]."""
    trials: int = 8
    """Trials per speed."""
    fidelity: Fidelity = "high"
    """What the evaluation simulates, as `evaluate` has it; high is the same for every preset."""

    def __post_init__(self):
        unknown = sorted(set(self.variants) - set(VARIANTS))
        if unknown:
            raise ConfigError(f"variants: unknown {unknown[0]!r} (known: {', '.join(VARIANTS)})")
        for name in (self.preset, self.baseline):
            config_lib.preset(name)
        for name in ("steps", "snapshots", "trials"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1")
        for name in ("seeds", "ablation_seeds"):
            for seed in getattr(self, name):
                config_lib.require_seed(seed, name)
        evaluate.check(self.speeds, self.trials, evaluate.Args.seconds)


@dataclass(frozen=True)
class Job:
    """One training and its evaluation."""

    variant: str
    seed: int
    folder: Path
    train: tuple[str, ...]  # arguments of kslc_jax.train
    evaluate: tuple[str, ...]  # arguments of kslc_jax.evaluate


def jobs(args: Args) -> Iterator[Job]:
    """All jobs: first seed of every variant first, so that a first table comes early."""
    for seed in sorted({*args.seeds, *args.ablation_seeds}):
        for variant in args.variants:
            ablation = variant.removeprefix("no-") if variant.startswith("no-") else None
            if seed in (args.ablation_seeds if ablation else args.seeds):
                yield _job(args, variant, ablation, seed)


def _job(args: Args, variant: str, ablation: str | None, seed: int) -> Job:
    from kslc_jax.checkpoint import has_checkpoints

    folder = args.out / f"{variant}-seed{seed}"
    length = ("--steps", str(args.steps), "--run.snapshots", str(args.snapshots))
    run = ("--run-dir", str(folder), *length)
    if has_checkpoints(folder):
        how = ("--resume",)
    else:
        preset = args.baseline if variant == "baseline" else args.preset
        without = ("--without", ablation) if ablation else ()
        how = ("--preset", preset, *without, "--seed", str(seed))
    speeds = ("--speeds", *(f"{v:g}" for v in args.speeds))
    trials = ("--seeds", str(args.trials), "--fidelity", args.fidelity)
    kept = ("--json", str(folder / EVALUATION))
    return Job(variant, seed, folder, (*how, *run), (str(folder), *speeds, *trials, *kept))


def run(job: Job) -> bool:
    """Trains, and evaluates the policies on the way and the last; False where that failed. Each is
    a process of its own, whose memory and compiled programs are gone with it."""
    return (
        call("train", job.train)
        and call("learning", (str(job.folder),))
        and call("evaluate", job.evaluate)
    )


def call(module: str, arguments: tuple[str, ...]) -> bool:
    """Whether a command of this package succeeded. At Ctrl-C, which it hears too, it is given the
    time to save."""
    process = subprocess.Popen([sys.executable, "-m", f"kslc_jax.{module}", *arguments])
    try:
        return process.wait() == 0
    except KeyboardInterrupt:
        process.wait()
        raise


def table(out: Path):
    """Mean forward speed per commanded speed of all that is finished, as a rich table."""
    from rich.table import Table

    shown = Table(title="mean forward speed [m/s], 0 for trials that fell", title_justify="left")
    found = sorted(out.glob(f"*/{EVALUATION}"))
    results = {path.parent.name: json.loads(path.read_text())["rows"] for path in found}
    shown.add_column("run")
    for row in next(iter(results.values()), []):
        shown.add_column(f"{row['command']:.1f}", justify="right")
    for name, rows in results.items():
        shown.add_row(name, *(f"{row['forward_mean']:.2f}" for row in rows))
    return shown


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    try:
        args = tyro.cli(Args, args=argv, description=__doc__)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    failed = []
    todo = list(jobs(args))
    for i, job in enumerate(todo):
        name = job.folder.name
        if (job.folder / EVALUATION).is_file():
            print(f"[{i + 1}/{len(todo)}] {name}: done before")
            continue
        print(f"[{i + 1}/{len(todo)}] {name}", flush=True)
        try:
            if not run(job):
                failed.append(name)
        except KeyboardInterrupt:
            print("stopped; the same command goes on from here", file=sys.stderr)
            return 130
    from rich.console import Console

    Console(highlight=False).print(table(args.out))
    if failed:
        print(f"error: failed: {', '.join(failed)}; the same command tries again", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
