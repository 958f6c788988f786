"""Commanded velocity and heading of one environment."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import draws, maths
from kslc_jax.config import CommandConfig

BRAKES_FROM = 0.5
"""Share of the largest vx above which a command may be followed by one that brakes."""

TURNING = 0.1
"""Commanded yaw rate [rad/s] above which a robot with a zero velocity command must step."""


@flax.struct.dataclass
class Command:
    """Commanded velocity and heading of one robot."""

    velocity: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s], base frame
    heading: jax.Array  # [] rad, world
    moving: jax.Array  # [] bool, False: stand still (clock off, both feet down)


def sample(
    config: CommandConfig,
    key: jax.Array,
    vx_range: tuple[jax.Array, jax.Array],
    yaw: jax.Array,
    top_width: float,
    before: jax.Array | float = 0.0,
) -> Command:
    """Draws a command for a robot with the heading `yaw` [rad].

    `before` [m/s] is the vx of the command that ends now. The new vx is uniform in `vx_range`
    [m/s]. A share `slow_fraction` of the commands uses only the part up to `slow_speed`, and a
    share `top_fraction` only the uppermost `top_width` [m/s]. With `narrow_speed`, vy and the
    change of heading shrink linearly with |vx|. A share `stand_fraction` has zero velocity and
    keeps its heading. A share `forward_fraction` goes straight ahead. After fast commands a share
    `brake_fraction` stops or reverses.
    """
    part, speed, sideways, turn, kind = jax.random.uniform(key, (5,))
    low, high = vx_range
    if config.slow_fraction + config.top_fraction > 0:
        slow = part < config.slow_fraction
        top = (part >= config.slow_fraction) & (part < config.slow_fraction + config.top_fraction)
        low = jnp.where(top, jnp.maximum(high - top_width, low), low)
        high = jnp.where(slow, jnp.clip(config.slow_speed, *vx_range), high)
    vx = draws.between(speed, low, high)
    vy = draws.between(sideways, *config.vy)
    heading = draws.between(turn, *config.heading)
    if config.narrow_speed > 0:
        share = jnp.clip(1.0 - jnp.abs(vx) / config.narrow_speed, 0.0, 1.0)
        vy = vy * share
        heading = yaw + share * maths.wrap_angle(heading - yaw)

    stand = kind < config.stand_fraction
    forward = kind < config.stand_fraction + config.forward_fraction
    if config.brake_fraction > 0:
        draw = jax.random.uniform(jax.random.fold_in(key, 1))
        brakes = (before > BRAKES_FROM * vx_range[1]) & (draw < config.brake_fraction)
        reverses = brakes & (draw < 0.5 * config.brake_fraction)
        vx = jnp.where(reverses, vx_range[0], vx)
        stand, forward = jnp.where(brakes, ~reverses, stand), forward | brakes
    vx = jnp.where(stand, 0.0, vx)
    vy = jnp.where(forward, 0.0, vy)
    heading = jnp.where(forward, yaw, heading)
    velocity = jnp.stack([vx, vy, jnp.zeros(())])
    return steer(config, Command(velocity, heading, jnp.zeros((), bool)), yaw)


def holding_steps(config: CommandConfig, key: jax.Array, control_dt: float) -> jax.Array:
    """Number of control steps [] for which a new command holds."""
    longest = round(config.resample_seconds / control_dt)
    if config.shortest_seconds == 0:
        return jnp.asarray(longest)
    shortest = round(config.shortest_seconds / control_dt)
    return draws.integer_between(jax.random.uniform(key), shortest, longest)


def steer(config: CommandConfig, command: Command, yaw: jax.Array) -> Command:
    """Recomputes the commanded yaw rate from the heading error; called at every step (HG)."""
    error = maths.wrap_angle(command.heading - yaw)
    rate = jnp.clip(config.heading_gain * error, -config.max_yaw_rate, config.max_yaw_rate)
    return with_velocity(config, command, command.velocity.at[2].set(rate))


def with_velocity(config: CommandConfig, command: Command, velocity: jax.Array) -> Command:
    """Returns the command with `velocity` [3] in place of its own.

    vx and vy become zero in the dead zone. With `config.stand_still`, such a command means "stand"
    (`moving` is False) unless it turns faster than `TURNING`.
    """
    walks = maths.norm(velocity[:2]) > config.dead_zone
    velocity = velocity * jnp.stack([walks, walks, jnp.ones((), bool)])
    if not config.stand_still:
        return command.replace(velocity=velocity, moving=jnp.ones((), bool))
    moving = walks | (jnp.abs(velocity[2]) > TURNING)
    return command.replace(velocity=jnp.where(moving, velocity, 0.0), moving=moving)


def speed_share(command: Command, v_max: jax.Array) -> jax.Array:
    """g = |vx| / v_max in [0, 1], for the commanded vx (paper, Eq. 6)."""
    return jnp.clip(jnp.abs(command.velocity[0]) / v_max, 0.0, 1.0)
