"""Metrics of a robot's motion, from a `Trace`, in numpy.

All functions take the trace [T, N, ...] of one commanded speed, and use the time after `SETTLE`. A
trial with a fall counts as 0 m/s in `forward_mean` and `forward_rmse`. The metrics of speed
variation, effort, strides, symmetry and momentum leave such trials out. `summary` joins all
metrics. Angular momenta are about the whole-body centre of mass (paper, Eq. 3).
"""

import jax
import mujoco
import numpy as np
from scipy.special import stdtrit

from kslc_jax.evaluation.trials import Trace
from kslc_jax.robot import Robot

GRAVITY = 9.81
SETTLE = 2.0
"""Time [s] at the start of a trial that does not count: the robot still gathers speed."""

RESTING = 0.1
"""Mean forward speed [m/s] up to which cost of transport and stride length are not defined."""

RANGES = {"leg_pitch": "hip", "knee": "knee", "shoulder_pitch": "shoulder"}
"""Metrics of joint ranges, and the roles of their joints."""

MOMENTUM_EVERY = 0.05
"""Time [s] between two samples of the limbs' angular momentum."""

CHATTER = 0.05
"""A foot that leaves the ground for less than this time [s] counts as still on the ground."""


def _steady(trace: Trace, dt: float) -> Trace:
    """The part of the trace after `SETTLE`, of the trials without a fall."""
    start = round(SETTLE / dt)
    upright = trace.alive[-1]
    return jax.tree.map(lambda x: x[start:, upright], trace)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation over time of two signals [T, N], mean over trials. A constant signal gives 0."""
    a, b = a - a.mean(0), b - b.mean(0)
    scale = np.sqrt((a**2).sum(0) * (b**2).sum(0))
    return float(np.mean(np.where(scale > 1e-6, (a * b).sum(0) / np.maximum(scale, 1e-6), 0.0)))


def _difference(left: float, right: float) -> float:
    """|left - right| divided by the mean of their absolute values."""
    return abs(left - right) / max(0.5 * (abs(left) + abs(right)), 1e-6)


def _interval(name: str, per_trial: np.ndarray) -> dict[str, float]:
    """Half width of the 95 % confidence interval of a mean over trials, as NAME_ci.

    It uses Student's t. One trial has no interval.
    """
    count = len(per_trial)
    if count < 2:
        return {}
    half = stdtrit(count - 1, 0.975) * per_trial.std(ddof=1) / np.sqrt(count)
    return {f"{name}_ci": float(half)}


def speed(trace: Trace, command: float, dt: float) -> dict[str, float]:
    """Survival and velocity tracking.

    The paper measures the mean forward velocity. Here a trial with a fall counts as 0 m/s.
    """
    start = round(SETTLE / dt)
    upright = trace.alive[-1]
    mean = np.where(upright, trace.linvel[start:, :, 0].mean(0), 0.0)
    out = {
        "survival": float(upright.mean()),
        "forward_mean": float(mean.mean()),
        **_interval("forward_mean", mean),
        "forward_rmse": float(np.sqrt(np.mean((mean - command) ** 2))),
    }
    s = _steady(trace, dt)
    if not upright.all():
        out["seconds_to_fall"] = float(trace.alive[:, ~upright].sum(0).mean() * dt)
    if upright.any():
        if command == 0.0:
            way = np.asarray(s.qpos)[-1, ..., :2] - np.asarray(s.qpos)[0, ..., :2]
            out["drift"] = float(np.hypot(*way.T).max() / ((len(s.qpos) - 1) * dt))
        linvel, angvel = np.asarray(s.linvel), np.asarray(s.angvel)
        swings = {
            "forward_std": linvel[..., 0].std(0),
            "lateral_std": linvel[..., 1].std(0),
            "yaw_rate_std": angvel[..., 2].std(0),
        }
        out |= {name: float(x.mean()) for name, x in swings.items()}
        for name, x in swings.items():
            out |= _interval(name, x)
        out |= {
            "forward_bias": float(mean[upright].mean() - command),
            "lateral_mean": float(linvel[..., 1].mean()),
            "yaw_rate_mean": float(angvel[..., 2].mean()),
            "roll_deg": float(np.degrees(np.abs(s.euler[..., 0]).mean())),
            "pitch_deg": float(np.degrees(s.euler[..., 1].mean())),
        }
    return out


def effort(trace: Trace, robot: Robot, dt: float) -> dict[str, float]:
    """Load of the motors, and cost of transport.

    The cost of transport [] is the mechanical work of the motors per weight and distance,
    P / (m g |vx|). P [W] is sum |torque x joint speed|: a braking motor costs as much as a driving
    one, and heat does not count. m [kg] is the mass of the robot with its payload. vx [m/s] is the
    forward velocity of the base. Means are over time and trials.
    """
    s = _steady(trace, dt)
    power = np.abs(s.torque * s.joint_vel).sum(-1).mean()
    forward = np.asarray(s.linvel[..., 0])
    moved = GRAVITY * abs(float((s.mass * forward).mean()))
    load = np.abs(s.torque) / robot.effort_limit
    goes = abs(forward.mean()) > RESTING
    transport = {"cost_of_transport": float(power / moved)} if goes else {}
    return transport | {
        "within_speed_limits": float((np.abs(s.joint_vel) <= robot.speed_limit).all(-1).mean()),
        "peak_torque_share": float(load.max()),
        "mean_torque_share": float(load.mean()),
    }


def _touchdowns(contact: np.ndarray, dt: float) -> np.ndarray:
    """Number of landings [N, 2] in a contact record [T, N, 2].

    A foot that chatters (see `CHATTER`) lands once. A foot that starts on the ground has not
    landed.
    """
    window = round(CHATTER / dt)
    padded = np.pad(contact, ((window, 0), (0, 0), (0, 0)), mode="edge")
    recently = np.any([padded[i : i + len(contact)] for i in range(window)], axis=0)
    return (contact & ~recently).sum(0)


def strides(trace: Trace, dt: float) -> dict[str, float]:
    """Stride frequency and length, flight, double support, clearance, left-right differences."""
    s = _steady(trace, dt)
    frequency = float(_touchdowns(np.asarray(s.contact), dt).mean() / (len(s.contact) * dt))
    swing_top = [
        float(np.percentile(s.foot_height[..., i], 95) - np.percentile(s.foot_height[..., i], 5))
        for i in (0, 1)
    ]
    stance, forward = s.contact.mean((0, 1)), float(s.linvel[..., 0].mean())
    length = {"stride_length": forward / max(frequency, 1e-3)} if abs(forward) > RESTING else {}
    return {
        "stride_frequency": frequency,
        **length,
        "flight_share": float((~s.contact.any(-1)).mean()),
        "double_support_share": float(s.contact.all(-1).mean()),
        "clearance": min(swing_top),
        "stance_difference": _difference(*map(float, stance)),
        "clearance_difference": _difference(*swing_top),
    }


def symmetry(trace: Trace, robot: Robot, dt: float) -> dict[str, float]:
    """Left-right differences of joint ranges, arm swing, and its correlation with the leg swing."""
    s = _steady(trace, dt)
    forward = np.asarray(s.qpos)[..., 7:] * robot.anatomy.pitch  # rotations about y
    low, high = np.percentile(forward, [5, 95], axis=0).mean(1)
    span, roles = high - low, robot.anatomy.roles
    out = {
        f"{name}_range_difference": _difference(
            span[roles[f"left_{role}"]], span[roles[f"right_{role}"]]
        )
        for name, role in RANGES.items()
        if f"left_{role}" in roles
    }
    if "left_shoulder" not in roles:
        return out
    out["shoulder_range"] = float(span[roles["left_shoulder"]])
    out["shoulder_hip_correlation"] = float(
        np.mean(
            [
                _correlation(
                    forward[..., roles[f"{side}_shoulder"]], forward[..., roles[f"{side}_hip"]]
                )
                for side in ("left", "right")
            ]
        )
    )
    return out


def _bodies_of(robot: Robot, part: str) -> np.ndarray:
    """Mask [bodies] bool of the bodies that belong to the limbs `part`, "arm" or "leg"."""
    first = [
        robot.joint_body_ids[joints[0]]
        for limb, joints in robot.anatomy.limbs.items()
        if limb.endswith(part)
    ]
    return np.any(robot.subtree[first], axis=0)


def body_momentum(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Angular momentum of every body about the whole-body CoM, at the qpos and qvel of `data`.

    Returns [bodies, 3] in the world frame [kg m^2/s].
    """
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
        stage(model, data)
    mujoco.mj_subtreeVel(model, data)
    # cvel is the velocity of the point of each body that coincides with the whole-body CoM.
    spin, at_com = data.cvel[:, :3], data.cvel[:, 3:]
    arm = data.xipos - data.subtree_com[0]
    moving = at_com + np.cross(spin, arm) - data.subtree_linvel[0]
    rotation = data.ximat.reshape(-1, 3, 3)
    principal = model.body_inertia * np.einsum("bij,bi->bj", rotation, spin)
    spinning = np.einsum("bij,bj->bi", rotation, principal)
    return model.body_mass[:, None] * np.cross(arm, moving) + spinning


def momentum(trace: Trace, robot: Robot, dt: float) -> dict[str, float]:
    """RMS angular momentum [kg m^2/s] of the whole body, of the arms and of the legs.

    Each part has two values: one of the whole vector, one of its vertical component. The values of
    arms and legs use the masses of the nominal model, without a payload.
    """
    s = _steady(trace, dt)
    squares = (s.angular_momentum**2).mean((0, 1))
    out = {
        "momentum_rms": float(np.sqrt(squares.sum())),
        "momentum_yaw_rms": float(np.sqrt(squares[2])),
    }
    every = round(MOMENTUM_EVERY / dt)
    qpos = np.asarray(s.qpos[::every], np.float64).reshape(-1, s.qpos.shape[-1])
    linvel, angvel, joints = (
        np.asarray(x[::every], np.float64).reshape(len(qpos), -1)
        for x in (s.linvel, s.angvel, s.joint_vel)
    )
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    bodies = np.empty((len(qpos), model.nbody, 3))
    for i, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mju_rotVecQuat(data.qvel[:3], linvel[i], q[3:7])
        data.qvel[3:6], data.qvel[6:] = angvel[i], joints[i]
        bodies[i] = body_momentum(model, data)
    for part in ("arms", "legs"):
        mine = _bodies_of(robot, part.removesuffix("s"))
        if not mine.any():
            continue
        squares = (bodies[:, mine].sum(1) ** 2).mean(0)
        out[f"{part}_momentum_rms"] = float(np.sqrt(squares.sum()))
        out[f"{part}_momentum_yaw_rms"] = float(np.sqrt(squares[2]))
    return out


def summary(trace: Trace, command: float, robot: Robot, dt: float) -> dict[str, float]:
    """All metrics. If every trial had a fall, only those of `speed`."""
    out = speed(trace, command, dt)
    if out["survival"] == 0.0:
        return out
    return (
        out
        | effort(trace, robot, dt)
        | strides(trace, dt)
        | symmetry(trace, robot, dt)
        | momentum(trace, robot, dt)
    )
