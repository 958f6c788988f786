"""The questions of `benchmarks.gpu --all`, each in a process of its own; see gpu_all.py.

python -m benchmarks.gpu_parts --part seeds --preset laptop
"""

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks import timing
from kslc_jax.config import Config, preset

Numbers = dict[str, Any]

SEEDS = 5

STEPS = 8
"""Train steps of the trainings that must agree. They are saved after half of them."""

SPEED = 3.5
"""Commands [m/s] until which `large` trains."""


@dataclass(frozen=True)
class Args:
    """One question, in this process. Its last line of output is JSON."""

    part: Literal["seeds", "exact", "resumed", "paper", "large", "brax"]
    """The part. exact and resumed: the two processes of one part."""
    preset: str = "laptop"
    """Preset of all parts but `paper`."""
    repeats: int = 5
    """Timed train steps."""
    folder: Path | None = None
    """exact and resumed: folder of their checkpoint."""
    train_seconds: float = 0.0
    """large: time [s] of this process, with compiling, that its trainings share; 0 trains none."""


def _say(text: str) -> None:
    """Prints progress. Standard output is for the numbers."""
    print(text, file=sys.stderr, flush=True)


def compiled(make: tuple[Any, Any]) -> tuple[Any, Any, Numbers]:
    """(first state, compiled train step, seconds). It compiles both at the same time."""
    import jax

    init, step = make
    start = time.monotonic()

    def done(do: Callable[[], Any]) -> tuple[Any, float]:
        return do(), time.monotonic() - start

    like = jax.eval_shape(init)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(done, init)
        second = pool.submit(done, lambda: step.lower(like).compile())
        (state, until_state), (program, until_step) = first.result(), second.result()
    return state, program, {"first state": until_state, "train step": until_step}


def programs(makes: dict[str, tuple[Any, Any]]) -> dict[str, tuple[Any, Any]]:
    """(first state, compiled train step) of several trainings; all compile at the same time."""
    with ThreadPoolExecutor(len(makes)) as pool:
        done = pool.map(compiled, makes.values())
        return {name: (state, step) for name, (state, step, _) in zip(makes, done, strict=True)}


def in_turn(programs: dict[str, tuple[Any, Any]], repeats: int) -> dict[str, float]:
    """Median seconds of a step of each (first state, train step)."""
    from benchmarks import throughput

    runs = {name: throughput.stepping(lambda s=s: s, step) for name, (s, step) in programs.items()}
    return timing.medians(timing.in_turn(runs, repeats))


def seeds(args: Args) -> Numbers:
    """One seed and five seeds in one program, in turn."""
    from kslc_jax import train_step
    from kslc_jax.training import seeds as seeds_lib

    config = preset(args.preset)
    makes = {"one": train_step.make(config), "five": seeds_lib.make(config, SEEDS)}
    seconds = in_turn(programs(makes), args.repeats)
    return {
        "one seed, steps/s": config.batch_size / seconds["one"],
        f"{SEEDS} seeds, steps/s in all": SEEDS * config.batch_size / seconds["five"],
        f"{SEEDS} seeds in turn, times as long": SEEDS * seconds["one"] / seconds["five"],
    }


def exact(args: Args) -> Numbers:
    """Two runs in this process, and a third that resumes from the checkpoint of the first."""
    import jax

    from kslc_jax import train_step
    from kslc_jax.training.checkpoint import Store

    config, folder = preset(args.preset), _required(args.folder)
    init, _ = make = train_step.make(config)
    state, program, seconds = compiled(make)
    store = Store(folder)
    first = _sums(state, program, STEPS, lambda s: store.save(s, config, {}))
    store.wait()
    again = _sums(init(), program, STEPS)
    resumed = _sums(store.restore(jax.eval_shape(init), _say), program, STEPS // 2)
    store.close()
    timed = in_turn({"step": (init(), program)}, args.repeats)
    return {
        "sums": first,
        "two runs": again == first,
        "resume in one process": resumed == first[STEPS // 2 :],
        "steps/s": config.batch_size / timed["step"],
        "compile seconds, in two threads": seconds,
    }


def resumed(args: Args) -> Numbers:
    """A run in another process, and one that resumes from the checkpoint of `exact`."""
    import jax

    from kslc_jax import train_step
    from kslc_jax.training.checkpoint import Store

    init, step = train_step.make(preset(args.preset))
    like = jax.eval_shape(init)
    program = step.lower(like).compile()
    store = Store(_required(args.folder))
    from_disk = _sums(store.restore(like, _say), program, STEPS // 2)
    store.close()
    return {"sums": _sums(init(), program, STEPS), "resumed": from_disk}


def _sums(
    state: Any, program: Any, steps: int, at_half: Callable[[Any], None] | None = None
) -> list[int]:
    """A checksum of the whole state after each of `steps` train steps."""
    from kslc_jax.checkpoint_format import checksum

    sums = []
    for number in range(1, steps + 1):
        state, _ = program(state)
        sums.append(checksum(state))
        if at_half and 2 * number == steps:
            at_half(state)
    return sums


def _required(folder: Path | None) -> Path:
    if folder is None:
        raise ValueError("this part needs --folder")
    return folder


def paper(args: Args) -> Numbers:
    """The preset's name is that of the part, unless another one is given."""
    from kslc_jax import train_step

    config = preset(args.preset)
    state, program, seconds = compiled(train_step.make(config))
    median = in_turn({"step": (state, program)}, args.repeats)["step"]
    return {"steps/s": config.batch_size / median, "compile seconds, in two threads": seconds}


def large(args: Args) -> Numbers:
    """Trainings begin from new first states.

    Each training gets an equal share of the time that is left after those before it.
    """
    ends = time.monotonic() + args.train_seconds
    from kslc_jax import train_step

    configs = larger(preset(args.preset))
    makes = {name: train_step.make(config) for name, config in configs.items()}
    made = programs(makes)
    seconds = in_turn(made, args.repeats)
    numbers: Numbers = {
        f"{name}, steps/s": configs[name].batch_size / s for name, s in seconds.items()
    }
    for name, value in numbers.items():
        _say(f"{name}: {value:.0f}")  # in case that a training is killed
    waiting = list(made.items()) if args.train_seconds else []
    while waiting:
        share = (ends - time.monotonic()) / len(waiting)
        name, (_, program) = waiting.pop(0)
        took = until(SPEED, makes[name][0](), program, share)
        numbers[f"{name}, seconds and train steps to {SPEED} m/s"] = took
        _say(f"{name}: {took}")
    return numbers


def larger(base: Config) -> dict[str, Config]:
    """2 and 4 times the environments and the minibatches, so that these stay as large as before."""
    configs = {}
    for factor in (2, 4):
        config = timing.resized(base, factor * base.env.num_envs)
        ppo = dataclasses.replace(config.ppo, minibatches=factor * base.ppo.minibatches)
        name = f"{config.env.num_envs} x {ppo.rollout_steps}, {ppo.minibatches} minibatches"
        configs[name] = dataclasses.replace(config, ppo=ppo)
    return configs


def until(speed: float, state: Any, program: Any, seconds: float) -> tuple[float, int] | None:
    """(seconds, train steps) until the commands reach `speed` [m/s].

    None if they do not within `seconds`.
    """
    start = time.monotonic()
    while time.monotonic() - start < seconds:
        state, metrics = program(state)
        if float(metrics["curriculum/v_max"]) >= speed:  # waits for the train step
            return time.monotonic() - start, int(metrics["step"])
    return None


def brax(args: Args) -> Numbers:
    """See `comparison`."""
    from benchmarks import comparison

    config = preset(args.preset)
    seconds = comparison.on_mjx(config, args.repeats, ("brax",))
    return comparison.summary(seconds, config.batch_size)


PARTS: dict[str, Callable[[Args], Numbers]] = {
    "seeds": seeds,
    "exact": exact,
    "resumed": resumed,
    "paper": paper,
    "large": large,
    "brax": brax,
}


def main(args: Args) -> None:
    """Prints the numbers of one part as JSON, with the machine."""
    numbers = PARTS[args.part](args)
    print(json.dumps({"machine": timing.machine(), **numbers}))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
