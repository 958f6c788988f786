"""Pictures of recorded motion, rendered off screen: gait strips and frames of videos.

Call `runtime.prepare()` before you import anything that imports mujoco: it chooses the GL library.
"""

import copy
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import jax
import mujoco
import numpy as np

from kslc_jax import ground as ground_lib
from kslc_jax import robot as robot_lib
from kslc_jax.config import TerrainConfig
from kslc_jax.errors import MissingPackage
from kslc_jax.ground import Ground
from kslc_jax.robot import Robot
from kslc_jax.robots import shapes
from kslc_jax.runtime import first_line

if TYPE_CHECKING:
    from kslc_jax.policy import Policy

LONG_LENS = 10.0
"""Vertical field of view of gait strips [degrees]."""

EYE_LEVEL = 0.8
"""Height [m] of the point that the camera looks at, for XBot-L."""

TALL = 2.0
"""Least height [m] that a gait strip shows, for XBot-L."""


class RenderError(MissingPackage):
    """This machine cannot draw off screen. The message says what to install or to set."""


def _renderer(model: mujoco.MjModel, height: int, width: int, **more: int) -> mujoco.Renderer:
    """An off-screen renderer; RenderError if no GL is chosen, or if the chosen one fails."""
    chosen = os.environ.get("MUJOCO_GL")
    if not chosen:
        raise RenderError(
            "no off-screen GL: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6), and call "
            "runtime.prepare() before mujoco is imported"
        )
    try:
        return mujoco.Renderer(model, height, width, **more)
    except Exception as error:  # each GL fails in its own way
        raise RenderError(
            f"MUJOCO_GL={chosen} does not work here ({first_line(error)}); "
            "try the other of egl and osmesa"
        ) from error


def require_gl() -> None:
    """RenderError if this machine cannot draw off screen."""
    with _renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), height=16, width=16):
        pass


def shown_robot(policy: "Policy", terrain: TerrainConfig | None = None) -> Robot:
    """The policy's robot at high fidelity; the training model has shapes that should be hidden.

    `terrain`: uneven ground of one kind and size.
    """
    return robot_lib.load("high", name=policy.config.physics.robot, terrain=terrain)


def _drawable(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model in which MuJoCo's renderer shows the geoms of `shapes.drawn`, no more."""
    copied, hidden = copy.copy(model), mujoco.mjNGROUP - 1
    shown = np.isin(np.arange(model.ngeom), shapes.drawn(model))
    copied.geom_group[:] = np.where(shown, 0, hidden)
    return copied


def put_ground(robot: Robot, model: mujoco.MjModel, ground: Ground, x: float, y: float) -> float:
    """Moves the height field of `model`, a copy of the robot's, to where a robot is.

    Returns the mean height of the ground around it [m].
    """
    (floor,) = robot.ground_geom_ids
    pos, quat, far = ground_lib.place(ground, x, y, np)
    model.geom_pos[floor], model.geom_quat[floor], model.geom_dataid[floor] = pos, quat, int(far)
    return ground_lib.level(ground, x, y)


def camera(distance: float, azimuth: float = 90.0, elevation: float = -8.0) -> mujoco.MjvCamera:
    """A camera at `distance` [m] from `lookat`, which the caller sets; angles in degrees."""
    cam = mujoco.MjvCamera()
    cam.distance, cam.azimuth, cam.elevation = distance, azimuth, elevation
    return cam


def frames(
    robot: Robot,
    qpos: np.ndarray,
    width: int = 640,
    height: int = 480,
    distance: float = 3.0,
    ground: Ground | None = None,
) -> Iterator[np.ndarray]:
    """Yields one picture [height, width, 3] per row of a trajectory.

    The camera moves with the robot and shows it from the side.

    Args:
      robot: at high fidelity; the training model has shapes that should stay hidden.
      qpos: [T, 7 + n] trajectory.
      width, height: size of a picture [pixels].
      distance: distance of the camera [m] for XBot-L; it scales with the robot's size.
      ground: [T] uneven ground, if the robot has it.
    """
    model, size, floor = _drawable(robot.mj_model), robot.length_ratio, 0.0
    data, cam = mujoco.MjData(model), camera(distance * size)
    with _renderer(model, height, width) as renderer:
        for i, q in enumerate(qpos):
            data.qpos[:] = q
            if ground is not None:
                floor = put_ground(robot, model, _row(ground, i), q[0], q[1])
            mujoco.mj_forward(model, data)
            cam.lookat[:] = [q[0], q[1], EYE_LEVEL * size + floor]
            renderer.update_scene(data, cam)
            yield renderer.render()


def _row(ground: Ground, i: int) -> Ground:
    return jax.tree.map(lambda x: x[i], ground)


def gait_strip(
    robot: Robot,
    qpos: np.ndarray,
    dt: float,
    interval: float = 0.25,
    width: int = 1800,
    height: int = 420,
    ground: Ground | None = None,
) -> np.ndarray:
    """One picture [height, width, 3] with the robot every `interval` seconds, as in the paper.

    The floor has a grid of 1 m.

    Args:
      robot: at high fidelity.
      qpos: [T, 7 + n] trajectory.
      dt: time between two rows of `qpos` [s].
      interval: time between two images of the robot [s].
      width, height: size of the picture [pixels].
      ground: [T] uneven ground, if the robot has it.
    """
    model, size = _drawable(robot.mj_model), robot.length_ratio
    shown = qpos[:: round(interval / dt)]
    middle, length = shown[:, 0].mean(), np.ptp(shown[:, 0]) + 2.0
    cam = camera(0.0, elevation=-6.0)
    across, floors = shown[:, 1].mean(), np.zeros(1)
    if ground is not None:
        floors = ground_lib.height(_row(ground, 0), shown[:, 0], shown[:, 1], np)
    # A long lens far away shows all images from the same angle. The distance makes all of them fit.
    half_height = np.tan(np.radians(LONG_LENS / 2))
    tall = TALL * size + np.ptp(floors)
    cam.distance = 0.5 * max(length * height / width, tall) / half_height
    cam.lookat[:] = [middle, across, EYE_LEVEL * size + floors.mean()]
    data, options = mujoco.MjData(model), (mujoco.MjvOption(), mujoco.MjvPerturb())
    model.vis.global_.fovy = LONG_LENS
    windows: set[tuple[float, ...]] = set()  # places of the height fields that the picture has
    with _renderer(model, height, width, max_geom=20_000) as renderer:
        for i, q in enumerate(shown):
            data.qpos[:] = q
            new = ground is not None and _put_window(robot, model, _row(ground, 0), q, windows)
            mujoco.mj_forward(model, data)
            if i == 0:
                renderer.update_scene(data, cam)
                continue
            what = mujoco.mjtCatBit.mjCAT_ALL if new else mujoco.mjtCatBit.mjCAT_DYNAMIC
            mujoco.mjv_addGeoms(model, data, *options, what, renderer.scene)
        return renderer.render()


def _put_window(
    robot: Robot, model: mujoco.MjModel, ground: Ground, qpos: np.ndarray, known: set
) -> bool:
    """Moves the height field below a robot; True if no robot before it stood on this one.

    A height field is a window of the ground. A strip may be longer than one.
    """
    put_ground(robot, model, ground, qpos[0], qpos[1])
    (floor,) = robot.ground_geom_ids
    place = tuple(model.geom_pos[floor])
    new = place not in known
    known.add(place)
    return new


def stack(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Stacks pictures of the same width into one, from top to bottom."""
    return np.concatenate(list(pictures))
