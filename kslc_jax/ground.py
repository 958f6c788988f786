"""The ground of an episode: an analytic height function of the place.

The function is a sum of random waves, an inclined plane and stairs, of which an episode has one. It
repeats: `PERIOD` further it has the same shape, higher by a constant. The place where an episode
starts is flat and level. `height` also runs in numpy: `xp` is numpy or jax.numpy.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax.config import GROUNDS, TerrainConfig

PERIOD = 12.0
"""Distance [m] after which the shape of the ground repeats, along both axes of its own frame."""

START, ROUND = 0.6, 0.1
"""Radius [m] of the flat place where an episode starts, to the middle of its round edge, and half
the width [m] of this edge. So the ground is flat up to 0.5 m from the start."""

BLEND = 5.0
"""Distance [m] from the start beyond which the flat place has no effect, at most half a `PERIOD`.
The flat place shifts the shape outwards. From there to this distance the shape catches up, and
slopes are up to a fifth steeper."""

TREAD, RISER, EDGE = 0.4, 0.05, 0.01
"""Length of a stair [m], the part of it that rises [m], and half width of its round edges [m]. A
`PERIOD` has a whole number of stairs."""

RISER_AT = 0.175
"""Distance [m] of a riser's middle from the middle of its stair, so that risers begin and end at
whole multiples of `SPACING`."""

SPACING, HALF = 0.05, PERIOD
"""Distance of the points of a height field [m], and half its length [m].

The foot of XBot-L touches 25 of the field's facets. MuJoCo keeps at most 50 contacts of a pair:
with points 2.5 cm apart a foot loses some, and with 1.25 cm it tips over."""

# Whole waves per period, along both axes: wavelengths of 2.4 to 0.45 m in all directions.
_WAVES = np.array(
    [(4, 3), (-7, 4), (3, 11), (14, -5), (-6, -17), (20, 9), (-17, 19), (24, -12)], np.float32
)
_PHASES = np.array([0.0, 3.88, 1.48, 5.37, 2.97, 0.57, 4.45, 2.06], np.float32)  # golden angles


@flax.struct.dataclass
class Ground:
    """The ground of one episode. In an episode of training at most one of the first three is not
    0."""

    rough: jax.Array  # [] m, height of the largest wave
    slope: jax.Array  # [] rise per metre
    stairs: jax.Array  # [] m, height of a step
    yaw: jax.Array  # [] rad, direction in which slope and stairs rise


def sample(terrain: TerrainConfig, key: jax.Array, v_max: jax.Array | float) -> Ground:
    """Draws the ground of one episode.

    Args:
      terrain: kinds and sizes; it has at least one kind.
      key: random key.
      v_max: [] m/s, the curriculum's present one.
    """
    is_flat, kind, share, yaw = jax.random.uniform(key, (4,))
    kinds = jnp.array([GROUNDS.index(name) for name in terrain.kinds])
    chosen = kinds[(kind * len(kinds)).astype(int)]
    size = terrain.least + (1.0 - terrain.least) * share
    if terrain.full_from:
        size = size * jnp.clip(v_max / terrain.full_from, 0.0, 1.0)
    size = jnp.where(is_flat < terrain.flat, 0.0, size)
    most = largest(terrain)
    rough, rise, stairs = jnp.where(jnp.arange(len(GROUNDS)) == chosen, size, 0.0)
    return Ground(
        rough=rough * most.rough,
        slope=rise * most.slope,
        stairs=stairs * most.stairs,
        yaw=2.0 * jnp.pi * yaw,
    )


def largest(terrain: TerrainConfig) -> Ground:
    """The ground of the largest size, with yaw 0, in numpy. It has all kinds of the terrain."""
    rise = np.tan(np.radians(terrain.slope))
    values: Any = np.array([terrain.rough, rise, terrain.stairs, 0.0], np.float32)
    return Ground(*values)


def height(ground: Ground, x, y, xp: Any = jnp):
    """Height [..., m] of the ground at x and y [..., m, world]."""
    x, y = _to_own_frame(ground, x, y, xp)
    r = xp.sqrt(x * x + y * y + 1e-12)  # not 0: its gradient must be finite
    blend = xp.clip((r - START) / (BLEND - START), 0.0, 1.0)
    moved = _ramp(r - START, ROUND, xp) + START * blend * blend * (3.0 - 2.0 * blend)
    return _shape(ground, x * moved / r, y * moved / r, xp)


def slope(ground: Ground, x: jax.Array, y: jax.Array) -> jax.Array:
    """Gradient [2] of the height at one place [m, world]."""
    return jnp.stack(jax.grad(height, (1, 2))(ground, x, y))


def planes(ground: Ground, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Planes that touch the ground below or above points [k, 3, m].

    Returns:
      (a point of each plane [k, 3], the orientation [k, 4] that turns z into its normal).
    """

    def plane(point: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = point[0], point[1]
        z, (dx, dy) = jax.value_and_grad(height, (1, 2))(ground, x, y)
        up = 1.0 / jnp.sqrt(1.0 + dx * dx + dy * dy)  # the normal is (-dx, -dy, 1) times this
        quat = jnp.stack([1.0 + up, dy * up, -dx * up, jnp.zeros(())])
        return jnp.stack([x, y, z]), quat / jnp.sqrt(2.0 * (1.0 + up))

    return jax.vmap(plane)(points)


def _to_own_frame(ground: Ground, x, y, xp: Any):
    """x and y in the frame of the ground, which is turned by its yaw."""
    c, s = xp.cos(ground.yaw), xp.sin(ground.yaw)
    return c * x + s * y, c * y - s * x


def _ramp(x, soft: float, xp: Any):
    """max(x, 0), with a parabola in place of the corner where |x| < soft."""
    corner = xp.clip(x + soft, 0.0, 2.0 * soft)
    return corner * corner / (4.0 * soft) + xp.maximum(x - soft, 0.0)


def _shape(ground: Ground, x, y, xp: Any):
    """Height [..., m] in the frame of the ground, without the flat place; 0 at the origin."""
    steps = xp.floor((x + 0.25 * TREAD) / TREAD)
    on_stair = x - TREAD * steps - RISER_AT
    low, high = (_ramp(on_stair + side * 0.5 * RISER, EDGE, xp) for side in (1.0, -1.0))
    stairs = ground.stairs * (steps + (low - high) / RISER)
    return ground.rough * _SCALE * _waves(x, y, xp) + ground.slope * x + stairs


def _waves(x, y, xp: Any):
    """Sum of waves of amplitude 1, 0 at the origin."""
    turn = np.float32(2.0 * np.pi / PERIOD)
    total = 0.0
    for (along, across), phase in zip(turn * _WAVES, _PHASES, strict=True):
        total = total + xp.sin(along * x + across * y + phase) - np.sin(phase)
    return total


_PERIODS = np.meshgrid(*2 * [np.arange(0.0, PERIOD, SPACING)])
_SCALE = np.float32(1.0 / np.abs(_waves(*_PERIODS, np)).max())
"""Factor on the sum of the waves, so that its largest height or depth is 1."""


# ------------------------------------------------------------------------------- as a height field


def reach(ground: Ground):
    """Height [m] that no point of a height field's window exceeds, upwards or downwards."""
    return ground.rough + ground.slope * HALF + ground.stairs * (HALF / TREAD + 1.0) + 1e-3


def window(ground: Ground, far: bool) -> np.ndarray:
    """[k, k] heights of a square window of the ground around its origin; rows along y. Numpy.

    With `far` without the flat place: the window around any other corner of the pattern.
    """
    points = np.arange(-round(HALF / SPACING), round(HALF / SPACING) + 1) * SPACING
    x, y = np.meshgrid(points, points)
    ground = ground.replace(yaw=np.float32(0.0))
    return (_shape if far else height)(ground, x, y, np)


def place(ground: Ground, x, y, xp: Any = jnp):
    """The height field that a robot at x and y [m, world] stands on.

    Returns:
      (position [3, m, world] of the point in its middle with the height -`reach`, orientation [4],
      far []: see `window`).
    """
    along, across = (xp.round(x / PERIOD) for x in _to_own_frame(ground, x, y, xp))
    c, s = xp.cos(ground.yaw), xp.sin(ground.yaw)
    rise = along * (ground.slope * PERIOD + ground.stairs * PERIOD / TREAD)
    middle = xp.stack([c * along - s * across, s * along + c * across]) * PERIOD
    zero, half = xp.zeros_like(along), 0.5 * ground.yaw
    quat = xp.stack([xp.cos(half), zero, zero, xp.sin(half)])
    return xp.append(middle, rise - reach(ground)), quat, (along != 0) | (across != 0)


def level(ground: Ground, x: float, y: float) -> float:
    """Mean height [m] of a square of one tread around x and y: a camera follows it. Numpy."""
    around = TREAD * np.linspace(-0.5, 0.5, 21)
    return float(height(ground, *np.meshgrid(x + around, y + around), np).mean())
