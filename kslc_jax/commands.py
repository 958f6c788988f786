"""Commanded velocity and heading of one environment."""

import math

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
    wanted: jax.Array  # [2] m/s, vx, vy that the velocity approaches, see with_velocity
    turns: jax.Array  # [] bool, True: it may turn on the spot, see steer


def standing(heading: jax.Array) -> Command:
    """The command of a robot that stands, with the heading [rad]."""
    never = jnp.zeros((), bool)
    return Command(jnp.zeros(3), heading, moving=never, wanted=jnp.zeros(2), turns=never)


def sample(
    config: CommandConfig,
    key: jax.Array,
    vx_range: tuple[jax.Array, jax.Array],
    yaw: jax.Array,
    top_width: float,
    before: Command | None = None,
) -> Command:
    """Draws a command for a robot with the heading `yaw` [rad].

    `before` is the command that ends now; None: the robot stands. The new vx is uniform in
    `vx_range` [m/s]. A share `slow_fraction` of the commands uses only the part up to `slow_speed`,
    and a share `top_fraction` only the uppermost `top_width` [m/s]. With `narrow_speed`, vy and the
    change of heading shrink linearly with |vx|. A share `stand_fraction` has zero velocity and
    keeps its heading. A share `forward_fraction` goes straight ahead. After commands of the upper
    half of the range, a share `brake_fraction` stops or reverses.
    """
    before = standing(yaw) if before is None else before
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
        share = width(config, vx)
        vy = vy * share
        heading = yaw + share * maths.wrap_angle(heading - yaw)

    stand = kind < config.stand_fraction
    forward = kind < config.stand_fraction + config.forward_fraction
    if config.brake_fraction > 0:
        draw = jax.random.uniform(jax.random.fold_in(key, 1))
        brakes = (before.velocity[0] > BRAKES_FROM * vx_range[1]) & (draw < config.brake_fraction)
        reverses = brakes & (draw < 0.5 * config.brake_fraction)
        vx = jnp.where(reverses, vx_range[0], vx)
        stand, forward = jnp.where(brakes, ~reverses, stand), forward | brakes
    vx = jnp.where(stand, 0.0, vx)
    vy = jnp.where(forward, 0.0, vy)
    heading = jnp.where(forward, yaw, heading)
    wanted = with_velocity(config, before, jnp.stack([vx, vy, jnp.zeros(())]))
    return steer(config, wanted.replace(heading=heading), yaw, 0.0)


def width(config: CommandConfig, vx: jax.Array | float) -> jax.Array:
    """Share [] of the ranges of vy and of heading changes that commands with vx [m/s] may use."""
    if config.narrow_speed == 0:
        return jnp.ones(())
    return jnp.clip(1.0 - jnp.abs(vx) / config.narrow_speed, 0.0, 1.0)


def widest(config: CommandConfig, vx: float) -> tuple[float, float, float]:
    """Least and largest vy [m/s], and largest yaw rate [rad/s], that `sample` asks for with vx."""
    share = float(width(config, vx))
    rate = min(config.max_yaw_rate, config.heading_gain * share * math.pi)
    return share * config.vy[0], share * config.vy[1], rate


def holding_steps(config: CommandConfig, key: jax.Array, control_dt: float) -> jax.Array:
    """Number of control steps [] for which a new command holds."""
    longest = round(config.resample_seconds / control_dt)
    if config.shortest_seconds == 0:
        return jnp.asarray(longest)
    shortest = round(config.shortest_seconds / control_dt)
    return draws.integer_between(jax.random.uniform(key), shortest, longest)


def steer(config: CommandConfig, command: Command, yaw: jax.Array, dt: float) -> Command:
    """The command `dt` seconds later; called at every step.

    vx and vy approach the wanted ones. The yaw rate follows from the heading error (HG).

    A turn on the spot ends when the yaw rate falls to `TURNING`. It does not begin again. Otherwise
    a robot that should stand could turn away on purpose, to be rewarded for steps instead.
    """
    error = maths.wrap_angle(command.heading - yaw)
    rate = jnp.clip(config.heading_gain * error, -config.max_yaw_rate, config.max_yaw_rate)
    turns = command.turns & (jnp.abs(rate) > TURNING)
    return _approach(config, command.replace(turns=turns), rate, dt)


def with_velocity(config: CommandConfig, command: Command, velocity: jax.Array) -> Command:
    """The command with the velocity [3] in place of its own; in the dead zone, vx and vy are zero.

    With `config.acceleration` only the yaw rate changes at once. vx and vy are then the wanted
    ones, and `steer` approaches them. The new command may turn on the spot.
    """
    walks = maths.norm(velocity[:2]) > config.dead_zone
    fresh = command.replace(wanted=velocity[:2] * walks, turns=jnp.ones((), bool))
    return _approach(config, fresh, velocity[2], 0.0)


def _approach(config: CommandConfig, command: Command, rate: jax.Array, dt: float) -> Command:
    """Moves vx and vy towards the wanted ones for `dt` seconds, and sets the yaw rate [rad/s].

    With `config.stand_still`, a command of zero means "stand" (`moving` is False), unless it
    `turns` faster than `TURNING`.
    """
    wanted = planar = command.wanted
    if config.acceleration > 0:
        way = wanted - command.velocity[:2]
        share = config.acceleration * dt / jnp.maximum(maths.norm(way), 1e-6)
        planar = command.velocity[:2] + way * jnp.minimum(share, 1.0)
    velocity = jnp.append(planar, rate)
    if not config.stand_still:
        return command.replace(velocity=velocity, moving=jnp.ones((), bool))
    turning = command.turns & (jnp.abs(rate) > TURNING)
    moving = jnp.any(wanted != 0.0) | jnp.any(planar != 0.0) | turning
    return command.replace(velocity=jnp.where(moving, velocity, 0.0), moving=moving)


def speed_share(command: Command, v_max: jax.Array) -> jax.Array:
    """g = |vx| / v_max in [0, 1], for the commanded vx (paper, Eq. 6)."""
    return jnp.clip(jnp.abs(command.velocity[0]) / v_max, 0.0, 1.0)
