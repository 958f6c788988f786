"""Whole-training throughput, and the ceiling above it: control steps/s, medians and ratios.

Runs physics alone (random actions), the rollout, and the whole train step of a preset in turn, a
few repeats each, so that drifts of the machine hit all alike.

  python benchmarks/throughput.py [--preset laptop] [--repeats 5] [--engines mujoco mjx]
"""

import dataclasses
import json
import statistics
import time
from collections.abc import Callable

from kslc_jax import runtime

runtime.prepare()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import tyro  # noqa: E402

from kslc_jax import physics, train_step  # noqa: E402
from kslc_jax.config import Config, preset  # noqa: E402


def physics_only(config: Config) -> Callable[[], None]:
    """One rollout's physics under random joint targets; nothing else."""
    state = train_step.init(config, 0).env

    def one(envs, key):
        target = 0.25 * jax.random.normal(key, (config.env.num_envs, 16))
        friction = config.randomize.ground_friction
        new = jax.vmap(lambda s, t, d: physics.step(config.physics, s, t, d, friction))(
            envs.physics, target, envs.dynamics
        )
        return envs.replace(physics=new), None

    keys = jax.random.split(jax.random.key(0), config.ppo.rollout_steps)
    run = jax.jit(lambda envs: jax.lax.scan(one, envs, keys)[0].physics.qpos)
    return lambda: run(state).block_until_ready()


def rollout(config: Config) -> Callable[[], None]:
    """One rollout: physics, environment and networks, no learning."""
    state = train_step.init(config, 0)

    def one(state):
        params, key = state.learner.params, state.key
        return train_step.rollout(config, params, state.env, state.curriculum, key)[1].value

    run = jax.jit(one)
    return lambda: run(state).block_until_ready()


def training(config: Config) -> Callable[[], None]:
    """The whole train step."""
    init, step = train_step.make(config)
    held = [init()]

    def run():
        held[0], metrics = step(held[0])
        jnp.asarray(metrics["reward"]).block_until_ready()

    return run


PARTS = {"physics only": physics_only, "rollout": rollout, "whole training": training}


def measure(config: Config, repeats: int) -> dict[str, float]:
    """Median control steps/s of each part; the first call of each compiles and is not counted."""
    runs = {name: make(config) for name, make in PARTS.items()}
    for run in runs.values():
        run()
    seconds = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: config.batch_size / statistics.median(s) for name, s in seconds.items()}


def main(
    preset_name: str = "laptop", repeats: int = 5, engines: tuple[str, ...] = ("mujoco", "mjx")
) -> None:
    """Prints a table and one JSON line.

    Args:
      preset_name: whose sizes to use.
      repeats: timed calls of each part.
      engines: physics engines to compare.
    """
    base = preset(preset_name)
    results = {}
    for engine in engines:
        config = dataclasses.replace(base, physics=dataclasses.replace(base.physics, engine=engine))
        results[engine] = measure(config, repeats)
        for name, rate in results[engine].items():
            share = rate / results[engine]["physics only"]
            print(f"{engine:8} {name:16} {rate:9.0f} steps/s   {share:5.2f} of physics only")
    if len(engines) == 2:
        a, b = (results[e]["whole training"] for e in engines)
        print(f"whole training, {engines[0]} / {engines[1]}: {a / b:.2f}x")
    print(json.dumps({"preset": preset_name, "device": jax.devices()[0].device_kind, **results}))


if __name__ == "__main__":
    tyro.cli(main)
