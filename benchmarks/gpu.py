"""All that is worth knowing about a machine with an accelerator, in one go of minutes; no network.

1. Control steps/s of physics alone, of the rollout and of whole training, over environments.
2. Whole training at other matrix-product precisions of networks and signals (the physics always
   computes in full float32).
3. Training until the time is up, from the start or from what an earlier go left.

The folder `--out` then holds three files, small enough to carry away: `results.json`,
`metrics.jsonl` and `checkpoint.tgz`. Unpacked, the last is a checkpoint without environments: all
of `evaluate`, `play` and `export` take it, and so does `--start` here.

  python -m benchmarks.gpu --out go1 [--minutes 8.5] [--num-envs 4096 1024 8192 16384 2048]
  python -m benchmarks.gpu --out go2 --start go1/checkpoint.tgz --only-train
  python -m benchmarks.gpu --out tiny --tiny        # does it run? On any machine
"""

import contextlib
import dataclasses
import json
import shutil
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import orbax.checkpoint as ocp
import tyro

from benchmarks import throughput, timing
from kslc_jax import checkpoint, memory, train_step
from kslc_jax.checkpoint import BEST_METRIC, Store
from kslc_jax.config import Config, preset
from kslc_jax.train_step import TrainState

Run = Callable[[], Any]

START = time.monotonic()

MEASURING = 0.6
"""Share of the time after which no new measurement is begun."""


def first_calls(makes: dict[str, Callable[[], Run]]) -> dict[str, Run]:
    """Makes all runs and calls each once, at the same time: XLA compiles one program a core."""

    def one(make: Callable[[], Run]) -> Run:
        run = make()
        run()
        return run

    with ThreadPoolExecutor() as pool:
        return dict(zip(makes, pool.map(one, makes.values()), strict=True))


def throughputs(config: Config, repeats: int) -> dict[str, float]:
    """Control steps/s of each part, and the seconds that all of them took to compile."""
    start = time.monotonic()
    runs = first_calls({name: lambda m=make: m(config) for name, make in throughput.PARTS.items()})
    compiling = time.monotonic() - start
    seconds = timing.medians(timing.in_turn(runs, repeats))
    rates = {name: config.batch_size / s for name, s in seconds.items()}
    return {**rates, "compile seconds, in parallel": compiling}


def precisions(config: Config, names: Iterable[str], repeats: int) -> dict[str, float]:
    """Control steps/s of whole training under each matrix-product precision."""

    def make(name: str) -> Run:
        with jax.default_matmul_precision(name):
            run = throughput.training(config)
            run()

        def again() -> None:
            with jax.default_matmul_precision(name):
                run()

        return again

    runs = first_calls({name: lambda n=name: make(n) for name in names})
    seconds = timing.medians(timing.in_turn(runs, repeats))
    return {name: config.batch_size / s for name, s in seconds.items()}


def peak_gib() -> float | None:
    """Most device memory held so far; None where the device does not say."""
    stats = jax.devices()[0].memory_stats() or {}
    return stats["peak_bytes_in_use"] / 2**30 if "peak_bytes_in_use" in stats else None


def measure(args: "Args", base: Config, deadline: float) -> dict[str, Any]:
    """Steps 1 and 2, as much of them as there is time for."""
    sizes: dict[str, Any] = {}
    longest = 0.0
    for n in args.num_envs:
        begun = time.monotonic()
        if begun + longest > deadline:
            break
        sizes[str(n)] = throughputs(timing.resized(base, n), args.repeats)
        sizes[str(n)]["peak GiB so far"] = peak_gib()
        longest = max(longest, time.monotonic() - begun)
        print(n, "environments:", sizes[str(n)], flush=True)
    result = {"num_envs": sizes}
    if time.monotonic() + longest < deadline:
        result["precision"] = precisions(base, args.precisions, args.repeats)
        print("precisions:", result["precision"], flush=True)
    return result


def start_from(archive: Path, state: TrainState) -> TrainState:
    """`state` with everything but the environments as an earlier go left it."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(archive) as file:
            file.extractall(folder, filter="data")
        (found,) = Path(folder).iterdir()
        parts = checkpoint._split(state)
        items = {
            name: ocp.args.StandardRestore(checkpoint._abstract(parts[name]))
            for name in ("params", "core")
        }
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
            kept = reader.restore(found, args=ocp.args.Composite(**items))
    return checkpoint._join({"env": state.env, **{name: kept[name] for name in items}}, state)


def keep(out: Path, config: Config, state: TrainState, metrics: dict[str, float]) -> None:
    """Writes `checkpoint.tgz`: a checkpoint without its environments."""
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.closing(Store(Path(folder))) as store:
            store.save(state, config, metrics)
        saved = Path(folder) / checkpoint.FOLDER / str(int(state.step))
        shutil.rmtree(saved / "env")
        whole = out / "checkpoint.tgz.part"
        with tarfile.open(whole, "w:gz") as file:
            file.add(saved, arcname=saved.name)
        whole.replace(out / "checkpoint.tgz")


def train(args: "Args", config: Config, deadline: float) -> dict[str, Any]:
    """Step 3; what it came to."""
    init, step = train_step.make(config)
    state = init()
    if args.start is not None:
        state = start_from(args.start, state)
    begun = time.monotonic()
    compiled = step.lower(state).compile()
    result = {"compile seconds": time.monotonic() - begun, "first step": int(state.step) + 1}
    like = jax.eval_shape(init)
    result["GiB estimated"] = memory.estimate(config, like) / 2**30
    used = memory.measured(compiled)
    if used is not None:
        result["GiB by XLA"] = used / 2**30
    begun, done, saved = time.monotonic(), 0, time.monotonic()
    record: dict[str, float] = {}
    with (args.out / "metrics.jsonl").open("w") as file:
        while done < args.train_steps and time.monotonic() < deadline:
            state, metrics = compiled(state)
            record = {name: float(value) for name, value in jax.device_get(metrics).items()}
            record |= {"seconds": time.monotonic() - begun}
            record |= {BEST_METRIC: record["curriculum/v_max"] + record["curriculum/tracking"]}
            file.write(json.dumps(record) + "\n")
            file.flush()
            done += 1
            if time.monotonic() - saved > args.save_seconds:
                saved = time.monotonic()
                keep(args.out, config, state, record)
    seconds = time.monotonic() - begun
    if done:
        keep(args.out, config, state, record)
    return {**result, "steps": done, "steps per second": done * config.batch_size / seconds}


@dataclass(frozen=True)
class Args:
    """Measures a machine with an accelerator and trains on it."""

    out: Path
    """Folder for the three files."""
    preset: str = "paper"
    """Whose sizes to use."""
    engine: Literal["mjx", "mujoco"] = "mjx"
    """Physics engine."""
    minutes: float = 8.5
    """When to stop, counted from the start of this program."""
    num_envs: tuple[int, ...] = (4096, 1024, 8192, 16384, 2048)
    """Environments, the most wanted first: where time is short the last are left out."""
    precisions: tuple[str, ...] = ("float32", "tensorfloat32", "bfloat16")
    """Matrix-product precisions."""
    repeats: int = 5
    """Timed calls of each part."""
    train_steps: int = 10**9
    """Most train steps, if the time does not end first."""
    save_seconds: float = 120.0
    """Time between two checkpoints."""
    start: Path | None = None
    """checkpoint.tgz of an earlier go to train on from."""
    only_train: bool = False
    """Leave the measurements out."""
    tiny: bool = False
    """Seconds instead of minutes: the debug preset's sizes, everything once."""


TINY = {"preset": "debug", "num_envs": (16, 32), "precisions": ("float32",), "repeats": 1}


def main(args: Args) -> None:
    """Measures, trains, writes."""
    if args.tiny:
        args = dataclasses.replace(args, **TINY, train_steps=2)
    args.out.mkdir(parents=True, exist_ok=True)
    config = timing.on_engine(preset(args.preset), args.engine)
    seconds = 60.0 * args.minutes
    result: dict[str, Any] = {"preset": args.preset, "engine": args.engine}
    if not args.only_train:
        result |= measure(args, config, START + MEASURING * seconds)
        timing.report(result, args.out / "results.json")
    result["training"] = train(args, config, START + seconds)
    result["peak GiB"] = peak_gib()
    print("training:", result["training"])
    timing.report(result, args.out / "results.json")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
