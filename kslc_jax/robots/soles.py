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


def find(points: np.ndarray, ankle: str, pitch: float) -> Sole:
    """The sole of a foot.

    Args:
      points: [k, 3] on the surface of the foot's shapes, world at home [m].
      ankle: name of the joint that pitches the foot.
      pitch: sign of that joint's axis.

    Raises:
      RobotError: the foot has no shapes, or its sole is not level.
    """
    if not len(points):
        raise RobotError(f"the foot below joint {ankle!r} has no shapes: add a geom as its sole")
    lowest = points[:, 2].min()
    low = points[points[:, 2] < lowest + THICKNESS]
    forward = _direction(low[:, :2])
    rotation = np.array([[forward[0], -forward[1], 0], [forward[1], forward[0], 0], [0, 0, 1]])
    along = low @ rotation
    lower, upper = along.min(axis=0), along.max(axis=0)
    ground = along[along[:, 2] < lowest + LEVEL]
    level = np.ptp(ground, axis=0)[:2] >= LEVEL_SHARE * (upper - lower)[:2]
    if not level.all():
        angle = pitch * _slope((points @ rotation)[:, [0, 2]])
        raise RobotError(
            f"the foot below joint {ankle!r} is not level at home: less than half of its sole is "
            f"within {1000 * LEVEL:g} mm of the ground; add {angle:+.3f} rad to that joint in "
            "[home]" + ("" if level[1] else ", or turn the foot's roll joint")
        )
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


def _slope(points: np.ndarray) -> float:
    """Angle [rad] by which the toe is up: that of the longest edge below points [k, 2] (x, z)."""
    hull: list[np.ndarray] = []
    for point in points[np.lexsort(points.T[::-1])]:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    edges = np.diff(hull, axis=0)
    x, z = edges[np.linalg.norm(edges, axis=1).argmax()]
    return float(np.arctan2(z, x))


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Above 0 if the way from a over b to c turns left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
