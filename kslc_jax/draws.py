"""Several random numbers from one draw.

XLA compiles each call of `jax.random` as a program of its own. A control step with one call for
each parameter of a robot would take most of its compile time for random numbers.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np


def uniforms(key: jax.Array, *shapes: tuple[int, ...]) -> list[jax.Array]:
    """Independent uniform numbers in [0, 1), one array of each shape."""
    sizes = [math.prod(shape) for shape in shapes]
    parts = jnp.split(jax.random.uniform(key, (sum(sizes),)), np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def between(unit: jax.Array, low: jax.Array | float, high: jax.Array | float) -> jax.Array:
    """Maps uniform numbers in [0, 1) to [low, high)."""
    return low + unit * (high - low)


def integer_between(unit: jax.Array, low: int, high: int) -> jax.Array:
    """Maps uniform numbers in [0, 1) to the integers from low to high, both included."""
    return low + jnp.floor(unit * (high + 1 - low)).astype(jnp.int32)
