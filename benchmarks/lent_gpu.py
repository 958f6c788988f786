"""Five seeds on a GPU that is lent for some minutes, and a copy of the runs that can be carried.

It trains until --seconds are over, then stops the training by SIGTERM, which saves. A SIGTERM to
this command does the same. The whole runs stay in --run-dir and can be resumed there. The copy in
--out leaves out the environments, which are most of a checkpoint: per seed it has the config, the
metrics, all snapshots, and of the latest checkpoint the networks, optimiser and curriculum. So
evaluate, plots and train --start-from work with it; --resume needs the whole run.

  python -m benchmarks.lent_gpu --seconds 600 --out carried
  python -m benchmarks.lent_gpu --seconds 600 --resume --run-dir runs/lent --out carried
"""

import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import files
from kslc_jax.checkpoint_format import whole_checkpoints
from kslc_jax.training import stopping

LEFT_OUT = (files.TENSORBOARD, files.CHECKPOINTS, files.LOCK)
"""Left out of the copy. The records are in the metrics, too, and one checkpoint comes back."""

LIMIT = 16 * 10**6
"""Largest size [bytes] of one seed's copy."""


@dataclass(frozen=True)
class Args:
    """Trains for some time, then copies the runs without environments."""

    out: Path
    """Folder for the copy; it must not exist."""
    seconds: float = 600.0
    """Time of the training [s], with compiling. A minute more may pass until all is saved."""
    run_dir: Path = Path("runs/lent")
    """Folder of the runs."""
    preset: str = "laptop"
    """Preset of the training."""
    seeds: int = 5
    """Number of seeds."""
    snapshots: int = 12
    """Policies to keep of each seed; one of the laptop preset takes 0.7 MB."""
    resume: bool = False
    """Go on with the runs in --run-dir."""


def carry(run: Path, out: Path) -> int:
    """Copies the run of one seed without its environments; returns the size [bytes]."""
    shutil.copytree(run, out, ignore=shutil.ignore_patterns(*LEFT_OUT))
    there = run / files.CHECKPOINTS
    if there.is_dir() and (steps := whole_checkpoints(there)):
        latest = max(steps, key=lambda path: int(path.name))
        copy = out / files.CHECKPOINTS / latest.name
        shutil.copytree(latest, copy, ignore=shutil.ignore_patterns("env"))
    return sum(path.stat().st_size for path in out.rglob("*") if path.is_file())


def train(args: Args) -> int:
    """Trains until the time is over or a signal comes; returns the training's exit code."""
    command = [sys.executable, "-m", "kslc_jax.train", "--run-dir", str(args.run_dir)]
    if args.resume:
        command += ["--resume"]
    else:
        command += ["--preset", args.preset, "--seeds", str(args.seeds)]
        command += ["--run.snapshots", str(args.snapshots), "--run.checkpoint-minutes", "1"]
    process = subprocess.Popen(command)
    with stopping.handling(lambda number, _: process.send_signal(signal.SIGTERM)):
        try:
            return process.wait(args.seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM)
            return process.wait()


def main(args: Args) -> int:
    """Trains and copies; returns the exit code of the training, 1 if a copy is too large."""
    if args.out.exists():
        print(f"error: {args.out} exists", file=sys.stderr)
        return 2
    code = train(args)
    for seed in files.seeds_in(args.run_dir):
        folder = files.seed_folder(args.run_dir, seed)
        size = carry(folder, args.out / folder.name)
        print(f"{args.out / folder.name}: {size / 1e6:.1f} MB", flush=True)
        code = code or int(size > LIMIT)
    return code


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
