"""Motors of a robot: the MJCF's values, then the description's, as position servos."""

import re
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import TypeVar, cast

import mujoco
import numpy as np

from kslc_jax.robots.description import Description, Motor, RobotError

Value = TypeVar("Value")

_REQUIRED = ("kp", "kd", "effort", "speed")


def matching(
    description: Description, field: str, entries: Iterable[tuple[str, Value]], names: list[str]
) -> list[tuple[int, Value]]:
    """(index of a joint, value) of every pattern and every joint that it matches, in file order.

    Raises:
      RobotError: a pattern matches no joint.
    """
    found = []
    for pattern, value in entries:
        hits = [i for i, name in enumerate(names) if re.search(pattern, name)]
        if not hits:
            raise RobotError(
                f"{description.path}: {field}: {pattern!r} matches no joint; "
                f"there are {', '.join(names)}"
            )
        found += [(i, value) for i in hits]
    return found


def joint_names(model: mujoco.MjModel) -> list[str]:
    """Names of all joints but the first, which is the free one."""
    return [model.joint(i).name or f"joint{i}" for i in range(1, model.njnt)]


def motors(description: Description, model: mujoco.MjModel, joints: list[int]) -> list[Motor]:
    """The motor of each joint, every field a number.

    Args:
      description: its [motors] go before the MJCF's values.
      model: the compiled MJCF.
      joints: ids in `model` of the joints that have a motor.

    Raises:
      RobotError: motors lack values; the message has the lines to add for all of them.
    """
    names = joint_names(model)
    found = {joint: _of_mjcf(model, joint) for joint in joints}
    for i, given in matching(description, "motors", description.motors, names):
        if i + 1 in found:  # others are welded
            values = {k: v for k, v in asdict(given).items() if v is not None}
            found[i + 1] = replace(found[i + 1], **values)
    _require_complete(description, {names[joint - 1]: motor for joint, motor in found.items()})
    return list(found.values())


def _require_complete(description: Description, found: dict[str, Motor]) -> None:
    """Refuses motors that lack a value. Joints that lack the same values are told together."""
    lacking: dict[tuple[str, ...], list[str]] = {}
    for name, motor in found.items():
        missing = tuple(field for field in _REQUIRED if getattr(motor, field) is None)
        if missing:
            lacking.setdefault(missing, []).append(name)
    if not lacking:
        return
    told, lines = [], []
    for missing, joints in lacking.items():
        word = "joint" if len(joints) == 1 else "joints"
        told.append(f"{word} {', '.join(map(repr, joints))}: no {', '.join(missing)}")
        pattern = "." if len(joints) == len(found) else f"^({'|'.join(joints)})$"
        lines.append(f'"{pattern}" = {{ {", ".join(f"{field} = ..." for field in missing)} }}')
    raise RobotError(
        f"{description.path}: motors: {'; '.join(told)}; add under [motors]: {' and '.join(lines)}"
    )


def _of_mjcf(model: mujoco.MjModel, joint: int) -> Motor:
    """The motor of one joint, as the MJCF has it. A field that the MJCF does not give is None.

    The gains of a joint's actuators add up: some MJCFs have one for the position and one for the
    velocity.
    """
    dof = model.jnt_dofadr[joint]
    motor = Motor(
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
        damping=float(model.dof_damping[dof]),
    )
    efforts, gains = [], np.zeros(2)
    if model.jnt_actfrclimited[joint]:
        efforts.append(np.abs(model.jnt_actfrcrange[joint]).max())
    drives = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
        model.actuator_trnid[:, 0] == joint
    )
    for i in np.flatnonzero(drives):
        gear, gain = abs(model.actuator_gear[i, 0]), model.actuator_gainprm[i, 0]
        if model.actuator_forcelimited[i]:
            efforts.append(gear * np.abs(model.actuator_forcerange[i]).max())
        if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
            gains -= model.actuator_biasprm[i, 1:3] * gear**2
        elif model.actuator_ctrllimited[i]:
            efforts.append(gear * gain * np.abs(model.actuator_ctrlrange[i]).max())
    kp, kd = (float(gain) if gain > 0 else None for gain in gains)
    return replace(motor, kp=kp, kd=kd, effort=float(min(efforts)) if efforts else None)


def add_servos(spec: mujoco.MjSpec, motors: list[Motor], high: bool) -> None:
    """Replaces all actuators by one position servo per hinge, in joint order.

    Joint friction is 0 in training, where the environment draws it in each episode.
    """
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    hinges = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
    for joint, motor in zip(hinges, motors, strict=True):
        joint.armature = motor.armature
        joint.frictionloss = motor.friction if high else 0.0
        if high:
            linear = joint.damping
            joint.damping = motor.damping if np.ndim(linear) == 0 else [motor.damping, *linear[1:]]
        servo = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        servo.set_to_position(kp=motor.kp, kv=motor.kd)
        effort = cast(float, motor.effort)  # `motors` leaves no gap
        servo.forcerange = [-effort, effort]
    spec.add_numeric(name="speed_limit", data=[motor.speed for motor in motors])
