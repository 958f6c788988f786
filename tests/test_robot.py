"""The robot's file against an independent calculation from the URDF's numbers."""

import json
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from kslc_jax import physics, randomize, robot

URDF = json.loads((Path(__file__).parent / "data" / "xbot_l_urdf.json").read_text())
LEG = ("leg_roll", "leg_yaw", "leg_pitch", "knee", "ankle_pitch", "ankle_roll")
ORDER = [f"{s}_{j}_joint" for s in ("left", "right") for j in LEG]
ORDER += [f"{s}_{j}_joint" for s in ("left", "right") for j in ("shoulder_pitch", "elbow_pitch")]
NOMINAL = jax.tree.map(np.asarray, randomize.nominal())


def rotation(rpy):
    """Fixed-axis x-y-z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def about(axis, angle):
    """Rodrigues."""
    k = np.cross(np.eye(3), np.asarray(axis) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def forward(q):
    """World (R, p) of every URDF link with the base at the origin, and per-joint (axis, anchor,
    links moved). Runs over the URDF's own frames, all 90 joints."""
    pose = {"base_link": (np.eye(3), np.zeros(3))}
    angle = dict(zip(ORDER, q, strict=True))
    joints = {}
    for link, row in URDF.items():  # parents come first
        if row["parent"] is None:
            continue
        r, p = pose[row["parent"]]
        anchor = p + r @ np.array(row["xyz"])
        r = r @ rotation(row["rpy"])
        if row["joint"] in angle:
            joints[row["joint"]] = (r @ np.array(row["axis"]), anchor, link)
            r = r @ about(row["axis"], angle[row["joint"]])
        pose[link] = (r, anchor)
    return pose, joints


def moves(joint_link, link):
    while link is not None:
        if link == joint_link:
            return True
        link = URDF[link]["parent"]
    return False


def inertia_matrix(q):
    """Joint-space inertia [22, 22]: sum over URDF links of J^T M J, base twist first."""
    pose, joints = forward(q)
    total = np.zeros((22, 22))
    for link, row in URDF.items():
        if row["mass"] == 0:
            continue
        r, p = pose[link]
        com = p + r @ np.array(row["com"])
        axes = r @ rotation(row["inertia_rpy"])
        world = axes @ np.array(row["inertia"]) @ axes.T
        jv, jw = np.zeros((3, 22)), np.zeros((3, 22))
        jv[:, :3], jw[:, 3:6] = np.eye(3), np.eye(3)
        jv[:, 3:6] = np.array([np.cross(e, com) for e in np.eye(3)]).T
        for i, name in enumerate(ORDER):
            axis, anchor, child = joints[name]
            if moves(child, link):
                jv[:, 6 + i], jw[:, 6 + i] = np.cross(axis, com - anchor), axis
        total += row["mass"] * jv.T @ jv + jw.T @ world @ jw
    return total


@pytest.fixture(scope="module")
def poses(xbot):
    rng = np.random.default_rng(0)
    return rng.uniform(xbot.joint_lower, xbot.joint_upper, (10, 16))


def at_origin(model, q):
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7], data.qpos[7:] = 0, [1, 0, 0, 0], q
    mujoco.mj_forward(model, data)
    return data


def test_joint_order_and_names(xbot):
    assert list(xbot.joint_names) == ORDER
    assert [xbot.mj_model.joint(i + 1).name for i in range(16)] == ORDER


def test_mass(xbot):
    assert xbot.total_mass == pytest.approx(53.036, abs=1e-3)
    assert xbot.total_mass == pytest.approx(sum(r["mass"] for r in URDF.values()), abs=1e-6)


def test_link_positions_within_a_tenth_of_a_millimetre(xbot, poses):
    for q in poses:
        data, (expected, _) = at_origin(xbot.mj_model, q), forward(q)
        for i in range(1, xbot.mj_model.nbody):
            name = xbot.mj_model.body(i).name
            np.testing.assert_allclose(data.xpos[i], expected[name][1], atol=1e-4, err_msg=name)


def test_joint_space_inertia_within_a_tenth_of_a_percent(xbot, poses):
    for q in poses:
        data = at_origin(xbot.mj_model, q)
        full = np.zeros((22, 22))
        mujoco.mj_fullM(xbot.mj_model, data, full)
        expected = inertia_matrix(q)
        np.testing.assert_allclose(np.diag(full), np.diag(expected), rtol=1e-3)
        assert np.linalg.norm(full - expected) < 1e-3 * np.linalg.norm(expected)


def test_limits_gains_and_motors(xbot):
    joint_rows = {r["joint"]: r for r in URDF.values()}
    lower, upper, effort, speed = zip(*(joint_rows[n]["limit"] for n in ORDER), strict=True)
    np.testing.assert_allclose(xbot.joint_lower, lower)
    np.testing.assert_allclose(xbot.joint_upper, upper)
    np.testing.assert_allclose(xbot.effort_limit, 0.85 * np.array(effort))
    np.testing.assert_allclose(xbot.speed_limit, speed)
    leg = [200, 200, 350, 350, 15, 15]
    np.testing.assert_allclose(xbot.kp, [*leg, *leg, 100, 100, 100, 100])
    np.testing.assert_allclose(xbot.kd, np.full(16, 10.0))


def test_sensors_have_the_sizes_that_signals_read(xbot):
    sizes = {"angmom": 3, "com": 3, "base_quat": 4}
    for side in ("left", "right"):
        sizes |= {f"{side}_foot_touch": 1, f"{side}_foot_pos": 3, f"{side}_knee_pos": 3}
    for name, size in sizes.items():
        at = xbot.sensor(name)
        assert at.stop - at.start == size
    with pytest.raises(KeyError):
        xbot.sensor("left_elbow_smell")


def test_angular_momentum_is_eq_3(xbot):
    """L = sum c_i x m_i cdot_i + I_i w_i about the whole-body CoM equals the sensor to 1e-4."""
    model = xbot.mj_model
    rng = np.random.default_rng(1)
    data = mujoco.MjData(model)
    for _ in range(10):
        data.qpos[:] = xbot.default_qpos
        data.qpos[7:] += rng.uniform(-0.5, 0.5, 16)
        quat = rng.normal(size=4)
        data.qpos[3:7] = quat / np.linalg.norm(quat)
        data.qvel[:] = rng.normal(size=22) * 3
        mujoco.mj_forward(model, data)
        mass = model.body_mass[1:]
        velocity = np.zeros((model.nbody, 6))
        for i in range(model.nbody):
            mujoco.mj_objectVelocity(
                model, data, mujoco.mjtObj.mjOBJ_BODY, i, velocity[i], 0
            )  # rotation, then translation of the body's own CoM, world axes
        com = mass @ data.xipos[1:] / mass.sum()
        com_velocity = mass @ velocity[1:, 3:] / mass.sum()
        total = np.zeros(3)
        for i in range(1, model.nbody):
            axes = data.ximat[i].reshape(3, 3)
            inertia = axes @ np.diag(model.body_inertia[i]) @ axes.T
            c, cdot = data.xipos[i] - com, velocity[i, 3:] - com_velocity
            total += np.cross(c, model.body_mass[i] * cdot) + inertia @ velocity[i, :3]
        np.testing.assert_allclose(data.sensordata[xbot.sensor("angmom")], total, atol=1e-4)


def test_only_soles_and_floor_can_meet_in_training(xbot):
    m = xbot.mj_model
    robots = m.geom_bodyid > 0
    meets = [m.geom(i).name for i in np.flatnonzero(robots & (m.geom_contype > 0))]
    assert len(meets) == 8 and all("toe" in n or "heel" in n for n in meets)
    assert not m.geom_conaffinity[robots].any()
    assert set(xbot.foot_geom_ids) == {m.geom(n).id for n in meets}


def test_high_fidelity_options():
    m = robot.load("high").mj_model
    assert m.opt.timestep == 0.001
    assert m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert m.opt.iterations >= 100
    np.testing.assert_allclose(m.dof_frictionloss[6:], [0.01] * 12 + [1.0] * 4)
    np.testing.assert_allclose(m.dof_armature[6:], 0.01)
    assert m.body_subtreemass[0] == pytest.approx(53.036, abs=1e-3)


def high_contacts(q, height=2.0):
    model = robot.load("high").mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.load().default_qpos
    data.qpos[2], data.qpos[7:] = height, q
    mujoco.mj_forward(model, data)
    return {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact}


def test_high_fidelity_self_collision(xbot):
    assert not high_contacts(np.zeros(16))
    rng = np.random.default_rng(2)
    for _ in range(50):  # one leg alone never touches itself
        q = np.zeros(16)
        q[2:5] = rng.uniform([-1.2, -0.9, -0.6], [0.6, 0.6, 0.6])
        q[8:11] = -q[2:5]
        assert not high_contacts(q)
    crossed = np.zeros(16)
    crossed[[0, 6]] = [-0.4, 0.4]
    assert any("left" in " ".join(p) and "right" in " ".join(p) for p in high_contacts(crossed))


def test_high_fidelity_floor_meets_all_parts():
    lying = high_contacts(np.zeros(16), height=0.1)
    assert {frozenset(("floor", part)) for part in ("pelvis", "left_hand", "left_shank")} <= lying
    feet = high_contacts(np.zeros(16), height=0.88)
    assert feet == {frozenset(("floor", "left_foot")), frozenset(("floor", "right_foot"))}


@pytest.mark.parametrize("fidelity", ["train", "high"])
def test_stands_on_its_feet(fidelity):
    """Servos at zero for 0.3 s: still upright; the touch sensors' impulse is the momentum gained."""
    r = robot.load(fidelity)
    data = mujoco.MjData(r.mj_model)
    data.qpos[:] = r.default_qpos
    data.qpos[2] = 0.885
    dt, impulse = r.mj_model.opt.timestep, 0.0
    for _ in range(round(0.3 / dt)):
        torque = physics.motor_torque(r, NOMINAL, data.qpos[7:], data.qvel[6:], np.zeros(16), np)
        data.ctrl[:] = physics.servo_control(r, torque, data.qpos[7:], data.qvel[6:])
        mujoco.mj_step(r.mj_model, data)
        feet = (data.sensordata[r.sensor(f"{s}_foot_touch")][0] for s in ("left", "right"))
        impulse += dt * sum(feet)
    mujoco.mj_forward(r.mj_model, data)
    mujoco.mj_subtreeVel(r.mj_model, data)
    gained = 53.036 * (data.subtree_linvel[0, 2] + 9.81 * 0.3)
    assert data.qpos[2] > 0.8
    assert impulse == pytest.approx(gained, rel=0.01)


def test_mirrored_joints_give_the_mirrored_robot(xbot):
    """Bodies land at (x, -y, z) of their partners, within the URDF's own left-right differences."""
    permutation, sign = robot.mirror_joints()
    q = np.random.default_rng(3).uniform(-0.4, 0.4, 16)
    np.testing.assert_allclose((q[permutation] * sign)[permutation] * sign, q)
    m = xbot.mj_model
    here, there = at_origin(m, q), at_origin(m, q[permutation] * sign)
    for i in range(2, m.nbody):
        name = m.body(i).name
        side, rest = name.split("_", 1)
        partner = m.body(("right_" if side == "left" else "left_") + rest).id
        expected = here.xpos[i] * [1, -1, 1]
        np.testing.assert_allclose(there.xpos[partner], expected, atol=1e-4)
