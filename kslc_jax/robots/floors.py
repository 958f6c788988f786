"""Uneven ground in a model: a plane below each sole sphere, or a height field. No jax."""

from collections.abc import Sequence

import mujoco
import numpy as np

FLOOR = "floor"
"""Name of the floor's geom."""

THICKNESS = 1.0
"""Depth of a height field below its lowest point [m]."""

FIRST_BIT = 2
"""Collision bit of the first sole sphere and its plane; lower ones are for floor and parts."""


def own_planes(spec: mujoco.MjSpec) -> None:
    """Turns a training model in place: every sole sphere touches a plane of its own, and no other.

    The planes are called "below_0", "below_1", ... in the order of the spheres. Sensors
    "sole_pos_0", ... and "sole_vel_0", ... read position and velocity of the spheres.
    """
    spec.geom(FLOOR).conaffinity = 0
    spheres = [geom for geom in spec.geoms if geom.priority > 0]
    kinds = mujoco.mjtSensor
    for kind, name in ((kinds.mjSENS_FRAMEPOS, "pos"), (kinds.mjSENS_FRAMELINVEL, "vel")):
        for i, sphere in enumerate(spheres):
            spec.add_sensor(
                name=f"sole_{name}_{i}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=sphere.name,
            )
    for i, sphere in enumerate(spheres):
        sphere.contype = 1 << (FIRST_BIT + i)
        spec.worldbody.add_geom(
            name=f"below_{i}",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            condim=spec.geom(FLOOR).condim,
            contype=0,
            conaffinity=sphere.contype,
            group=5,
        )
    _let_the_ground_move(spec)


def height_fields(spec: mujoco.MjSpec, windows: int, points: int, half: float, reach: float):
    """Turns a high-fidelity model in place: a height field replaces the floor's plane.

    Args:
      spec: the model.
      windows: number of height fields. The floor's `geom_dataid` chooses one of them.
      points: rows and columns of a field; `fill` writes them.
      half: half the length of a field [m].
      reach: largest height, upwards or downwards [m]. The floor's position is that of a point with
        the height -reach.
    """
    for i in range(windows):
        size = [half, half, 2 * reach, THICKNESS]
        level = np.zeros(points * points)
        spec.add_hfield(name=f"{FLOOR}_{i}", nrow=points, ncol=points, size=size, userdata=level)
    floor = spec.geom(FLOOR)
    floor.type, floor.hfieldname = mujoco.mjtGeom.mjGEOM_HFIELD, f"{FLOOR}_0"
    _let_the_ground_move(spec)


def fill(model: mujoco.MjModel, heights: Sequence[np.ndarray]) -> None:
    """Writes heights [k, k, m] to the height fields of a compiled model."""
    for i, field in enumerate(heights):
        reach = 0.5 * model.hfield_size[i, 2]
        share = (field + reach) / (2 * reach)  # MuJoCo stores shares of the size
        first = model.hfield_adr[i]
        model.hfield_data[first : first + field.size] = share.ravel()
    model.geom(FLOOR).castshadow = 0  # the field is coarser than the map of its shadow


def _let_the_ground_move(spec: mujoco.MjSpec) -> None:
    """Switches off the tree of bounding boxes. It is right only for geoms that never move."""
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
