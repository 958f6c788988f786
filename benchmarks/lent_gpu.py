"""Five seeds on a GPU that is lent for some minutes, and a copy of the runs that can be carried.

It trains for --seconds. Then it sends SIGTERM; the training saves and exits. A SIGTERM to this
command does the same. The whole runs stay in --run-dir and can be resumed there. The copy in
--out leaves out the environments, which are most of a checkpoint: per seed it has the config, the
metrics, all snapshots, and of the latest checkpoint the networks, optimiser and curriculum. So
evaluate and plots work with it, and train --resume goes on with new environments.

  python -m benchmarks.lent_gpu --seconds 600 --out carried
  python -m benchmarks.lent_gpu --seconds 600 --resume --run-dir runs/lent --out carried
  python -m benchmarks.lent_gpu --seconds 600 --preset paper --seeds 1 --out carried
"""

import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import files
from kslc_jax.checkpoint_format import whole_checkpoints
from kslc_jax.training import stopping
from kslc_jax.training.checkpoint import ENVIRONMENTS

LEFT_OUT = (files.TENSORBOARD, files.CHECKPOINTS, files.LOCK)
"""Left out of the copy. The records are in the metrics, too, and one checkpoint comes back."""

LIMIT = 16 * 10**6
"""Largest size [bytes] of one file of a copy."""


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


def carry(run: Path, out: Path) -> list[int]:
    """Copies the run of one seed without its environments; returns the files' sizes [bytes]."""
    shutil.copytree(run, out, ignore=shutil.ignore_patterns(*LEFT_OUT))
    there = run / files.CHECKPOINTS
    if there.is_dir() and (steps := whole_checkpoints(there)):
        latest = max(steps, key=lambda path: int(path.name))
        copy = out / files.CHECKPOINTS / latest.name
        shutil.copytree(latest, copy, ignore=shutil.ignore_patterns(ENVIRONMENTS))
    return [path.stat().st_size for path in out.rglob("*") if path.is_file()]


def train(args: Args) -> int:
    """Trains until the time is over or a signal comes; returns the training's exit code."""
    command = [sys.executable, "-m", "kslc_jax.train", "--run-dir", str(args.run_dir)]
    if args.resume:
        command += ["--resume"]
    else:
        command += ["--preset", args.preset, "--seeds", str(args.seeds)]
        command += ["--run.snapshots", str(args.snapshots), "--run.checkpoint-minutes", "1"]
    process, stopped = subprocess.Popen(command), threading.Event()

    def stop(*_) -> None:
        if not stopped.is_set():  # a second SIGTERM would break off the save
            stopped.set()
            process.send_signal(signal.SIGTERM)

    with stopping.handling(stop):
        try:
            return process.wait(args.seconds)
        except subprocess.TimeoutExpired:
            stop()
            return process.wait()


def main(args: Args) -> int:
    """Trains and copies; returns the exit code of the training, 1 if a file is too large."""
    if args.out.exists():
        print(f"error: {args.out} exists", file=sys.stderr)
        return 2
    code = train(args)
    runs = [files.seed_folder(args.run_dir, seed) for seed in files.seeds_in(args.run_dir)]
    if (args.run_dir / files.CONFIG).exists():  # one seed has no folder of its own
        runs = [args.run_dir]
    for folder in runs:
        sizes = carry(folder, args.out / folder.name)
        print(f"{args.out / folder.name}: {sum(sizes) / 1e6:.1f} MB", flush=True)
        code = code or int(max(sizes, default=0) > LIMIT)
    return code


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
