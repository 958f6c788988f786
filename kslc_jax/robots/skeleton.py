"""Bodies, masses and joints of an MJCF, rebuilt in another spec without its welded joints.

The compiled MJCF is the source, so that its defaults, frames, includes and inertias of shapes are
resolved. At the home pose the base is upright and its origin is the world's.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from kslc_jax.robots import anatomy
from kslc_jax.robots.description import Description, RobotError
from kslc_jax.robots.servos import joint_names, matching

MAX_TILT = 0.35
"""Largest tilt [rad] of the base in the MJCF's keyframe."""

TOLD_TILT = 0.01
"""Tilt [rad] of the base in the keyframe from which users are told that it is made upright."""


@dataclass(frozen=True, eq=False)
class Source:
    """A compiled MJCF at the home pose, and the joints of it that stay."""

    model: mujoco.MjModel
    data: mujoco.MjData  # kinematics at home: frames of bodies and geoms
    joints: list[int]  # ids of the hinges that stay
    names: list[str]  # of these
    angles: np.ndarray  # [n] rad, home
    carrier: np.ndarray  # [nbody] the body of the new model that a body is part of; 0: none
    straightened: float  # rad, tilt of the base in the keyframe, see `tilt`

    def local(self, body: int, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] from the world at home to the frame of a body of the source."""
        return (points - self.data.xpos[body]) @ self.data.xmat[body].reshape(3, 3)

    def turn(self, body: int, rotation: np.ndarray) -> np.ndarray:
        """Quaternion in a body's frame of a rotation matrix in the world at home."""
        return _quat(self.data.xmat[body].reshape(3, 3).T @ rotation.reshape(3, 3))


def at_home(description: Description, model: mujoco.MjModel) -> Source:
    """Poses the compiled MJCF and finds the joints that stay."""
    hinges = list(range(1, model.njnt))
    names = joint_names(model)
    weld = matching(description, "weld", [(p, None) for p in description.weld], names)
    welded = frozenset(hinges[i] for i, _ in weld)
    anatomy.check(model, welded)
    qpos, straightened = _keyframe(description, model), tilt(description, model)
    qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    for i, angle in matching(description, "home", description.home, names):
        qpos[model.jnt_qposadr[hinges[i]]] = angle
    joints = [i for i in hinges if i not in welded]
    _require_in_range(description, model, joints, qpos)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return Source(
        model=model,
        data=data,
        joints=joints,
        names=[names[i - 1] for i in joints],
        angles=qpos[model.jnt_qposadr[joints]],
        carrier=_carriers(model, joints),
        straightened=straightened,
    )


def _keyframe(description: Description, model: mujoco.MjModel) -> np.ndarray:
    """qpos of the MJCF's keyframe: the named one, the first one, or the zero pose."""
    names = [model.key(i).name for i in range(model.nkey)]
    if description.keyframe and description.keyframe not in names:
        raise RobotError(
            f"{description.path}: keyframe: no {description.keyframe!r} in {description.mjcf.name};"
            f" it has {', '.join(names) or 'none'}"
        )
    key = names.index(description.keyframe) if description.keyframe else 0
    return (model.key_qpos[key] if names else model.qpos0).copy()


def tilt(description: Description, model: mujoco.MjModel) -> float:
    """Angle [rad] between the base's z axis and the vertical in the keyframe; 0 if it is small.

    The home pose has an upright base: the angles of the base, which the policy sees and which the
    rewards hold at 0, begin there. The joints keep the angles of the keyframe.

    Raises:
      RobotError: the base lies on its side.
    """
    quat = _keyframe(description, model)[3:7]
    _, x, y, _ = quat / np.linalg.norm(quat)
    angle = float(2 * np.arcsin(min(np.hypot(x, y), 1.0)))
    if angle > MAX_TILT:
        raise RobotError(
            f"{description.path}: keyframe: the base lies on its side at home; its frame must have "
            "x forward and z up"
        )
    return angle if angle > TOLD_TILT else 0.0


def _require_in_range(
    description: Description, model: mujoco.MjModel, joints: list[int], qpos: np.ndarray
) -> None:
    for joint in joints:
        angle, (low, high) = qpos[model.jnt_qposadr[joint]], model.jnt_range[joint]
        if not low - 1e-3 <= angle <= high + 1e-3:
            name = model.joint(joint).name
            raise RobotError(
                f"{description.path}: home: {angle:g} rad is outside the range of joint {name!r}, "
                f"{low:g} to {high:g}"
            )


def _carriers(model: mujoco.MjModel, joints: list[int]) -> np.ndarray:
    """[nbody] per body the nearest ancestor or self that moves, down from the base; else 0."""
    base, moves = int(model.jnt_bodyid[0]), set(model.jnt_bodyid[joints].tolist())
    carrier = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        own = body == base or body in moves
        carrier[body] = body if own else carrier[model.body_parentid[body]]
        count = int(np.sum(model.jnt_bodyid[joints] == body))
        if body != base and 0 < count < model.body_jntnum[body]:
            name = model.body(body).name
            raise RobotError(f"weld: body {name!r} has several joints: weld all of them, or none")
    return carrier


def grow(spec: mujoco.MjSpec, source: Source) -> dict[int, mujoco.MjsBody]:
    """Adds the robot's bodies, masses and joints to a spec; returns them by their source's id."""
    model = source.model
    bodies: dict[int, mujoco.MjsBody] = {}
    for body in np.flatnonzero(source.carrier == np.arange(model.nbody))[1:].tolist():
        above = int(model.body_parentid[body])
        parent = bodies.get(int(source.carrier[above]), spec.worldbody)
        new = bodies[body] = parent.add_body(name=model.body(body).name or f"body{body}")
        if parent is spec.worldbody:
            new.add_freejoint(name=model.joint(0).name)
        else:
            new.pos, new.quat = _place(source, body, above)
        _add_mass(new, source, body)
    for joint, name in zip(source.joints, source.names, strict=True):
        adr, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        bodies[int(model.jnt_bodyid[joint])].add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            pos=model.jnt_pos[joint],
            axis=model.jnt_axis[joint],
            range=model.jnt_range[joint],
            ref=model.qpos0[adr],
            springref=model.qpos_spring[adr],
            stiffness=model.jnt_stiffness[joint],
            damping=model.dof_damping[dof],
        )
    return bodies


def _place(source: Source, body: int, above: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of a body in the frame of the body that carries its parent."""
    model, data = source.model, source.data
    carrier = int(source.carrier[above])
    if carrier == above:
        return model.body_pos[body], model.body_quat[body]
    rotation = data.xmat[above].reshape(3, 3)
    own = np.zeros(9)
    mujoco.mju_quat2Mat(own, model.body_quat[body])
    place = data.xpos[above] + rotation @ model.body_pos[body]
    return source.local(carrier, place), source.turn(carrier, rotation @ own.reshape(3, 3))


def _add_mass(new: mujoco.MjsBody, source: Source, body: int) -> None:
    """Gives a body its mass and that of the bodies that are welded to it."""
    model, data = source.model, source.data
    members = np.flatnonzero(source.carrier == body)
    new.explicitinertial = True
    if len(members) == 1:
        new.mass, new.ipos = model.body_mass[body], model.body_ipos[body]
        new.iquat, new.inertia = model.body_iquat[body], model.body_inertia[body]
        return
    masses = model.body_mass[members]
    centre = masses @ data.xipos[members] / masses.sum()
    inertia = np.zeros((3, 3))
    for member, mass in zip(members, masses, strict=True):
        axes, arm = data.ximat[member].reshape(3, 3), data.xipos[member] - centre
        inertia += (axes * model.body_inertia[member]) @ axes.T
        inertia += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    rotation = data.xmat[body].reshape(3, 3)
    xx = rotation.T @ inertia @ rotation
    new.mass, new.ipos = masses.sum(), source.local(body, centre)
    new.fullinertia = [xx[0, 0], xx[1, 1], xx[2, 2], xx[0, 1], xx[0, 2], xx[1, 2]]


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.flatten())
    return quat
