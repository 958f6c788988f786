"""Control steps/s on a machine with an accelerator, in one run of minutes, without a network.

For each case, ENGINE:ENVIRONMENTSxSTEPS, it measures physics alone, the rollout and whole training.
Then it measures whole training at other matrix-product precisions of networks and signals; the
physics always computes in full float32. All programs compile first, at the same time, on all cores.
If a case fails, the benchmark prints it and goes on with the others.

With --all it answers five questions instead (gpu_all.py), in at most eight minutes: five seeds in
one program, the `paper` preset, larger batches, Brax, bit-exactness.

  python -m benchmarks.gpu --out gpu.json
  python -m benchmarks.gpu --all --out h100.json              # writes h100-seeds.json and so on
  python -m benchmarks.gpu --all --questions large --train --out h100.json   # time to 3.5 m/s
  python -m benchmarks.gpu --preset paper --cases mjx:4096x60 --out paper.json
  python -m benchmarks.gpu --preset debug --cases mjx:16x8 --precisions --repeats 1   # anywhere
"""

import dataclasses
import re
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from benchmarks import gpu_all, throughput, timing
from kslc_jax import processors, runtime
from kslc_jax.config import Config, ConfigError, preset

Run = Callable[[], Any]
Part = Literal["physics only", "rollout", "whole training"]


def shaped(base: Config, case: str) -> Config:
    """`base` with the engine, number of environments and rollout steps of a case."""
    found = re.fullmatch(r"(mjx|mujoco):(\d+)x(\d+)", case)
    if found is None:
        raise ConfigError(f"{case!r} is no case: mjx:2048x24 is one")
    engine, envs, steps = found[1], int(found[2]), int(found[3])
    config = timing.resized(timing.on_engine(base, engine), envs)
    return dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, rollout_steps=steps))


def at_precision(config: Config, name: str) -> Run:
    """A function that does one train step at a matrix-product precision."""
    run = throughput.training(config)

    def again() -> None:
        with jax.default_matmul_precision(name):
            run()

    return again


def first_calls(makes: Mapping[str, Callable[[], Run]]) -> dict[str, Run]:
    """Makes all runs and calls each once, in parallel, because XLA compiles a program on one core.

    Returns the runs that did not fail.
    """

    def one(name: str) -> Run | None:
        start = time.monotonic()
        try:
            run = makes[name]()
            run()
        except Exception as error:
            print(f"{name}: {runtime.first_line(error)}", flush=True)
            return None
        print(f"{name}: compiled after {time.monotonic() - start:.0f} s", flush=True)
        return run

    with ThreadPoolExecutor(processors.usable()) as pool:
        runs = dict(zip(makes, pool.map(one, makes), strict=True))
    return {name: run for name, run in runs.items() if run is not None}


def peak_gib() -> float | None:
    """Peak device memory so far [GiB]; None if the device does not report it."""
    stats = jax.devices()[0].memory_stats() or {}
    return stats["peak_bytes_in_use"] / 2**30 if "peak_bytes_in_use" in stats else None


@dataclass(frozen=True)
class Args:
    """Control steps/s on a machine with an accelerator."""

    out: Path | None = None
    """File for the numbers."""
    preset: str = "laptop"
    """Preset that gives the networks, and all values that a case does not set."""
    cases: tuple[str, ...] = ("mjx:2048x24", "mjx:4096x12", "mjx:8192x6")
    """ENGINE:ENVIRONMENTSxSTEPS. The default cases have the batch size of the laptop preset."""
    parts: tuple[Part, ...] = ("physics only", "rollout", "whole training")
    """Parts to measure in each case."""
    precisions: tuple[str, ...] = ("tensorfloat32", "float32")
    """More matrix-product precisions, measured with the whole training of the first case."""
    repeats: int = 5
    """Timed calls of each program."""
    all: bool = False
    """Answer the questions of `questions` instead; --cases, --parts and --precisions do not count.
    Each answer goes to a file of its own: --out gpu.json writes gpu-seeds.json, gpu-exact.json."""
    questions: tuple[gpu_all.Part, ...] = ("seeds", "paper", "large", "brax", "exact")
    """With --all: the questions, in this order."""
    budget: float = 420.0
    """With --all: no question begins after this time [s], and all end a minute later."""
    train: bool = False
    """With --all: larger batches also train until commands of 3.5 m/s, in the time that their
    question may take. Ask it alone: --questions large."""
    paper: str = "paper"
    """With --all: preset of the question `paper`. A test takes a small one."""


def main(args: Args) -> None:
    """Compiles all programs, measures them in turn, and prints a line for each."""
    if args.all:
        gpu_all.run(
            gpu_all.Plan(
                parts=args.questions,
                preset=args.preset,
                paper=args.paper,
                budget=args.budget,
                repeats=args.repeats,
                train=args.train,
                out=args.out,
            )
        )
        return
    try:
        configs = {case: shaped(preset(args.preset), case) for case in args.cases}
    except ConfigError as error:
        sys.exit(f"error: {error}")
    makes: dict[str, Callable[[], Run]] = {}
    sizes = {}
    for case, config in configs.items():
        for part in args.parts:
            makes[f"{case} {part}"] = partial(throughput.PARTS[part], config)
            sizes[f"{case} {part}"] = config.batch_size
    first = configs[args.cases[0]]
    for name in args.precisions:
        makes[name] = partial(at_precision, first, name)
        sizes[name] = first.batch_size
    start = time.monotonic()
    runs = first_calls(makes)
    compiling = time.monotonic() - start
    seconds = timing.medians(timing.in_turn(runs, args.repeats))
    rates = {name: sizes[name] / s for name, s in seconds.items()}
    for name, rate in rates.items():
        print(f"{name:32} {rate:10.0f} steps/s")
    print(f"{len(runs)} programs compiled in {compiling:.0f} s; peak {peak_gib()} GiB")
    result = {
        "preset": args.preset,
        "steps per second": rates,
        "compile seconds, in parallel": compiling,
        "peak GiB": peak_gib(),
    }
    timing.report(result, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
