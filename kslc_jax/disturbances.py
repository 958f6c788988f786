"""Disturbances of one episode: punches at links, and arms that follow random targets."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import draws
from kslc_jax.config import RandomizeConfig
from kslc_jax.robot import Robot

PUNCH_EVERY, PUNCH_SECONDS = 4.0, 0.08
"""Time between the starts of two punches, and duration of a punch [s]."""

ARM_RATE = 0.3
"""Largest speed of the targets of held arms [rad/s]."""

ARM_SECONDS = 1.0
"""Time [s] after which the arms' targets get new random speeds."""


@flax.struct.dataclass
class Disturbances:
    """State of the disturbances of one episode."""

    seed: jax.Array  # [] uint32, all punches and arm motions of the episode follow from it
    arms_held: jax.Array  # [] bool, True: the arms follow `arms` in place of the actions
    arms: jax.Array  # [n] rad, joint targets of held arms


def start(config: RandomizeConfig, key: jax.Array, joints: jax.Array) -> Disturbances | None:
    """Draws the disturbances of an episode that begins with the joint angles `joints` [n, rad].

    Returns None if the config has none.
    """
    if config.punch[1] == 0.0 and config.held_arms == 0.0:
        return None
    key_seed, key_held = jax.random.split(key)
    return Disturbances(
        seed=jax.random.bits(key_seed, (), jnp.uint32),
        arms_held=jax.random.uniform(key_held) < config.held_arms,
        arms=joints,
    )


def apply(
    config: RandomizeConfig,
    robot: Robot,
    state: Disturbances | None,
    steps: jax.Array,
    target: jax.Array,
    dt: float,
) -> tuple[Disturbances | None, jax.Array, jax.Array | None]:
    """Disturbs one control step.

    Args:
      config: sizes of the disturbances.
      robot: the robot that is disturbed.
      state: before the step; None: no disturbances.
      steps: [] int, control steps since the start of the episode.
      target: [n] joint targets of the policy [rad].
      dt: control step [s].

    Returns:
      (the new state, the joint targets [n], the force on every body, see `punch`).
    """
    if state is None:
        return None, target, None
    arms = walk_arms(robot, state.arms, state.seed, steps, dt)
    target = jnp.where(robot.is_arm & state.arms_held, arms, target)
    return state.replace(arms=arms), target, punch(config, robot, state.seed, steps, dt)


def punch(
    config: RandomizeConfig, robot: Robot, seed: jax.Array, steps: jax.Array, dt: float
) -> jax.Array:
    """Force [N] and torque [N m] on every body [nbody, 6], world frame, at its centre of mass.

    The first punch begins after half of `PUNCH_EVERY`, the next ones at that interval. So they do
    not meet the pushes of the same interval. During a punch a force acts at a random link in a
    random direction. Its size is uniform in `config.punch`.
    """
    every = round(PUNCH_EVERY / dt)
    since = steps - every // 2
    key = jax.random.fold_in(jax.random.key(seed), since // every)
    link, size, up, turn = jax.random.uniform(key, (4,))
    body = draws.integer_between(link, 1, robot.mj_model.nbody - 1)  # 0 is the world
    up, turn = draws.between(up, -1.0, 1.0), draws.between(turn, 0.0, 2.0 * jnp.pi)
    across = jnp.sqrt(1.0 - up * up)
    way = jnp.stack([across * jnp.cos(turn), across * jnp.sin(turn), up])
    hits = (since >= 0) & (since % every < round(PUNCH_SECONDS / dt))
    force = jnp.where(hits, draws.between(size, *config.punch), 0.0) * way
    return jnp.zeros((robot.mj_model.nbody, 6)).at[body, :3].set(force)


def walk_arms(
    robot: Robot, targets: jax.Array, seed: jax.Array, steps: jax.Array, dt: float
) -> jax.Array:
    """Moves the joint targets [n, rad] on by one control step, within the joints' limits.

    Each target moves at a random speed up to `ARM_RATE`. Every `ARM_SECONDS` it gets a new one.
    """
    interval = jax.random.fold_in(jax.random.key(seed), -1 - steps // round(ARM_SECONDS / dt))
    rate = jax.random.uniform(interval, targets.shape, minval=-ARM_RATE, maxval=ARM_RATE)
    return jnp.clip(targets + rate * dt, robot.joint_lower, robot.joint_upper)
