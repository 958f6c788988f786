"""Quaternions, frames and norms. Each function takes one vector; the caller vmaps.

Quaternions are (w, x, y, z) and have unit length. They rotate vectors from the body frame to the
world frame.
"""

import jax
import jax.numpy as jnp


def quat_rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates `v` [3] by `q` [4]: body frame to world frame."""
    w, u = q[0], q[1:]
    t = 2.0 * jnp.cross(u, v)
    return v + w * t + jnp.cross(u, t)


def quat_rotate_inverse(q: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates `v` [3] by the inverse of `q` [4]: world frame to body frame."""
    return quat_rotate(q * jnp.array([1.0, -1.0, -1.0, -1.0]), v)


def quat_multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """The rotation b, then a. All are quaternions [4], w first."""
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], vector])


def quat_to_euler(q: jax.Array) -> jax.Array:
    """Roll, pitch, yaw [3, rad] of `q` [4], about the fixed axes x, y, z.

    Roll and yaw lie in [-pi, pi], pitch in [-pi/2, pi/2].
    """
    w, x, y, z = q
    roll = jnp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw])


def wrap_angle(angle: jax.Array) -> jax.Array:
    """Maps an angle [rad] to [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def norm(x: jax.Array) -> jax.Array:
    """Euclidean norm over the last axis."""
    return jnp.sqrt(jnp.sum(jnp.square(x), axis=-1))


def tree_where(condition: jax.Array, if_true, if_false):
    """Returns the pytree `if_true` where the scalar `condition` [] holds, else `if_false`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
