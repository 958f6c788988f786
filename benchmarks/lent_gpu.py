"""A training on a GPU that is lent for some minutes, and a copy of it in a few files.

It trains for --seconds. Then it sends SIGTERM; the training saves and exits. A SIGTERM to this
command does the same. The runs stay in --run-dir and can be resumed there. Each minute, and at the
end, the latest state goes into --out: a few uncompressed tar files of limited size. They leave out
the environments, which are most of a checkpoint. They hold of each seed the latest checkpoint with
networks, optimiser and curriculum, the config and the metrics; then snapshots, newest first, as far
as they fit. --unpack makes run folders of them, for evaluate, plots, --start-from and --resume.

  python -m benchmarks.lent_gpu --out carried                            # five seeds of laptop
  python -m benchmarks.lent_gpu --preset paper --seeds 1 --out carried
  python -m benchmarks.lent_gpu --preset paper --seeds 1 --out carried -- --ppo.learning-rate 1e-4
  python -m benchmarks.lent_gpu --unpack carried --out runs/lent         # anywhere, later
  python -m benchmarks.lent_gpu --resume --run-dir runs/lent --out carried
"""

import contextlib
import shlex
import signal
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import cli, files, runtime
from kslc_jax.checkpoint_format import whole_checkpoints
from kslc_jax.config import ConfigError
from kslc_jax.training import run_folder, stopping
from kslc_jax.training.checkpoint import ENVIRONMENTS

LEFT_OUT = (files.TENSORBOARD, files.PROFILE, files.BAD_STATE, files.LOCK)
"""Left out of the copy. The records of TensorBoard are in the metrics, too."""

EVERY = 60.0
"""Time [s] between two copies."""

GRACE = 60.0
"""Time [s] from SIGTERM until the training is killed; its last checkpoint is then carried."""

BLOCK, END = tarfile.BLOCKSIZE, tarfile.RECORDSIZE
"""A file in a tar file takes whole blocks [bytes]; the end takes at most a record."""

HEADERS = 4 * BLOCK
"""Most that the name and the properties of a file take [bytes]."""


@dataclass(frozen=True)
class Args:
    """Trains for some time, and copies the runs into a few files. All options after -- go to the
    training."""

    out: Path
    """Folder for the copy, or with --unpack for the runs. It must be empty or not exist."""
    seconds: float = 440.0
    """Time of the training [s], with compiling. A minute more may pass until all is saved."""
    run_dir: Path = Path("runs/lent")
    """Folder of the runs."""
    preset: str = "laptop"
    """Preset of the training."""
    seeds: int = 5
    """Number of seeds."""
    snapshots: int = 12
    """Policies to keep of each seed."""
    resume: bool = False
    """Go on with the runs in --run-dir."""
    parts: int = 4
    """Number of files of the copy."""
    part_mib: float = 15.0
    """Largest size of one file of the copy [MiB]."""
    unpack: Path | None = None
    """Do not train: make run folders of the copy in this folder."""


# ---------------------------------------------------------------------------------------- copying


def wanted(run_dir: Path) -> dict[str, list[Path]]:
    """The files to carry, by names for the reader. The most important ones come first."""
    seeds = [files.seed_folder(run_dir, seed) for seed in files.seeds_in(run_dir)]
    runs = [run for run in seeds or [run_dir] if (run / files.CONFIG).exists()]
    state: dict[str, list[Path]] = {}
    metrics: dict[str, list[Path]] = {}
    ages: list[tuple[int, Path]] = []
    for run in runs:
        apart = (*LEFT_OUT, files.METRICS, files.CHECKPOINTS, files.SNAPSHOTS)
        kept = [p for p in run.iterdir() if p.name not in apart]
        if latest := _newest_first(run / files.CHECKPOINTS)[:1]:
            kept += [p for p in latest[0].iterdir() if p.name != ENVIRONMENTS]
        state[f"{run.name}: its last state"] = _files_in(kept)
        metrics[f"{run.name}: its metrics"] = _files_in([run / files.METRICS])
        ages += enumerate(_newest_first(run / files.SNAPSHOTS))
    snapshots = {
        f"{path.parents[1].name}: snapshot {path.name}": _files_in([path])
        for _, path in sorted(ages, key=lambda pair: pair[0])
    }
    return state | metrics | snapshots


def _newest_first(folder: Path) -> list[Path]:
    """Whole checkpoints or snapshots; the names of unfinished ones are no numbers."""
    there = whole_checkpoints(folder) if folder.is_dir() else []
    return sorted(there, key=lambda path: int(path.name), reverse=True)


def _files_in(paths: Sequence[Path]) -> list[Path]:
    within = [p for path in paths for p in (path.rglob("*") if path.is_dir() else [path])]
    return sorted(path for path in within if path.is_file())


def shared_out(
    groups: dict[str, list[Path]], parts: int, most: int
) -> tuple[list[list[Path]], list[str]]:
    """(files of each part, names of the groups that do not fit into `parts` of `most` bytes)."""
    room, chosen, left = [most - END] * parts, [[] for _ in range(parts)], []
    for name, group in groups.items():
        trial, places = room.copy(), []
        for path in group:
            need = HEADERS + -(-path.stat().st_size // BLOCK) * BLOCK
            place = next((i for i, free in enumerate(trial) if free >= need), None)
            if place is None:
                left.append(name)
                break
            trial[place] -= need
            places.append(place)
        else:
            room = trial
            for path, place in zip(group, places, strict=True):
                chosen[place].append(path)
    return chosen, left


def part_name(index: int, parts: int) -> str:
    """Name of a file of the copy. It says how many there are."""
    return f"carried-{index + 1}-of-{parts}.tar"


def carry(run_dir: Path, out: Path, parts: int, most: int) -> list[str]:
    """Writes the copy, each file in one step; returns the names of what does not fit."""
    chosen, left = shared_out(wanted(run_dir), parts, most)
    for index, part in enumerate(chosen):
        with files.saving(out / part_name(index, parts)) as path, tarfile.open(path, "w") as tar:
            for file in part:
                tar.add(file, file.relative_to(run_dir), filter=_without_owner)
    return left


def _without_owner(info: tarfile.TarInfo) -> tarfile.TarInfo:
    info.uid = info.gid = 0
    info.uname = info.gname = ""
    info.mtime = int(info.mtime)  # a fraction needs more headers
    return info


def unpack(folder: Path, out: Path) -> int:
    """Makes run folders of a copy; returns 1 if files of it are missing.

    ConfigError if there is none.
    """
    there = sorted(folder.glob("carried-*-of-*.tar"))
    if not there:
        raise ConfigError(f"{folder} holds no copy: no file such as {part_name(0, 4)}")
    for path in there:
        with tarfile.open(path) as tar:
            tar.extractall(out, filter="data")
    parts = int(there[0].stem.rpartition("-")[2])
    names = {part_name(i, parts) for i in range(parts)}
    if missing := sorted(names - {path.name for path in there}):
        print(f"error: {folder} lacks {', '.join(missing)}; the rest is in {out}", file=sys.stderr)
        return 1
    print(f"go on with: python -m kslc_jax.train --resume --run-dir {shlex.quote(str(out))}")
    return 0


# ---------------------------------------------------------------------------------------- training


def command(args: Args, options: Sequence[str]) -> list[str]:
    """The command line of the training."""
    argv = [sys.executable, "-m", "kslc_jax.train", "--run-dir", str(args.run_dir)]
    if args.resume:
        argv += ["--resume"]
    else:
        argv += ["--preset", args.preset, "--seeds", str(args.seeds)]
        argv += ["--run.snapshots", str(args.snapshots)]
    return [*argv, "--run.checkpoint-minutes", "1", *options]


def train(argv: Sequence[str], seconds: float, copy: Callable[[], object]) -> int:
    """Trains until the time is over or a signal comes; returns the training's exit code.

    `copy` is called each minute.
    """
    process, stopped = subprocess.Popen(argv), threading.Event()
    ends, copies = time.monotonic() + seconds, time.monotonic() + EVERY

    def stop(*_) -> None:
        if not stopped.is_set():  # a second SIGTERM would break off the save
            stopped.set()
            process.send_signal(signal.SIGTERM)

    with stopping.handling(stop):
        while not stopped.is_set() and (left := ends - time.monotonic()) > 0:
            with contextlib.suppress(subprocess.TimeoutExpired):
                return process.wait(min(left, 0.1))
            if time.monotonic() > copies:
                copy()
                copies = time.monotonic() + EVERY
        stop()
        try:
            return process.wait(GRACE)
        except subprocess.TimeoutExpired:
            print(f"not saved after {GRACE:.0f} s: killed", flush=True)
            process.kill()
            return process.wait()


def main(args: Args, options: Sequence[str] = ()) -> int:
    """Trains and copies; returns the exit code of the training, 1 if something does not fit."""
    if args.out.exists() and any(args.out.iterdir()):
        raise ConfigError(f"{args.out} is not empty")
    if args.unpack:
        return unpack(args.unpack, args.out)
    if not args.resume:
        run_folder.require_free(args.run_dir)
    files.require_writable(args.out / part_name(0, args.parts))

    def copy() -> list[str]:
        try:
            return carry(args.run_dir, args.out, args.parts, int(args.part_mib * 2**20))
        except (OSError, ConfigError) as error:  # the training has just removed a file
            print(f"not copied: {runtime.first_line(error)}", flush=True)
            return []

    code = train(command(args, options), args.seconds, copy)
    left = copy()
    sizes = [path.stat().st_size for path in args.out.iterdir()]
    print(f"{args.out}: {sum(sizes) / 2**20:.1f} MiB in {len(sizes)} files", flush=True)
    if left:
        print(f"did not fit: {'; '.join(left)}", flush=True)
    return code or int(bool(left))


def parse(words: Sequence[str]) -> tuple[Args, Sequence[str]]:
    """(options of this command, options of the training, which come after --)."""
    at = [*words, "--"].index("--")
    return tyro.cli(Args, args=words[:at], description=__doc__), words[at + 1 :]


if __name__ == "__main__":
    sys.exit(cli.run(lambda: main(*parse(sys.argv[1:])), needs_output=False))
