"""Throughput of whole training and its upper limit, physics alone: median control steps/s, ratios.

It runs in turn: physics alone (random actions), the rollout, and the whole train step of a preset.

  python -m benchmarks.throughput [--preset laptop] [--repeats 5] [--engines mujoco mjx]

With --robot it runs in turn the whole train step of XBot-L and of that robot; with --cones, that of
elliptic friction cones and of pyramids; with --pieces, that in which a CPU takes a minibatch in
pieces, as it does, and that in which it takes it whole.

  python -m benchmarks.throughput --robot unitree_g1 --engines mujoco
  python -m benchmarks.throughput --cones
  python -m benchmarks.throughput --pieces --engines mujoco
"""

import dataclasses
import functools
import unittest.mock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import tyro

from benchmarks import timing
from kslc_jax import motors, physics, ppo, similar, train_step
from kslc_jax import rollout as rollout_lib
from kslc_jax.config import XBOT_L, Config, PhysicsConfig, preset


def physics_only(config: Config) -> Callable[[], Any]:
    """A function that runs only the physics of one rollout, with random joint targets."""
    state = train_step.make(config)[0]()
    scale = motors.action_scale(config.env, physics.robot_for(config.physics))

    def one(envs, key):
        target = scale * jax.random.normal(key, (config.env.num_envs, len(scale)))
        friction = config.randomize.ground_friction
        new = jax.vmap(lambda s, t, d: physics.step(config.physics, s, t, d, friction))(
            envs.physics, target, envs.dynamics
        )
        return envs.replace(physics=new), None

    keys = jax.random.split(state.key, config.ppo.rollout_steps)
    run = jax.jit(lambda envs: jax.lax.scan(one, envs, keys)[0].physics)
    return lambda: jax.block_until_ready(run(state.env))


def rollout(config: Config) -> Callable[[], Any]:
    """A function that runs one rollout: physics, environment and networks, without learning."""
    state = train_step.make(config)[0]()

    def one(state):
        params, key = state.learner.params, state.key
        return rollout_lib.collect(config, params, state.env, state.curriculum, key)

    run = jax.jit(one)
    return lambda: jax.block_until_ready(run(state))


def training(config: Config) -> Callable[[], Any]:
    """A function that does one train step, from the state after the last call."""
    return stepping(*train_step.make(config))


def stepping(init: Callable[[], Any], step: Callable[[Any], tuple[Any, Any]]) -> Callable[[], Any]:
    """A function that does one step, from the state after the last call."""
    held = [init()]

    def run():
        held[0], metrics = step(held[0])
        jax.block_until_ready(metrics)

    return run


def whole_minibatches(config: Config) -> Callable[[], Any]:
    """`training` in which a CPU takes each minibatch whole, see `ppo.pieces`."""
    init, _ = train_step.make(config)
    step = jax.jit(functools.partial(train_step.step, config), donate_argnums=0)
    with unittest.mock.patch.object(ppo, "pieces", lambda size: 1):
        compiled = step.lower(jax.eval_shape(init)).compile()
    return stepping(init, compiled)


PARTS = {"physics only": physics_only, "rollout": rollout, "whole training": training}


def measure(config: Config, repeats: int) -> dict[str, float]:
    """Median control steps/s of each part."""
    runs = {name: make(config) for name, make in PARTS.items()}
    seconds = timing.medians(timing.in_turn(runs, repeats))
    return {name: config.batch_size / s for name, s in seconds.items()}


@dataclass(frozen=True)
class Args:
    """Control steps/s of physics alone, of the rollout and of whole training."""

    preset: str = "laptop"
    """Preset that gives the sizes."""
    num_envs: int | None = None
    """Number of environments. The default is that of the preset."""
    repeats: int = 5
    """Timed calls of each part."""
    engines: tuple[str, ...] = ("mujoco", "mjx")
    """Physics engines to compare."""
    robot: str | None = None
    """Robot to compare with XBot-L: a shipped one, or the path of a description."""
    cones: bool = False
    """Compare the preset's elliptic cones with the pyramids of older runs, and their iterations;
    with --robot, for that robot."""
    pieces: bool = False
    """Compare a train step that takes each minibatch in pieces with one that takes it whole."""
    json: Path | None = None
    """File for the numbers."""


Made = tuple[Callable[[Config], Callable[[], Any]], Config]
"""A function such as `training`, and its config."""


def variants(args: Args, made: Mapping[str, Made]) -> None:
    """Prints the control steps/s of whole training of several variants, and their ratio to the
    first."""
    rates: dict[str, dict[str, float]] = {}
    for engine in args.engines:
        runs = {name: make(timing.on_engine(c, engine)) for name, (make, c) in made.items()}
        seconds = timing.medians(timing.in_turn(runs, args.repeats))
        rates[engine] = {name: c.batch_size / seconds[name] for name, (_, c) in made.items()}
        first = next(iter(made))
        for name, rate in rates[engine].items():
            ratio = rate / rates[engine][first]
            print(f"{engine:8} {name:16} {rate:9.0f} steps/s   {ratio:5.2f} of {first}", flush=True)
    timing.report({"preset": args.preset, "steps_per_second": rates}, args.json)


def cones(base: Config) -> dict[str, Made]:
    """A config with both shapes of the friction cone."""
    before = PhysicsConfig(robot=base.physics.robot)  # the defaults are those of older runs
    pyramidal = dataclasses.replace(base, physics=before)
    return {"elliptic": (training, base), "pyramidal": (training, pyramidal)}


def main(args: Args) -> None:
    """Prints a table."""
    base = timing.resized(similar.preset(args.preset, args.robot or XBOT_L), args.num_envs)
    if args.cones:
        variants(args, cones(base))
        return
    if args.pieces:
        variants(args, {"in pieces": (training, base), "whole": (whole_minibatches, base)})
        return
    if args.robot is not None:
        xbot = timing.resized(preset(args.preset), args.num_envs)
        named = {physics.robot_for(c.physics).name: (training, c) for c in (xbot, base)}
        variants(args, named)
        return
    results = {}
    for engine in args.engines:
        results[engine] = measure(timing.on_engine(base, engine), args.repeats)
        for name, rate in results[engine].items():
            share = rate / results[engine]["physics only"]
            print(
                f"{engine:8} {name:16} {rate:9.0f} steps/s   {share:5.2f} of physics only",
                flush=True,
            )
    whole = {engine: rates["whole training"] for engine, rates in results.items()}
    best = max(whole, key=lambda engine: whole[engine])
    for engine in whole.keys() - {best}:
        print(
            f"whole training: {best} is {whole[best] / whole[engine]:.2f} times as fast as {engine}"
        )
    timing.report({"preset": args.preset, "steps_per_second": results}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
