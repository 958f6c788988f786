"""The robot's model file against an independent calculation from the numbers of the URDF."""

import functools
import json
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from states import MIRROR, XBOT

from kslc_jax import motors, physics, randomize, robot
from kslc_jax.robots.contacts import PAIR_MARGIN

URDF = json.loads((Path(__file__).parent / "data" / "xbot_l_urdf.json").read_text())
LEG = ("leg_roll", "leg_yaw", "leg_pitch", "knee", "ankle_pitch", "ankle_roll")
ORDER = [f"{s}_{j}_joint" for s in ("left", "right") for j in LEG]
ORDER += [f"{s}_{j}_joint" for s in ("left", "right") for j in ("shoulder_pitch", "elbow_pitch")]
NOMINAL = jax.tree.map(np.asarray, randomize.nominal(XBOT))


def rotation(rpy):
    """Rotation matrix of URDF angles: about fixed axes x, y, z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def about(axis, angle):
    """Rotation matrix about an axis, by Rodrigues' formula."""
    k = np.cross(np.eye(3), np.asarray(axis) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def forward(q):
    """World (R, p) of every URDF link with the base at the origin, and per joint (axis, anchor,
    child link). It goes through the frames of all 90 URDF joints."""
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
    """Joint-space inertia [22, 22]: the sum over URDF links of J^T M J; the base twist is first."""
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
        full -= np.diag(xbot.mj_model.dof_armature)  # rotor inertia, not in the URDF
        expected = inertia_matrix(q)
        # The error of each entry is relative to the two inertias that it couples, so small ones
        # count too.
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((full - expected) / scale).max() < 1e-3


def test_every_frame_is_the_bases_at_the_zero_pose(xbot, poses):
    """Our rotations equal the URDF's rotations relative to its zero pose."""
    zero, _ = forward(np.zeros(16))
    for q in poses:
        data, (expected, _) = at_origin(xbot.mj_model, q), forward(q)
        for i in range(1, xbot.mj_model.nbody):
            name = xbot.mj_model.body(i).name
            turned = expected[name][0] @ zero[name][0].T
            np.testing.assert_allclose(data.xmat[i].reshape(3, 3), turned, atol=1e-4, err_msg=name)


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
    np.testing.assert_array_equal(xbot.is_arm, [False] * 12 + [True] * 4)


def test_the_engine_itself_limits_no_torque(xbot):
    """`motors.motor_torque` limits it. The servos are plain kp (ctrl - q) - damping dq."""
    m = xbot.mj_model
    np.testing.assert_array_equal(m.actuator_biasprm[:, 1], -xbot.kp)
    np.testing.assert_array_equal(m.actuator_gear[:, 0], 1)
    assert not m.actuator_forcelimited.any() and not m.actuator_ctrllimited.any()
    np.testing.assert_allclose(m.dof_armature[6:], 0.01)
    assert not m.dof_damping.any() and not m.dof_frictionloss.any()


@pytest.mark.parametrize("fidelity", ["train", "high"])
def test_sensors_by_name(fidelity):
    r = robot.load(fidelity)
    sizes = {"base_quat": 4, "base_linvel": 3, "base_gyro": 3, "com": 3, "angmom": 3}
    for quantity in ("foot_pos", "foot_zaxis", "foot_linvel", "knee_pos"):
        sizes |= {f"left_{quantity}": 3, f"right_{quantity}": 3}
    sizes |= {"left_foot_touch": 1, "right_foot_touch": 1}
    ends = np.cumsum(list(sizes.values()))
    for (name, size), end in zip(sizes.items(), ends, strict=True):
        assert r.sensor(name) == slice(end - size, end)
    assert r.mj_model.nsensordata == ends[-1]
    with pytest.raises(KeyError, match=r"left_elbow_smell.*base_quat.*right_foot_touch"):
        r.sensor("left_elbow_smell")


def test_sensors_read_what_their_names_say(xbot, poses):
    """Sensors against the links of the URDF, in random base poses. Expected speeds come from
    central differences of link positions."""
    model, rng, h = xbot.mj_model, np.random.default_rng(4), 1e-5

    def links(qpos):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, qpos[3:7])
        turn = turn.reshape(3, 3)
        return {k: (turn @ r, qpos[:3] + turn @ p) for k, (r, p) in forward(qpos[7:])[0].items()}

    def moved(qpos, qvel, time):
        end = qpos.copy()
        mujoco.mj_integratePos(model, end, qvel, time)
        return links(end)

    zero, _ = forward(np.zeros(16))
    data = mujoco.MjData(model)
    for q in poses:
        quat = rng.normal(size=4)
        data.qpos[:] = [*rng.normal(size=3), *(quat / np.linalg.norm(quat)), *q]
        data.qvel[:] = rng.normal(size=22)
        mujoco.mj_forward(model, data)
        here = links(data.qpos)
        before, after = moved(data.qpos, data.qvel, -h), moved(data.qpos, data.qvel, h)
        heavy = {k: r for k, r in URDF.items() if r["mass"] > 0}
        com = sum(r["mass"] * (here[k][1] + here[k][0] @ r["com"]) for k, r in heavy.items())
        expected = {
            "base_quat": data.qpos[3:7],
            "base_linvel": here["base_link"][0].T @ data.qvel[:3],
            "base_gyro": data.qvel[3:6],
            "com": com / xbot.total_mass,
        }
        for side in ("left", "right"):
            foot, knee = f"{side}_ankle_roll_link", f"{side}_knee_link"
            expected[f"{side}_foot_pos"] = here[foot][1]
            expected[f"{side}_foot_zaxis"] = here[foot][0] @ zero[foot][0].T[:, 2]
            expected[f"{side}_foot_linvel"] = (after[foot][1] - before[foot][1]) / (2 * h)
            expected[f"{side}_knee_pos"] = here[knee][1]
        for name, value in expected.items():
            actual = data.sensordata[xbot.sensor(name)]
            np.testing.assert_allclose(actual, value, atol=5e-4, err_msg=name)


def test_angular_momentum_is_eq_3(xbot):
    """The sensor equals L = sum c_i x m_i cdot_i + I_i w_i about the whole-body CoM to 1e-4."""
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
            )  # angular, then linear velocity of the body's own CoM, world axes
        com = mass @ data.xipos[1:] / mass.sum()
        com_velocity = mass @ velocity[1:, 3:] / mass.sum()
        total = np.zeros(3)
        for i in range(1, model.nbody):
            axes = data.ximat[i].reshape(3, 3)
            inertia = axes @ np.diag(model.body_inertia[i]) @ axes.T
            c, cdot = data.xipos[i] - com, velocity[i, 3:] - com_velocity
            total += np.cross(c, model.body_mass[i] * cdot) + inertia @ velocity[i, :3]
        np.testing.assert_allclose(data.sensordata[xbot.sensor("angmom")], total, atol=1e-4)


def test_only_soles_can_meet_the_floor_in_training(xbot):
    m = xbot.mj_model
    robots = m.geom_bodyid > 0
    meets = [m.geom(i).name for i in np.flatnonzero(robots & (m.geom_contype > 0))]
    assert len(meets) == 8 and all("toe" in n or "heel" in n for n in meets)
    assert not m.geom_conaffinity[robots].any()
    assert set(xbot.foot_geom_ids) == {m.geom(n).id for n in meets}
    feet = {m.body(m.geom_bodyid[i]).name for i in xbot.foot_geom_ids}
    assert feet == {"left_ankle_roll_link", "right_ankle_roll_link"}


@pytest.mark.parametrize("fidelity", ["train", "high"])
def test_soles_are_where_the_feet_end(fidelity):
    """The soles are 0.8853 m below the base. Each foot has four contacts, spread over the footprint
    of its mesh but not beyond.

    The contacts have the friction of the foot (geom priority), which `randomize` sets.
    """
    r = robot.load(fidelity)
    data = mujoco.MjData(r.mj_model)
    data.qpos[:] = r.default_qpos
    for height, count in ((0.8853 + 5e-4, 0), (0.8853 - 5e-4, 8)):
        data.qpos[2] = height
        mujoco.mj_forward(r.mj_model, data)
        assert data.ncon == count
    np.testing.assert_array_equal(data.contact.friction[:, :2], 1.0)
    for side in (1, -1):
        points = np.array([c.pos * [1, side, 1] for c in data.contact if side * c.pos[1] > 0])
        assert len(points) == 4
        assert np.all((points[:, :2] > [-0.0745, 0.0725]) & (points[:, :2] < [0.1345, 0.1615]))
        assert np.all(np.ptp(points[:, :2], axis=0) > [0.19, 0.07])
    assert np.all(r.mj_model.geom_priority[r.foot_geom_ids] == 1)
    assert np.all(r.mj_model.geom_condim[r.foot_geom_ids] == 3)
    assert np.all(r.mj_model.geom_friction[r.foot_geom_ids, 0] == 1.0)


def test_torso_box_is_humanoid_gyms(xbot):
    np.testing.assert_allclose(xbot.torso_box_center, [0, 0, 0.1])
    np.testing.assert_allclose(xbot.torso_box_half_size, 0.2)
    assert xbot.mj_model.body(xbot.anatomy.base).name == "base_link"
    assert xbot.default_qpos[2] == 0.95 and not xbot.default_qpos[7:].any()


def test_options_and_their_overrides(xbot):
    opt = xbot.mj_model.opt
    assert (opt.timestep, opt.iterations, opt.ls_iterations) == (0.005, 4, 5)
    assert opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    other = robot.load("train", timestep=0.002, iterations=7, ls_iterations=9)
    opt = other.mj_model.opt
    assert (opt.timestep, opt.iterations, opt.ls_iterations) == (0.002, 7, 9)
    assert robot.load(cone="elliptic").mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert robot.load("train", timestep=0.002, iterations=7, ls_iterations=9) is other
    assert robot.load() is xbot and xbot.mj_model.opt.timestep == 0.005


def test_mjx_takes_the_model(xbot):
    model = physics.mjx.put_model(xbot.mj_model, impl="jax")
    assert (model.nq, model.nu, model.nsensordata) == (23, 16, xbot.mj_model.nsensordata)


def test_high_fidelity_options():
    m = robot.load("high").mj_model
    assert m.opt.timestep == 0.001
    assert m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert m.opt.iterations >= 100
    assert m.opt.tolerance <= 1e-10 and m.opt.ls_iterations >= 50
    leg = [0.01, 0.01, 0.01, 0.01, 0.05, 0.05]  # the ankles of the public MJCF have more
    np.testing.assert_allclose(m.dof_frictionloss[6:], [*leg, *leg, 1, 1, 1, 1])
    np.testing.assert_allclose(m.dof_damping[6:], [0.01] * 12 + [1.0] * 4)
    np.testing.assert_allclose(m.dof_armature[6:], 0.01)
    assert m.body_subtreemass[0] == pytest.approx(53.036, abs=1e-3)


def contacts(q, fidelity="high", height=2.0):
    model = robot.load(fidelity).mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.load().default_qpos
    data.qpos[2], data.qpos[7:] = height, q
    mujoco.mj_forward(model, data)
    return {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact}


@functools.cache
def in_the_air(fidelity):
    model = robot.load(fidelity).mj_model
    data = mujoco.MjData(model)
    data.qpos[2] = 9.0
    return model, data


def parts_that_touch(q, fidelity):
    """Pairs of body ids that are in contact."""
    model, data = in_the_air(fidelity)
    data.qpos[7:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return {frozenset(pair) for pair in model.geom_bodyid[data.contact.geom].tolist()}


@pytest.mark.parametrize("spread", [0.2, 0.5, None], ids=["gaits", "wide", "limits"])
def test_what_touches_at_high_fidelity_touches_in_training(xbot, spread):
    """Random poses around the home pose, and anywhere within the joint limits. A policy would learn
    to pass one part through another if training allowed it."""
    rng = np.random.default_rng(7)
    low, high, touched = xbot.joint_lower, xbot.joint_upper, set()
    for _ in range(2000):
        q = rng.normal(0.0, spread, 16) if spread else rng.uniform(low, high)
        q = np.clip(q, low, high)
        found = parts_that_touch(q, "high")
        assert found <= parts_that_touch(q, "train"), q
        touched |= found
    assert len(touched) >= 8


def test_parts_are_kept_apart_a_little_before_they_touch():
    """The legs close like scissors. In training they touch earlier, by at most the margins."""
    closed, first = np.zeros(16), {}
    for roll in np.linspace(0.0, 0.3, 301):
        closed[[0, 6]] = -roll, roll
        for fidelity in ("train", "high"):
            if parts_that_touch(closed, fidelity):
                first.setdefault(fidelity, roll)
    leg = 0.1455 + 0.277128  # m, from the hip to the knee
    assert 0 < 2 * leg * (first["high"] - first["train"]) < 2 * PAIR_MARGIN


def test_stand_ins_cover_their_parts():
    """The foot's capsule plus the pair margin covers the corners of the foot's box; the forearm's
    capsule covers the ellipsoid of the hand."""
    for side in ("left", "right"):
        bumper, box = train(f"{side}_foot_bumper"), train(f"{side}_foot")
        np.testing.assert_allclose(bumper.pos, box.pos)
        radius, half_length = bumper.size[:2]
        corner = np.linalg.norm(box.size - [half_length, 0, 0])
        assert radius < corner < radius + PAIR_MARGIN
        bumper, hand = train(f"{side}_forearm_bumper"), train(f"{side}_hand")
        assert bumper.size[0] >= hand.size[0]
        assert bumper.pos[2] - bumper.size[:2].sum() <= hand.pos[2] - hand.size[2] + 1e-9


def train(name):
    return robot.load().mj_model.geom(name)


def test_stand_ins_are_gone_at_high_fidelity():
    m = robot.load("high").mj_model
    assert m.npair == 0
    assert not any("bumper" in m.geom(i).name for i in range(m.ngeom))


def test_high_fidelity_self_collision(xbot):
    assert not contacts(np.zeros(16))
    rng = np.random.default_rng(2)
    for _ in range(50):  # legs in the same pitch pose touch nothing
        q = np.zeros(16)
        q[2:5] = rng.uniform([-1.2, -0.9, -0.6], [0.6, 0.6, 0.6])
        q[8:11] = -q[2:5]
        assert not contacts(q)
    toes_in = np.zeros(16)
    toes_in[[1, 7]] = [0.9, -0.9]
    assert frozenset(("left_foot", "right_foot")) in contacts(toes_in)
    crossed = np.zeros(16)
    crossed[[0, 6]] = [-0.4, 0.4]
    assert any("left" in " ".join(p) and "right" in " ".join(p) for p in contacts(crossed))


@pytest.mark.parametrize(("first", "sign"), [(0, 1), (6, -1)])
def test_a_walking_leg_touches_nothing_but_perhaps_a_hand(first, sign):
    """Random poses of all six joints of one leg."""
    rng = np.random.default_rng(5)
    low = np.array([-0.1, -0.3, -1.2, -1.0, -0.6, -0.3])
    high = np.array([0.4, 0.3, 0.7, 1.0, 0.6, 0.3])
    for _ in range(200):
        q = np.zeros(16)
        q[first : first + 6] = sign * rng.uniform(low, high)
        touching = contacts(q)
        assert all(any("hand" in name for name in pair) for pair in touching), (q, touching)


def test_high_fidelity_parts_may_meet_the_floor_and_each_other():
    m = robot.load("high").mj_model
    floor = m.geom("floor").id
    parts = [i for i in np.flatnonzero(m.geom_contype) if i != floor]
    limbs = ("thigh", "shank", "foot", "upper_arm", "forearm", "hand")
    expected = {f"{side}_{limb}" for side in ("left", "right") for limb in limbs}
    assert {m.geom(i).name for i in parts} >= expected | {"torso", "pelvis", "head"}
    for i in parts:
        assert m.geom_contype[i] & m.geom_conaffinity[floor]
        assert all(m.geom_contype[i] & m.geom_conaffinity[j] for j in parts)


@pytest.mark.parametrize("fidelity", ["train", "high"])
def test_only_at_high_fidelity_a_fallen_robot_lies_on_its_trunk(fidelity):
    r = robot.load(fidelity)
    data = mujoco.MjData(r.mj_model)
    data.qpos[:] = r.default_qpos
    data.qpos[2:7] = 0.05, np.sqrt(0.5), 0, -np.sqrt(0.5), 0  # on its back
    mujoco.mj_forward(r.mj_model, data)
    trunk = {"torso", "pelvis"}
    met = trunk & {r.mj_model.geom(i).name for i in data.contact.geom.ravel()}
    assert met == (trunk if fidelity == "high" else set())


def test_high_fidelity_floor_meets_all_parts():
    lying = contacts(np.zeros(16), height=0.1)
    assert {frozenset(("floor", part)) for part in ("pelvis", "left_hand", "left_shank")} <= lying
    feet = contacts(np.zeros(16), height=0.88)
    assert feet == {frozenset(("floor", "left_foot")), frozenset(("floor", "right_foot"))}


@pytest.mark.parametrize("fidelity", ["train", "high"])
def test_stands_on_its_feet(fidelity):
    """Servos hold the zero pose for 0.3 s. The robot stays upright, and the impulse of the soles
    equals gravity's impulse plus the change of momentum."""
    r = robot.load(fidelity)
    data = mujoco.MjData(r.mj_model)
    data.qpos[:] = r.default_qpos
    data.qpos[2] = 0.885
    dt, impulse = r.mj_model.opt.timestep, 0.0
    for _ in range(round(0.3 / dt)):
        torque = motors.motor_torque(r, NOMINAL, data.qpos[7:], data.qvel[6:], np.zeros(16), np)
        data.ctrl[:] = motors.servo_control(r, torque, r.kd, data.qpos[7:], data.qvel[6:])
        mujoco.mj_step(r.mj_model, data)
        feet = (data.sensordata[r.sensor(f"{s}_foot_touch")][0] for s in ("left", "right"))
        impulse += dt * sum(feet)
    mujoco.mj_forward(r.mj_model, data)
    mujoco.mj_subtreeVel(r.mj_model, data)
    gained = 53.036 * (data.subtree_linvel[0, 2] + 9.81 * 0.3)
    assert data.qpos[2] > 0.8
    assert impulse == pytest.approx(gained, rel=0.01)


def test_mirrored_joints_give_the_mirrored_robot(xbot):
    """Each body is at (x, -y, z) of its partner, up to the left-right differences in the URDF."""
    permutation, sign = MIRROR
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


def test_mirrored_motion_is_the_mirror_image(xbot, poses):
    """The mirror negates y of velocities, x and z of angular velocities, and swaps joint limits."""
    permutation, sign = MIRROR
    np.testing.assert_array_equal(sign * xbot.joint_upper[permutation], xbot.joint_lower)
    m, rates = xbot.mj_model, np.random.default_rng(6).normal(size=(len(poses), 16))

    def velocity(q, dq, name):
        data, result = at_origin(m, q), np.zeros(6)
        data.qvel[6:] = dq
        mujoco.mj_forward(m, data)
        body = m.body(name).id
        mujoco.mj_objectVelocity(m, data, mujoco.mjtObj.mjOBJ_XBODY, body, result, 0)
        return result

    for q, dq in zip(poses, rates, strict=True):
        image = q[permutation] * sign, dq[permutation] * sign
        for link in ("ankle_roll_link", "knee_link", "elbow_pitch_link"):
            expected = velocity(q, dq, f"left_{link}") * [-1, 1, -1, 1, -1, 1]
            np.testing.assert_allclose(velocity(*image, f"right_{link}"), expected, atol=1e-3)
