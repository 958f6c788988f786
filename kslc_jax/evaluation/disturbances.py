"""Disturbances of one robot in a trial: punches at links, and arms that move at random."""

import jax
import jax.numpy as jnp

from kslc_jax.robot import Robot

PUNCH_EVERY, PUNCH_SECONDS = 4.0, 0.08
"""Time between the starts of two punches, and duration of a punch [s]."""

ARM_RATE = 0.3
"""Largest speed of the targets of held arms [rad/s]."""

ARM_SECONDS = 1.0
"""Time [s] after which the arms' targets get new random speeds."""


def punch(robot: Robot, newtons: float, key: jax.Array, steps: jax.Array, dt: float) -> jax.Array:
    """Force [N] and torque [N m] on every body [nbody, 6], world frame, at its centre of mass.

    The first punch begins after `PUNCH_EVERY` seconds, the next ones at the same interval. During a
    punch a force acts at a random link in a random direction.

    Args:
      robot: the robot that is hit.
      newtons: size of the force [N].
      key: random key of this robot, the same in every step.
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
    """Moves the joint targets [n, rad] on by one control step, within the joints' limits.

    Each target moves at a random speed up to `ARM_RATE`. Every `ARM_SECONDS` it gets a new one.
    """
    interval = jax.random.fold_in(key, steps // round(ARM_SECONDS / dt))
    rate = jax.random.uniform(interval, targets.shape, minval=-ARM_RATE, maxval=ARM_RATE)
    return jnp.clip(targets + rate * dt, robot.joint_lower, robot.joint_upper)
