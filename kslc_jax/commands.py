"""Commanded velocity and heading of one environment."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import maths
from kslc_jax.config import CommandConfig

TURNING = 0.1
"""Commanded yaw rate [rad/s] below which a robot with zero velocity command may stand still."""


@flax.struct.dataclass
class Command:
    """What the robot is asked to do."""

    velocity: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s], base frame
    heading: jax.Array  # [] rad, world
    moving: jax.Array  # [] bool: False asks to stand still (clock stopped, both feet down)


def sample(
    config: CommandConfig,
    key: jax.Array,
    vx_range: tuple[jax.Array, jax.Array],
    yaw: jax.Array,
    top_width: float,
) -> Command:
    """Draws a command for a robot that now heads to `yaw` [rad].

    vx is uniform in `vx_range` [m/s]; for the `slow_fraction` in its part up to `slow_speed`, for
    the `top_fraction` in its uppermost `top_width`. Fast commands come with small side steps and
    turns: with `narrow_speed` both shrink linearly.
    """
    keys = jax.random.split(key, 5)
    low, high = vx_range
    if config.slow_fraction + config.top_fraction > 0:
        part = jax.random.uniform(keys[4])
        slow = part < config.slow_fraction
        top = (part >= config.slow_fraction) & (part < config.slow_fraction + config.top_fraction)
        low = jnp.where(top, jnp.maximum(high - top_width, low), low)
        high = jnp.where(slow, jnp.clip(config.slow_speed, *vx_range), high)
    vx = jax.random.uniform(keys[0], minval=low, maxval=high)
    vy = jax.random.uniform(keys[1], minval=config.vy[0], maxval=config.vy[1])
    heading = jax.random.uniform(keys[2], minval=config.heading[0], maxval=config.heading[1])
    if config.narrow_speed > 0:
        share = jnp.clip(1.0 - jnp.abs(vx) / config.narrow_speed, 0.0, 1.0)
        vy = vy * share
        heading = yaw + share * maths.wrap_angle(heading - yaw)

    kind = jax.random.uniform(keys[3])
    stand = kind < config.stand_fraction
    forward = kind < config.stand_fraction + config.forward_fraction
    vx = jnp.where(stand, 0.0, vx)
    vy = jnp.where(forward, 0.0, vy)
    heading = jnp.where(forward, yaw, heading)
    velocity = jnp.stack([vx, vy, jnp.zeros(())])
    return steer(config, Command(velocity, heading, jnp.zeros((), bool)), yaw)


def holding_steps(config: CommandConfig, key: jax.Array, control_dt: float) -> jax.Array:
    """Control steps [] that a new command holds for."""
    longest = round(config.resample_seconds / control_dt)
    if config.shortest_seconds == 0:
        return jnp.asarray(longest)
    shortest = round(config.shortest_seconds / control_dt)
    return jax.random.randint(key, (), shortest, longest + 1)


def steer(config: CommandConfig, command: Command, yaw: jax.Array) -> Command:
    """Recomputes the commanded yaw rate from the heading error, every step (HG)."""
    error = maths.wrap_angle(command.heading - yaw)
    rate = jnp.clip(config.heading_gain * error, -config.max_yaw_rate, config.max_yaw_rate)
    return with_velocity(config, command, command.velocity.at[2].set(rate))


def with_velocity(config: CommandConfig, command: Command, velocity: jax.Array) -> Command:
    """The command with `velocity` [3], vx and vy zero within the dead zone; decides whether that
    means standing still."""
    walks = jnp.hypot(velocity[0], velocity[1]) > config.dead_zone
    velocity = velocity * jnp.stack([walks, walks, jnp.ones((), bool)])
    if not config.stand_still:
        return command.replace(velocity=velocity, moving=jnp.ones((), bool))
    moving = walks | (jnp.abs(velocity[2]) > TURNING)
    return command.replace(velocity=jnp.where(moving, velocity, 0.0), moving=moving)


def speed_share(command: Command, v_max: jax.Array) -> jax.Array:
    """The paper's g = v_cmd / v_max (Eq. 6), of the forward speed, in [0, 1]."""
    return jnp.clip(jnp.abs(command.velocity[0]) / v_max, 0.0, 1.0)
