"""Memory of a training on each device: an estimate before it compiles, XLA's plan afterwards.

A train step has two phases; the larger one counts. The rollout needs the trajectory and the arrays
of one control step. The update needs the frames, the samples and one minibatch, on a CPU a piece of
it: its windows of frames, and the activations that its networks keep for the gradient. The sizes of
arrays come from the shapes of the program. The constants below come from XLA's buffer assignments.
docs/performance.md compares the estimate with measurements.
"""

import dataclasses
import functools
from typing import Any

import jax

from kslc_jax import physics, processors, rollout, train_step
from kslc_jax.config import Config, ConfigError, RunConfig
from kslc_jax.ppo import Samples, pieces
from kslc_jax.rollout import Trajectory
from kslc_jax.train_step import TrainState

NUMBER = 4
"""Bytes of one number."""

KEPT_PER_UNIT = 3
"""Numbers that the gradient of a sample needs per hidden unit: its input, its output, the slope."""

STATES_PER_STEP = 3
"""Environment states that a control step holds at once: the old, the new and the selected one."""

MJX_STEP = 25 * 2**10
"""Bytes of one environment in MJX's physics step: model, data, contacts and solver."""

COPIES_OF_NETWORKS = 3
"""Copies of the parameters besides those of the state: gradient, scaled update, new parameters."""

PROCESS = 2**30
"""Bytes that Python, JAX and the compiler take in a training on the CPU, before its first step."""


def estimate(config: Config, devices: int = 1) -> int:
    """Bytes that the train step takes on each device."""
    state, trajectory, samples = shapes(config)
    environments = _bytes(state.env) / devices
    networks = _bytes(state.learner) + COPIES_OF_NETWORKS * _bytes(state.learner.params)
    in_rollout = _rollout(config, trajectory, environments, devices)
    in_update = _update(config, state, trajectory, samples, devices)
    return round(environments + networks + max(in_rollout, in_update))


def shapes(config: Config) -> tuple[TrainState, Trajectory, Samples]:
    """Shapes of the state, of a rollout and of its samples (cached; seed and run do not matter).

    The traced program leaves the physics out: it takes long to trace, and changes no shape.
    """
    return _shapes(dataclasses.replace(config, seed=0, run=RunConfig()))


@functools.lru_cache(maxsize=8)
def _shapes(config: Config) -> tuple[TrainState, Trajectory, Samples]:
    def one() -> tuple[TrainState, Trajectory, Samples]:
        state = train_step.init(config, 0)
        args = state.learner.params, state.env, state.curriculum, state.key
        _, trajectory = rollout.collect(config, *args, simulate=lambda _, state, *more: state)
        samples = train_step.samples_of(config, trajectory, trajectory.value[-1])
        return state, trajectory, samples

    return jax.eval_shape(one)


def _rollout(config: Config, trajectory: Trajectory, environments: float, devices: int) -> float:
    """Bytes of the trajectory and of one control step."""
    mjx = config.env.num_envs * MJX_STEP if physics.resolve_engine(config.physics) == "mjx" else 0
    return (_bytes(trajectory) + mjx) / devices + STATES_PER_STEP * environments


def _update(
    config: Config, state: TrainState, trajectory: Trajectory, samples: Samples, devices: int
) -> float:
    """Bytes of all frames and samples, which each device holds, and of what it has of a piece of a
    minibatch."""
    histories = state.env.history, state.env.privileged_history
    before = sum(_bytes(history) * (1 - 1 / history.shape[1]) for history in histories)
    read = trajectory.frame, trajectory.privileged, trajectory.velocity
    frames = _bytes(read) + before
    window = _bytes(histories) / config.env.num_envs
    inputs = window * (2 if config.network.symmetric else 1)  # a copy in even and odd parts
    units = sum(config.network.actor + config.network.critic + config.network.estimator)
    kept = NUMBER * KEPT_PER_UNIT * units
    at_once = config.minibatch_size / pieces(config.minibatch_size) / devices
    return frames + _bytes(samples) + at_once * (inputs + kept)


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def measured(compiled: Any) -> int | None:
    """Bytes that XLA plans for a compiled train step on each device; None if unknown."""
    analysis = getattr(compiled, "memory_analysis", lambda: None)()
    if analysis is None:
        return None
    new = analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    return analysis.argument_size_in_bytes + new + analysis.temp_size_in_bytes


def shown(size: float) -> str:
    """A number of bytes as text, in MiB or GiB."""
    number, unit = (size / 2**30, "GiB") if size >= 2**30 else (size / 2**20, "MiB")
    return f"{number:.{1 if number < 10 else 0}f} {unit}"


def check(config: Config, devices: int = 1, seeds: int = 1) -> None:
    """ConfigError if a training, or `seeds` of them, do not fit into the memory of the devices."""
    device = jax.local_devices()[0]
    memory = (device.memory_stats() or {}).get("bytes_limit")
    state, *_ = shapes(config)
    before = _bytes(state.env) / devices + _bytes(state.learner)  # the loop keeps a copy
    need = seeds * (estimate(config, devices) + before)
    if memory is None:
        memory = processors.memory() - PROCESS
    if need > memory:
        many = "--seeds, " * (seeds > 1)
        raise ConfigError(
            f"the training needs about {shown(need)}, {device.device_kind} has {shown(memory)}: "
            f"lower {many}env.num_envs, env.frames, ppo.rollout_steps or the network sizes, or "
            "raise ppo.minibatches"
        )
