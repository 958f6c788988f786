"""A training over several devices, of one process or of many: who holds what.

Environments [N, ...] are split over a mesh of one axis; networks, optimiser, curriculum and
counters are on every device. The train step is the same program: `jit` with these shardings puts in
what the devices have to tell each other, and its numbers are those of one device up to the order of
sums. docs/scaling.md counts what is told.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from kslc_jax import physics, train_step
from kslc_jax.config import Config, ConfigError
from kslc_jax.train_step import Metrics, TrainState

AXIS = "env"


def join(
    coordinator: str | None = None, processes: int | None = None, index: int | None = None
) -> None:
    """Makes this process one of many, before JAX does anything else. Under Slurm, Open MPI,
    Kubernetes and on TPU pods JAX finds out by itself: no argument is needed.

    Args:
      coordinator: host:port that process 0 listens on and all others can reach.
      processes: how many there are.
      index: which one this is, from 0.
    """
    jax.distributed.initialize(coordinator, processes, index)


def mesh(config: Config, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """All devices of all processes, or those given, in a row; ConfigError if they cannot share."""
    devices = jax.devices() if devices is None else devices
    count = len(devices)
    if config.env.num_envs % count or config.minibatch_size % count:
        raise ConfigError(
            f"env.num_envs: {config.env.num_envs} environments and minibatches of "
            f"{config.minibatch_size} samples cannot be split evenly over {count} devices"
        )
    if count > 1 and physics.resolve_engine(config.physics) == "mujoco":
        raise ConfigError(f"physics.engine: mujoco runs on one device, not {count}; take mjx")
    return Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))


def shardings(mesh: Mesh, like: TrainState) -> TrainState:
    """Where each array of a training lives, as a tree of `like`'s structure."""
    everywhere = NamedSharding(mesh, PartitionSpec())
    split = NamedSharding(mesh, PartitionSpec(AXIS))
    placed = jax.tree.map(lambda _: everywhere, like)
    return placed.replace(env=jax.tree.map(lambda _: split, like.env))


def place(mesh: Mesh, state: TrainState) -> TrainState:
    """`state`, which any device may hold, as `make`'s train step takes it."""
    return jax.device_put(state, shardings(mesh, state))


def make(
    config: Config, mesh: Mesh
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """`train_step.make` over a mesh: (init, train_step), both jitted; train_step donates."""

    def spread(index: jax.Array) -> jax.Array:
        split = NamedSharding(mesh, PartitionSpec(AXIS))
        return jax.lax.with_sharding_constraint(index, split)

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        return train_step.step(config, state, spread)

    placed = shardings(mesh, jax.eval_shape(lambda: train_step.init(config, 0)))
    everywhere: Any = NamedSharding(mesh, PartitionSpec())
    init = jax.jit(lambda seed: train_step.init(config, seed), out_shardings=placed)
    jitted = jax.jit(
        step, donate_argnums=0, in_shardings=(placed,), out_shardings=(placed, everywhere)
    )
    return lambda: init(config.seed), jitted
