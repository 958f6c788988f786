"""Disturbances of a trial: punches at links, and arms that somebody else moves. One robot each."""

import jax
import jax.numpy as jnp

from kslc_jax.robot import Robot

PUNCH_EVERY, PUNCH_SECONDS = 4.0, 0.08
"""Time between the starts of two punches, and duration of one [s]."""

ARM_RATE = 0.3
"""Fastest motion of the targets of held arms [rad/s]."""

ARM_SECONDS = 1.0
"""Time after which the arms' targets move on at other speeds."""


def punch(robot: Robot, newtons: float, key: jax.Array, steps: jax.Array, dt: float) -> jax.Array:
    """Force and torque on every body [nbody, 6], world frame, at its centre of mass.

    From `PUNCH_EVERY` seconds on, a force of `newtons` acts at a random link in a random direction
    for the first `PUNCH_SECONDS` of each interval.

    Args:
      robot: its links.
      newtons: size of the force.
      key: the robot's own, the same in every step.
      steps: [] int, control steps since the start.
      dt: control step [s].
    """
    every = round(PUNCH_EVERY / dt)
    key_link, key_way = jax.random.split(jax.random.fold_in(key, steps // every))
    link = jax.random.randint(key_link, (), 1, robot.mj_model.nbody)  # 0 is the world
    way = jax.random.normal(key_way, (3,))
    hits = (steps >= every) & (steps % every < round(PUNCH_SECONDS / dt))
    force = jnp.where(hits, newtons, 0.0) * way / jnp.linalg.norm(way)
    return jnp.zeros((robot.mj_model.nbody, 6)).at[link, :3].set(force)


def walk_arms(
    robot: Robot, targets: jax.Array, key: jax.Array, steps: jax.Array, dt: float
) -> jax.Array:
    """Joint targets [n, rad] one control step later: each moves at a random speed up to
    `ARM_RATE`, drawn anew every `ARM_SECONDS`, within the joint's limits."""
    interval = jax.random.fold_in(key, steps // round(ARM_SECONDS / dt))
    rate = jax.random.uniform(interval, targets.shape, minval=-ARM_RATE, maxval=ARM_RATE)
    return jnp.clip(targets + rate * dt, robot.joint_lower, robot.joint_upper)
