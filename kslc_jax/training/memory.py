"""The memory of each device that a training takes: reckoned before it compiles, read off after.

A train step has two phases, of which the larger one counts. The rollout fills the trajectory and
needs what one control step needs. The update keeps frames and samples, and adds a minibatch: its
windows of frames, and what its networks keep for the gradient. Numbers are 32 bits wide. The
constants below are read off XLA's buffer assignments; docs/performance.md compares.
"""

import dataclasses
import os
from typing import Any

import jax

from kslc_jax import observations, physics
from kslc_jax.config import NUM_JOINTS, Config, ConfigError
from kslc_jax.train_step import TrainState

NUMBER = 4
"""Bytes of a number."""

KEPT_PER_UNIT = 3
"""Numbers that each hidden unit keeps for a sample's gradient: its input, its output, the slope."""

STATES_PER_STEP = 3
"""Environment states that a control step has at a time: the old, the new, the chosen."""

MJX_STEP = 25 * 2**10
"""Bytes of one environment in MJX's physics step: its model, data, contacts and solver."""

COPIES_OF_NETWORKS = 3
"""The gradient, its scaled update, and the new parameters, beside those of the state."""

PROCESS = 2**30
"""Bytes of a process that trains on the CPU, before its first train step: Python, JAX, compiler."""


def estimate(config: Config, like: TrainState, devices: int = 1) -> int:
    """Bytes that the train step takes on each device. `like` has the shapes of the whole state."""
    environments = _bytes(like.env) / devices
    networks = _bytes(like.learner) + COPIES_OF_NETWORKS * _bytes(like.learner.params)
    phases = _rollout(config, environments, devices), _update(config, devices)
    return round(environments + networks + max(phases))


def _rollout(config: Config, environments: float, devices: int) -> float:
    """Bytes of the trajectory and of one control step."""
    n, t = config.env.num_envs / devices, config.ppo.rollout_steps
    terms = len(dataclasses.fields(config.rewards.weights))
    frame = observations.ACTOR_WIDTH + observations.CRITIC_WIDTH
    trajectory = n * t * (frame + _sample() + terms)
    mjx = n * MJX_STEP if physics.resolve_engine(config.physics) == "mjx" else 0
    return NUMBER * trajectory + STATES_PER_STEP * environments + mjx


def _update(config: Config, devices: int) -> float:
    """Bytes of frames and samples, all of them on each device, and of a device's minibatch."""
    env, network, t = config.env, config.network, config.ppo.rollout_steps
    actor, critic = observations.ACTOR_WIDTH, observations.CRITIC_WIDTH
    frames = (t + env.frames - 1) * actor + (t + env.privileged_frames - 1) * critic
    window = env.frames * actor + env.privileged_frames * critic
    inputs = window * (2 if network.symmetric else 1)  # and split into even and odd parts
    kept = KEPT_PER_UNIT * (sum(network.actor) + sum(network.critic))
    minibatch = config.minibatch_size / devices * (inputs + kept)
    return NUMBER * (env.num_envs * frames + config.batch_size * _sample() + minibatch)


def _sample() -> int:
    """Numbers of a sample beside its observation: action, mean; index, log_prob, value, advantage,
    target, valid."""
    return 2 * NUM_JOINTS + 6


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def measured(compiled: Any) -> int | None:
    """Bytes on each device that XLA has planned for a compiled train step; None where unknown."""
    analysis = getattr(compiled, "memory_analysis", lambda: None)()
    if analysis is None:
        return None
    new = analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    return analysis.argument_size_in_bytes + new + analysis.temp_size_in_bytes


def shown(size: float) -> str:
    """A number of bytes for people."""
    number, unit = (size / 2**30, "GiB") if size >= 2**30 else (size / 2**20, "MiB")
    return f"{number:.{1 if number < 10 else 0}f} {unit}"


def check(config: Config, like: TrainState, devices: int = 1) -> None:
    """ConfigError where a training cannot fit into its devices' memory."""
    device = jax.local_devices()[0]
    memory = (device.memory_stats() or {}).get("bytes_limit")
    before = _bytes(like.env) / devices + _bytes(like.learner)  # the loop keeps a copy
    need = estimate(config, like, devices) + before
    if memory is None:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") - PROCESS
    if need > memory:
        raise ConfigError(
            f"env.num_envs, env.frames, ppo.rollout_steps, ppo.minibatches and network sizes need "
            f"about {shown(need)}; {device.device_kind} has {shown(memory)}"
        )
