"""Whole trainings side by side: ours, Brax's PPO, PureJaxRL's loop, rsl_rl on torch.

Same robot, physics settings, networks, batch, minibatches and epochs; all sides train one step each
in turn, several times. Two tables:

- on the `mjx` engine: ours, Brax's `ppo.train` (see brax_ppo.py for what could not be made the
  same) and a loop of PureJaxRL's shape (purejaxrl.py), each with the preset's own networks;
- on C MuJoCo: ours, the same loop on the same engine, and rsl_rl's PPO over worker processes
  (torch_rsl.py), each with plain networks, for torch has no symmetric ones.

  pip install brax gymnasium rsl-rl-lib torch
  python -m benchmarks.comparison [--repeats 5] [--json comparison.json]
  python -m benchmarks.comparison --short       # small sizes: does everything still run?
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks import purejaxrl, throughput, timing
from kslc_jax.config import Config, preset

OURS = "kslc_jax"

Side = Literal["brax", "purejaxrl", "torch"]


def on_mjx(config: Config, repeats: int, sides: tuple[Side, ...]) -> timing.Seconds:
    """Seconds a train step on the mjx engine."""
    config = timing.on_engine(config, "mjx")
    runs = {OURS: throughput.training(config)}
    if "purejaxrl" in sides:
        runs["purejaxrl"] = throughput.stepping(*purejaxrl.make(config))
    if "brax" in sides:
        from benchmarks import brax_ppo

        runs["brax"] = brax_ppo.make(config, repeats + 2)
        runs["brax"]()  # it compiles in its first two steps
    return timing.in_turn(runs, repeats)


def on_c_mujoco(config: Config, repeats: int, sides: tuple[Side, ...]) -> timing.Seconds:
    """Seconds a train step with C MuJoCo's physics and plain networks."""
    config = timing.on_engine(config, "mujoco")
    config = dataclasses.replace(
        config, network=dataclasses.replace(config.network, symmetric=False)
    )
    runs = {OURS: throughput.training(config)}
    if "purejaxrl" in sides:
        runs["purejaxrl"] = throughput.stepping(*purejaxrl.make(config))
    if "torch" in sides:
        from benchmarks import torch_rsl

        runs["torch"] = torch_rsl.make(config)
    return timing.in_turn(runs, repeats)


TABLES = {"mjx": on_mjx, "mujoco": on_c_mujoco}


def summary(seconds: timing.Seconds, batch: int) -> dict[str, dict[str, Any]]:
    """Steps/s of each side, and how many times as fast ours is: median and range over repeats."""
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
    """Whose sizes to use."""
    repeats: int = 5
    """Timed train steps of each side."""
    engines: tuple[Literal["mjx", "mujoco"], ...] = ("mujoco", "mjx")
    """Which tables to make."""
    sides: tuple[Side, ...] = ("brax", "purejaxrl", "torch")
    """Whom to compare with."""
    short: bool = False
    """The debug preset's sizes, everything once."""
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
