"""Brax 0.14 on JAX 0.10 and later, which lacks a function that Brax's `ppo.train` calls."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "i"
"""Name of the axis of devices in Brax's programs."""


def prepare() -> None:
    """Gives JAX the missing function."""
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", replicated)  # noqa: B010 (a type checker knows none)


def replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """The arrays of a tree with a new leading axis: one copy for each device.

    They lie as the results of `jax.pmap` do. Else Brax's train step compiles a second time for its
    own results.
    """
    where = NamedSharding(Mesh(np.asarray(devices), (AXIS,)), PartitionSpec(AXIS))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), where), tree)
