"""Kills trainings at random moments, and checks that the results do not change.

One training is started, killed and resumed many times. The signals are SIGKILL and SIGTERM. They
come while JAX compiles, during the training, and during a save. Each resume must go on from the
last complete checkpoint. In the end every record of metrics.jsonl, without the wall-clock columns,
must equal that of an undisturbed training, bit for bit. The exit code is 1 if anything differs.

  python benchmarks/kill_test.py [--kills 30] [--terms 10] [--seed 0] [--folder FOLDER]
"""

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import tyro

from kslc_jax import files
from kslc_jax.config import preset

WALL_CLOCK = ("seconds", "steps_per_second")
MOMENTS = {"start": 1, "training": 4, "save": 5}
"""Moments of a kill with their weights: before the training runs, while it runs, while it saves."""


class Failure(Exception):
    """The training failed, or it lost data."""


def command(run_dir: Path, *args: object) -> list[str]:
    """The command line of a training in `run_dir`."""
    words = [sys.executable, "-m", "kslc_jax.train", "--run-dir", run_dir, *args]
    return [str(word) for word in words]


def checkpoints(run_dir: Path) -> list[int]:
    """Train steps of the complete checkpoints, oldest first."""
    folders = (run_dir / files.CHECKPOINTS).glob("*")
    return sorted(int(p.name) for p in folders if p.name.isdigit())


def saving(run_dir: Path) -> bool:
    """True if there is a half-written checkpoint."""
    return any((run_dir / files.CHECKPOINTS).glob("*.orbax-checkpoint-tmp"))


def wait_until(what, process: subprocess.Popen, log: Path, seconds: float = 300.0) -> None:
    """Waits until `what()` is true. Failure if the process ends or the time is over before that."""
    end = time.monotonic() + seconds
    while not what():
        if process.poll() is not None or time.monotonic() > end:
            raise Failure(f"the training ended early, or the wait was too long:\n{log.read_text()}")
        time.sleep(0.001)


def kill(run_dir: Path, number: signal.Signals, moment: str, log: Path, rng: random.Random) -> bool:
    """Starts or resumes the training and kills it; True if the kill came during a save."""
    before = checkpoints(run_dir)
    often = ["--preset", "debug", "--steps", 10**9, "--run.checkpoint-minutes", 0.002]
    with log.open("w") as out:
        process = subprocess.Popen(
            command(run_dir, *(["--resume"] if before else often)), stdout=out, stderr=out
        )
        if moment == "start" and before:
            time.sleep(rng.uniform(0.0, 8.0))
        else:
            wait_until(lambda: "; training" in log.read_text(), process, log)
            time.sleep(rng.uniform(0.0, 2.0))
            if not before:
                wait_until(lambda: checkpoints(run_dir), process, log)
            if moment == "save":
                wait_until(lambda: saving(run_dir), process, log)
        process.send_signal(number)
        code = process.wait(timeout=300)
    text = log.read_text()
    if before and "; training" in text and f"resumed at train step {before[-1]}\n" not in text:
        raise Failure(f"did not go on from train step {before[-1]}:\n{text}")
    asked = number == signal.SIGTERM and "; training" in text
    if "warning" in text or (asked and (code != 0 or "saved" not in text)):
        raise Failure(f"exit code {code}:\n{text}")
    return saving(run_dir)


def records(run_dir: Path) -> list[dict[str, float]]:
    """The records of metrics.jsonl without the columns that depend on the wall clock."""
    rows = [json.loads(line) for line in (run_dir / files.METRICS).read_text().splitlines()]
    return [{k: v for k, v in row.items() if k not in WALL_CLOCK} for row in rows]


def main(kills: int = 30, terms: int = 10, seed: int = 0, folder: Path | None = None) -> int:
    """Prints the number of kills and of records that differ. Returns 1 if any record differs.

    Args:
      kills: number of SIGKILLs.
      terms: number of SIGTERMs.
      seed: seed of the moments.
      folder: folder for the two run folders; the default is a temporary folder.
    """
    rng = random.Random(seed)
    folder = Path(tempfile.mkdtemp()) if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    broken, whole, log = folder / "broken", folder / "whole", folder / "log.txt"
    signals = [signal.SIGKILL] * kills + [signal.SIGTERM] * terms
    rng.shuffle(signals)
    count: Counter[str] = Counter()
    for i, number in enumerate(signals):
        (moment,) = rng.choices(list(MOMENTS), list(MOMENTS.values()))
        in_save = kill(broken, number, moment, log, rng)
        count[f"{number.name} in a save" if in_save else number.name] += 1
        print(f"{i + 1:3} {number.name} {moment:8} whole: {checkpoints(broken)}", flush=True)
    batch = preset("debug").batch_size
    steps = (checkpoints(broken)[-1] + 5) * batch
    subprocess.run(command(broken, "--resume", "--steps", steps), check=True, stdout=sys.stderr)
    subprocess.run(
        command(whole, "--preset", "debug", "--steps", steps), check=True, stdout=sys.stderr
    )
    ours, theirs = records(broken), records(whole)
    differ = sum(a != b for a, b in zip(ours, theirs, strict=False)) + abs(len(ours) - len(theirs))
    print(", ".join(f"{name}: {n}" for name, n in sorted(count.items())))
    print(f"{differ} of {len(theirs)} records differ from the undisturbed training's")
    return 1 if differ else 0


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main))
    except Failure as error:
        sys.exit(f"error: {error}")
