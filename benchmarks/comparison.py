"""Whole trainings side by side: ours, Brax's PPO, PureJaxRL's loop, rsl_rl on torch.

All have the same robot, physics settings, networks, batch, minibatches and epochs. None has the
velocity estimator, which Brax and torch lack. They take turns, one train step each, several times.
There are two tables:

- On the `mjx` engine: ours, Brax's `ppo.train` (brax_ppo.py names the differences), and a loop in
  the form of PureJaxRL (purejaxrl.py). All use the networks of the preset.
- On C MuJoCo: ours, the same loop on the same engine, and rsl_rl's PPO over worker processes
  (torch_rsl.py). All use plain networks, because torch has no symmetric ones.

  pip install brax gymnasium rsl-rl-lib torch
  python -m benchmarks.comparison [--repeats 5] [--json comparison.json]
  python -m benchmarks.comparison --short       # small sizes: tests that everything runs
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks import purejaxrl, throughput, timing
from kslc_jax.config import Config, preset

OURS = "kslc_jax"

Side = Literal["brax", "purejaxrl", "torch"]


def comparable(config: Config, **network: Any) -> Config:
    """The config with other fields of the networks, and without what only we have: the velocity
    estimator, and a critic that sees what rewards remember."""
    changed = dataclasses.replace(config.network, estimator=(), **network)
    env = dataclasses.replace(config.env, critic_memory=False)
    return dataclasses.replace(config, network=changed, env=env)


def on_mjx(config: Config, repeats: int, sides: tuple[Side, ...]) -> timing.Seconds:
    """Seconds of each train step on the mjx engine."""
    config = comparable(timing.on_engine(config, "mjx"))
    runs = {OURS: throughput.training(config)}
    if "purejaxrl" in sides:
        runs["purejaxrl"] = throughput.stepping(*purejaxrl.make(config))
    if "brax" in sides:
        from benchmarks import brax_ppo

        runs["brax"] = brax_ppo.make(config, repeats + 2)
    # All compile at the same time. Brax compiles in two steps; the second is in the first turn.
    with ThreadPoolExecutor(len(runs)) as pool:
        list(pool.map(lambda run: run(), runs.values()))
    return timing.in_turn(runs, repeats)


def on_c_mujoco(config: Config, repeats: int, sides: tuple[Side, ...]) -> timing.Seconds:
    """Seconds of each train step with C MuJoCo's physics and plain networks."""
    config = comparable(timing.on_engine(config, "mujoco"), symmetric=False)
    runs = {OURS: throughput.training(config)}
    if "purejaxrl" in sides:
        runs["purejaxrl"] = throughput.stepping(*purejaxrl.make(config))
    if "torch" in sides:
        from benchmarks import torch_rsl

        runs["torch"] = torch_rsl.make(config)
    return timing.in_turn(runs, repeats)


TABLES = {"mjx": on_mjx, "mujoco": on_c_mujoco}


def summary(seconds: timing.Seconds, batch: int) -> dict[str, dict[str, Any]]:
    """Steps/s of each side, and its time divided by ours: from medians, and the range of turns."""
    medians = timing.medians(seconds)
    return {
        name: {
            "steps_per_second": batch / medians[name],
            "times_slower": medians[name] / medians[OURS],
            "range": [
                f(s / o for s, o in zip(times, seconds[OURS], strict=True)) for f in (min, max)
            ],
        }
        for name, times in seconds.items()
    }


@dataclass(frozen=True)
class Args:
    """Control steps/s of whole trainings, and ratios."""

    preset: str = "laptop"
    """Preset that gives the sizes."""
    repeats: int = 5
    """Timed train steps of each side."""
    engines: tuple[Literal["mjx", "mujoco"], ...] = ("mujoco", "mjx")
    """Engines, one table each."""
    sides: tuple[Side, ...] = ("brax", "purejaxrl", "torch")
    """Trainings to compare with ours; each engine uses those that it supports."""
    short: bool = False
    """Sizes of the debug preset, and one timed step."""
    json: Path | None = None
    """File for the numbers."""


def main(args: Args) -> None:
    """Prints the tables."""
    if args.short:
        args = dataclasses.replace(args, preset="debug", repeats=1)
    config = preset(args.preset)
    results = {}
    for engine in args.engines:
        seconds = TABLES[engine](config, args.repeats, args.sides)
        results[engine] = summary(seconds, config.batch_size)
        for name, row in results[engine].items():
            low, high = row["range"]
            print(
                f"{engine:7} {name:10} {row['steps_per_second']:8.0f} steps/s   "
                f"ours is {row['times_slower']:5.2f} times as fast ({low:.2f} to {high:.2f})",
                flush=True,
            )
    timing.report({"preset": args.preset, "tables": results}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
