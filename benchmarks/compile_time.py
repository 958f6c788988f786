"""Start time of a training: imports, tracing, compilation, first step.

Each measurement is a separate process. The first process has an empty compilation cache. The second
uses the cache of the first.

With --pairs each start is measured twice: the programs of the first state and of the train step
compile one after the other, and in two threads, as in a training. Prints the medians and their
ratio.

  python -m benchmarks.compile_time [--presets laptop paper] [--engines mujoco mjx]
  python -m benchmarks.compile_time --presets laptop --pairs 3
"""

import json
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks import timing

START = time.perf_counter()


def once(
    preset_name: str, engine: str, num_envs: int | None, threads: bool = False
) -> dict[str, float]:
    """Seconds of each phase of a start, in this process. With `threads` it starts as a training."""
    import jax

    from kslc_jax import train_step
    from kslc_jax.config import preset
    from kslc_jax.training import loop

    marks = {"import": time.perf_counter()}
    config = timing.on_engine(timing.resized(preset(preset_name), num_envs), engine)
    init, step = train_step.make(config)
    if threads:
        state, compiled = loop.first_state_and_step(init, step, jax.eval_shape(init))
        marks["state, trace and compile"] = time.perf_counter()
    else:
        state = init()
        marks["initial state"] = time.perf_counter()
        lowered = step.lower(state)
        marks["trace"] = time.perf_counter()
        compiled = lowered.compile()
        marks["compile"] = time.perf_counter()
    float(compiled(state)[1]["reward"])
    marks["first step"] = time.perf_counter()
    starts = [START, *marks.values()]
    return {name: marks[name] - begun for name, begun in zip(marks, starts, strict=False)}


def cold_and_warm(
    preset_name: str, engine: str, num_envs: int | None, threads: bool = False
) -> dict[str, dict]:
    """Seconds of the phases of a first start and of a second start."""
    args = ["--presets", preset_name, "--engines", engine, "--here"]
    args += ["--threads"] * threads
    args += [] if num_envs is None else ["--num-envs", str(num_envs)]
    with tempfile.TemporaryDirectory() as cache:
        return {
            name: timing.child(
                "benchmarks.compile_time", args, {"JAX_COMPILATION_CACHE_DIR": cache}
            )
            for name in ("cold", "warm")
        }


def paired(preset_name: str, engine: str, num_envs: int | None, pairs: int) -> dict[str, dict]:
    """Median seconds of both kinds of start, measured in turn, and the ratio of the medians."""
    totals: dict[str, dict[str, list[float]]] = {"cold": {}, "warm": {}}
    for _ in range(pairs):
        for threads, kind in ((False, "one after the other"), (True, "in two threads")):
            for which, seconds in cold_and_warm(preset_name, engine, num_envs, threads).items():
                totals[which].setdefault(kind, []).append(sum(seconds.values()))
    found = {}
    for which, kinds in totals.items():
        medians = {kind: statistics.median(seconds) for kind, seconds in kinds.items()}
        found[which] = medians | {
            "ratio": medians["one after the other"] / medians["in two threads"]
        }
    return found


@dataclass(frozen=True)
class Args:
    """Seconds from starting Python to the end of the first train step."""

    presets: tuple[str, ...] = ("laptop", "paper")
    """Presets that give the sizes."""
    engines: tuple[str, ...] = ("mujoco", "mjx")
    """Physics engines."""
    num_envs: int | None = None
    """Number of environments. The default is that of each preset."""
    json: Path | None = None
    """File for the numbers."""
    pairs: int = 0
    """Number of pairs of starts; 0: single starts, phase by phase."""
    here: bool = False
    """Measure the first preset and engine in this process and print JSON."""
    threads: bool = False
    """With --here: start as a training does."""


def main(args: Args) -> None:
    """Prints a table."""
    if args.here:
        print(json.dumps(once(args.presets[0], args.engines[0], args.num_envs, args.threads)))
        return
    results = {}
    for name in args.presets:
        for engine in args.engines:
            if args.pairs:
                found = paired(name, engine, args.num_envs, args.pairs)
                results[f"{name}, {engine}"] = found
                for which, numbers in found.items():
                    parts = ", ".join(f"{what} {x:.2f}" for what, x in numbers.items())
                    print(f"{name:8} {engine:8} {which}: {parts}")
                continue
            both = cold_and_warm(name, engine, args.num_envs)
            results[f"{name}, {engine}"] = both
            for which, seconds in both.items():
                phases = ", ".join(f"{phase} {s:.1f}" for phase, s in seconds.items())
                print(f"{name:8} {engine:8} {which}: {sum(seconds.values()):6.1f} s ({phases})")
    timing.report({"seconds": results}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
