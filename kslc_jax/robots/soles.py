"""Soles of the feet: the flat rectangle under each foot, from its shapes at the home pose."""

from dataclasses import dataclass

import numpy as np

from kslc_jax.robots.description import RobotError

THICKNESS = 0.012
"""Height [m] above a foot's lowest point up to which its shapes count as the sole."""

LEVEL = 0.003
"""Height [m] up to which a point of the sole touches level ground."""

LEVEL_SHARE = 0.5
"""Least share of the sole's length and of its width that must touch level ground."""

EVEN = 0.001
"""Height [m] up to which a point of a levelled sole touches the ground. Less than a third of the
length of a ball, and nearly all of a flat sole, is that low; at `LEVEL` they differ little."""

ROUND = 1.2
"""Length over width below which the sole points along the base."""


@dataclass(frozen=True, eq=False)
class Sole:
    """A rectangle on the ground, in the world at home."""

    centre: np.ndarray  # [3] m
    rotation: np.ndarray  # [3, 3] columns: along the foot, to its left, up
    half_length: float  # m
    half_width: float  # m

    def corners(self, inset: float, height: float) -> dict[str, np.ndarray]:
        """Points [3] at the corners, `inset` inside the edges and `height` above the sole [m]."""
        x, y = self.half_length - inset, self.half_width - inset
        places = {"toe_l": (x, y), "toe_r": (x, -y), "heel_l": (-x, y), "heel_r": (-x, -y)}
        return {
            name: self.centre + self.rotation @ [*place, height] for name, place in places.items()
        }


def find(points: np.ndarray, ankle: str, pitch: float, straightened: float = 0.0) -> Sole:
    """The sole of a foot.

    Args:
      points: [k, 3] on the surface of the foot's shapes, world at home [m].
      ankle: name of the joint that pitches the foot.
      pitch: sign of that joint's axis.
      straightened: angle [rad] by which the base is tilted in the MJCF's keyframe, and not here.

    Raises:
      RobotError: the foot has no shapes, or its sole is round or not level.
    """
    if not len(points):
        raise RobotError(f"the foot below joint {ankle!r} has no shapes: add a geom as its sole")
    lowest = points[:, 2].min()
    low = points[points[:, 2] < lowest + THICKNESS]
    forward = _direction(low[:, :2])
    rotation = np.array([[forward[0], -forward[1], 0], [forward[1], forward[0], 0], [0, 0, 1]])
    along = points @ rotation
    if not _touches(_levelled(along), EVEN).all():
        raise RobotError(
            f"the foot below joint {ankle!r} is round: turned in any way, it touches the ground "
            "with a small part of its sole only; add a box as its sole to the MJCF"
        )
    level = _touches(along, LEVEL)
    if not level.all():
        angle = pitch * _slope(along[:, [0, 2]])
        tilt = f" (the keyframe's base is tilted by {straightened:.2f} rad; here it is upright)"
        raise RobotError(
            f"the foot below joint {ankle!r} is not level at home: less than half of its sole is "
            f"within {1000 * LEVEL:g} mm of the ground; add {angle:+.3f} rad to that joint in "
            "[home]"
            + ("" if level[1] else ", or turn the foot's roll joint")
            + (tilt if straightened else "")
        )
    lower, upper = (low @ rotation).min(axis=0), (low @ rotation).max(axis=0)
    centre = rotation @ [*(lower + upper)[:2] / 2, lowest]
    half = (upper - lower) / 2
    return Sole(centre, rotation, float(half[0]), float(half[1]))


def _direction(points: np.ndarray) -> np.ndarray:
    """Unit vector [2] along points [k, 2] on the ground, forward."""
    axes = np.linalg.eigh(np.cov(points.T))[1].T
    spans = np.ptp(points @ axes.T, axis=0)
    if spans.max() < ROUND * spans.min():
        return np.array([1.0, 0.0])
    along = axes[np.abs(axes[:, 0]).argmax()]  # the one that points more forward than sideways
    return along * np.sign(along[0])


def _touches(along: np.ndarray, height: float) -> np.ndarray:
    """[2] bool, along and across: enough of the sole is lower than `height` [m].

    Args:
      along: [k, 3] points of the foot, in the frame of its sole [m].
    """
    above = along - along.min(axis=0)
    sole, ground = (above[above[:, 2] < most, :2] for most in (THICKNESS, height))
    return np.ptp(ground, axis=0) >= LEVEL_SHARE * np.ptp(sole, axis=0)


def _levelled(along: np.ndarray) -> np.ndarray:
    """Points [k, 3] of a foot, turned about y and then about x so that its sole is level."""
    turned = along.copy()
    for axis in (0, 1):
        angle = _slope(turned[:, [axis, 2]])
        cos, sin = np.cos(angle), np.sin(angle)
        turned[:, [axis, 2]] = turned[:, [axis, 2]] @ np.array([[cos, -sin], [sin, cos]])
    return turned


def _slope(points: np.ndarray) -> float:
    """Angle [rad] by which the toe is up: that of the widest edge below points [k, 2] (x, z)."""
    hull: list[np.ndarray] = []
    for point in points[np.lexsort(points.T[::-1])]:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    edges = np.diff(hull, axis=0)
    x, z = edges[edges[:, 0].argmax()]
    return float(np.arctan2(z, x))


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Above 0 if the way from a over b to c turns left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
