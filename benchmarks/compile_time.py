"""Start time of a training: imports, tracing, compilation, first step.

Each measurement is a separate process. The first process has an empty compilation cache. The second
uses the cache of the first.

  python -m benchmarks.compile_time [--presets laptop paper] [--engines mujoco mjx]
"""

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks import timing

START = time.perf_counter()


def once(preset_name: str, engine: str, num_envs: int | None) -> dict[str, float]:
    """Seconds of each phase of a start, in this process."""
    from kslc_jax import train_step
    from kslc_jax.config import preset

    marks = {"import": time.perf_counter()}
    config = timing.on_engine(timing.resized(preset(preset_name), num_envs), engine)
    init, step = train_step.make(config)
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


def cold_and_warm(preset_name: str, engine: str, num_envs: int | None) -> dict[str, dict]:
    """Seconds of the phases of a first start and of a second start."""
    args = ["--presets", preset_name, "--engines", engine, "--here"]
    args += [] if num_envs is None else ["--num-envs", str(num_envs)]
    with tempfile.TemporaryDirectory() as cache:
        return {
            name: timing.child(
                "benchmarks.compile_time", args, {"JAX_COMPILATION_CACHE_DIR": cache}
            )
            for name in ("cold", "warm")
        }


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
    here: bool = False
    """Measure the first preset and engine in this process and print JSON."""


def main(args: Args) -> None:
    """Prints a table."""
    if args.here:
        print(json.dumps(once(args.presets[0], args.engines[0], args.num_envs)))
        return
    results = {}
    for name in args.presets:
        for engine in args.engines:
            both = cold_and_warm(name, engine, args.num_envs)
            results[f"{name}, {engine}"] = both
            for which, seconds in both.items():
                phases = ", ".join(f"{phase} {s:.1f}" for phase, s in seconds.items())
                print(f"{name:8} {engine:8} {which}: {sum(seconds.values()):6.1f} s ({phases})")
    timing.report({"seconds": results}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
