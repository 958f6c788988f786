"""Robots from descriptions: XBot-L stays what it is, another MJCF becomes a model of the same kind.

The biped of tests/data is small, so that its numbers can be computed by hand.
"""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from packages import described

from kslc_jax import fingerprint, randomize, robot
from kslc_jax.robots import (
    anatomy,
    build,
    capsules,
    contacts,
    description,
    loops,
    shapes,
    soles,
)
from kslc_jax.robots.description import RobotError

DATA = Path(__file__).parent / "data"
BIPED = str(DATA / "biped.toml")
SHIPPED = [name for name in description.known() if name != "xbot_l"]
FIDELITIES = ("train", "high")

DRAWN = """<mujoco><worldbody>
<geom type="plane" size="1 1 1"/>
<geom type="plane" size="1 1 1" group="5"/>
<body><geom size="1"/><geom size="1" group="2"/><geom size="1" group="3"/>
  <body><geom size="1" group="3"/><geom size="1" group="4" rgba="1 1 1 0"/></body>
  <body/>
</body></worldbody></mujoco>"""

# Digests of the model before robots had descriptions; "more" and "options": of the fields below.
XBOT_L = {
    "train": {
        "inertias": "d658e9bf",
        "frames": "0e734614",
        "joint friction and damping": "d45c9b2b",
        "contact pairs": "3bf06b36",
        "sensors": "4820f5d1",
        "rest of the options": "588dd001",
        "shapes": "86292733",
        "solver": "90cc9b10",
        "more": "8c2a53af",
        "options": "a6ec99bd",
        "sizes of sites": "81ccf6b3",
        "springs and reference angles": "6a13f53a",
        "nonlinear damping": "fbad4669",
        "softness of joints": "67c671b7",
        "actuators": "9ad3574f",
        "equalities and tendons": "00000000",
        "gravity compensation": "700a059c",
        "objects of actuators and sensors": "4c7070f1",
        "adhesion": "63d87e7d",
        "meshes": "00000000",
        "further options": "8db36b3b",
        "measures": "614de5dc",
    },
    "high": {
        "inertias": "d658e9bf",
        "frames": "0e734614",
        "joint friction and damping": "e4518075",
        "contact pairs": "f1a4646a",
        "sensors": "4820f5d1",
        "rest of the options": "588dd001",
        "shapes": "c4d53054",
        "solver": "3a28c2bd",
        "more": "c0f5b68a",
        "options": "8103f9df",
        "sizes of sites": "81ccf6b3",
        "springs and reference angles": "6a13f53a",
        "nonlinear damping": "fbad4669",
        "softness of joints": "67c671b7",
        "actuators": "9ad3574f",
        "equalities and tendons": "00000000",
        "gravity compensation": "700a059c",
        "objects of actuators and sensors": "4c7070f1",
        "adhesion": "e43a66d2",
        "meshes": "00000000",
        "further options": "8db36b3b",
        "measures": "614de5dc",
    },
}
MORE = (
    *("qpos0", "key_qpos", "key_ctrl", "jnt_range", "jnt_limited", "dof_armature", "body_mass"),
    *("body_pos", "body_quat", "actuator_trnid", "actuator_gaintype", "actuator_biastype"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange"),
    *("actuator_gear", "site_size", "geom_rgba", "geom_group", "geom_matid", "mat_rgba"),
    *("cam_pos", "light_pos", "light_dir"),
)
OPTIONS = ("timestep", "iterations", "ls_iterations")


def model(name: str, fidelity: str = "train") -> mujoco.MjModel:
    return build.spec(described(name), fidelity).compile()


def studied(about: description.Description) -> anatomy.Anatomy:
    m = build.spec(about, "train").compile()
    return anatomy.study(m, home(m))


def home(m: mujoco.MjModel) -> np.ndarray:
    return m.key("home").qpos.copy()


@pytest.fixture(scope="module", params=SHIPPED)
def shipped(request) -> dict[str, mujoco.MjModel]:
    return {fidelity: model(request.param, fidelity) for fidelity in FIDELITIES}


@pytest.fixture(scope="module")
def biped() -> dict[str, mujoco.MjModel]:
    return {fidelity: model(BIPED, fidelity) for fidelity in FIDELITIES}


# ---------------------------------------------------------------------------------------- XBot-L


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_xbot_l_is_the_same(fidelity):
    m = model("xbot_l", fidelity)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # as robot.load
    robot = SimpleNamespace(
        mj_model=m,
        stand_height=0.89,
        sole_drop=0.05,
        default_qpos=m.keyframe("home").qpos,
        hand_points=np.zeros((2, 3)),
    )
    digests = fingerprint._digests(robot)
    digests["more"] = fingerprint._digest([getattr(m, field) for field in MORE])
    digests["options"] = fingerprint._digest([np.asarray(getattr(m.opt, f)) for f in OPTIONS])
    assert digests == XBOT_L[fidelity]
    np.testing.assert_array_equal(m.numeric("speed_limit").data, [12] * 12 + [7] * 4)
    assert (m.numeric("stand_height").data, m.numeric("sole_drop").data) == (0.89, 0.05)


def test_xbot_l_anatomy():
    m = model("xbot_l")
    a = anatomy.study(m, home(m))
    np.testing.assert_array_equal(a.permutation, [*range(6, 12), *range(6), 14, 15, 12, 13])
    np.testing.assert_array_equal(a.sign, -np.ones(16))
    names = {role: m.joint(1 + joint).name for role, joint in a.roles.items()}
    roles = ("leg_pitch", "knee", "ankle_pitch", "leg_roll", "leg_yaw")
    roles = dict(zip(("hip", "knee", "ankle", "hip_roll", "hip_yaw"), roles, strict=True))
    roles |= {"shoulder": "shoulder_pitch", "elbow": "elbow_pitch"}
    expected = {f"{s}_{r}": f"{s}_{n}_joint" for s in ("left", "right") for r, n in roles.items()}
    assert names == expected
    assert [m.body(foot).name for foot in a.feet] == [
        f"{s}_ankle_roll_link" for s in ("left", "right")
    ]
    assert (a.trunk, a.base) == (1, 1)
    np.testing.assert_array_equal(a.is_arm, [False] * 12 + [True] * 4)
    np.testing.assert_array_equal(a.pitch[:6], [0, 0, 1, -1, 1, 0])


# ----------------------------------------------------------------------------- the biped, by hand


def test_biped_mirror_and_roles(biped):
    m = biped["train"]
    a = anatomy.study(m, home(m))
    np.testing.assert_array_equal(a.permutation, [0, 5, 6, 7, 8, 1, 2, 3, 4])
    np.testing.assert_array_equal(a.sign, [-1, 1, 1, -1, 1, 1, 1, -1, 1])
    np.testing.assert_array_equal(a.pitch, [0, 0, 1, 1, 1, 0, 1, -1, 1])
    left = {"left_hip": 2, "left_knee": 3, "left_ankle": 4, "left_hip_roll": 1}
    right = {"right_hip": 6, "right_knee": 7, "right_ankle": 8, "right_hip_roll": 5}
    assert a.roles == left | right
    assert a.limbs == {"left_leg": (1, 2, 3, 4), "right_leg": (5, 6, 7, 8)}
    assert [m.body(foot).name for foot in a.feet] == ["port_keel", "star_keel"]
    assert m.body(a.trunk).name == "crow"
    assert not a.is_arm.any()


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_biped_heights_and_soles(biped, fidelity):
    m = biped[fidelity]
    stand = 0.1 + 2 * 0.25 * np.cos(0.5) + 0.04  # hip below the base, thigh and shank, sole
    assert m.numeric("stand_height").data[0] == pytest.approx(stand, abs=1e-6)
    assert m.numeric("sole_drop").data[0] == pytest.approx(0.04, abs=1e-6)
    data = posed(m, home(m))
    clearance = home(m)[2] - stand
    assert clearance == pytest.approx(stand * (0.95 - 0.885256) / 0.885256, rel=2e-3)  # XBot-L's
    for side, y in (("left", 0.1), ("right", -0.1)):
        site = m.site(f"{side}_foot")
        np.testing.assert_allclose(site.size, [0.088, 0.038, 0.012], atol=1e-6)
        np.testing.assert_allclose(data.site(site.id).xpos, [0.02, y, clearance], atol=1e-6)
        spheres = [data.geom(f"{side}_{c}").xpos for c in ("toe_l", "toe_r", "heel_l", "heel_r")]
        corners = [(0.095, 0.025), (0.095, -0.025), (-0.055, 0.025), (-0.055, -0.025)]
        expected = [[x, y + dy, clearance + 0.005] for x, dy in corners]
        np.testing.assert_allclose(spheres, expected, atol=1e-6)
    scale = stand / 0.89
    np.testing.assert_allclose(m.site("torso_box").size, 0.2 * scale)
    np.testing.assert_allclose(m.site("torso_box").pos, [0, 0, 0.1 * scale])


def test_biped_servos(biped):
    m = biped["train"]
    joints = [m.joint(1 + i).name for i in range(m.nu)]
    assert [m.actuator(i).name for i in range(m.nu)] == joints
    assert joints[:3] == ["mast", "port_cant", "port_sheet"]
    np.testing.assert_array_equal(m.actuator_gainprm[:, 0], [80, *[60, 80, 80, 8] * 2])
    np.testing.assert_array_equal(m.actuator_biasprm[:, 1], -m.actuator_gainprm[:, 0])
    np.testing.assert_array_equal(m.actuator_biasprm[:, 2], [-3, *[-2, -3, -3, -1] * 2])
    np.testing.assert_array_equal(m.actuator_forcerange[:, 1], [60, *[30, 60, 60, 60] * 2])
    np.testing.assert_array_equal(m.numeric("speed_limit").data, [15] * 9)
    assert not m.dof_frictionloss.any()
    np.testing.assert_array_equal(biped["high"].dof_frictionloss[6:], [0.2] * 9)
    for each in biped.values():
        np.testing.assert_array_equal(each.dof_damping[6:], [0.1] * 9)
        np.testing.assert_array_equal(each.dof_armature[6:], [0.01] * 9)


def test_motors_at_high_fidelity(tmp_path):
    about = edited(
        tmp_path,
        toml='\n[config]\n"gait.reference_scale" = 0.2\n',
        motor="friction = 0.5, damping = 0.7, armature = 0.02",
    )
    for fidelity, friction, damping in (("train", 0, 0.1), ("high", 0.5, 0.7)):
        m = build.spec(about, fidelity).compile()
        np.testing.assert_array_equal(m.dof_frictionloss[6:], [friction] * 9)
        np.testing.assert_array_equal(m.dof_damping[6:], [damping] * 9)
        np.testing.assert_array_equal(m.dof_armature[6:], [0.02] * 9)
    assert about.config == (("gait.reference_scale", 0.2),)
    assert hash(about)


def posed(m: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(m)
    data.qpos[:] = qpos
    mujoco.mj_forward(m, data)
    return data


def inertia(m: mujoco.MjModel, data: mujoco.MjData, joints: list[str]) -> np.ndarray:
    """The mass matrix at rest of the base and the named joints."""
    full = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, full)
    rows = [*range(6), *(int(m.joint(name).dofadr[0]) for name in joints)]
    return full[np.ix_(rows, rows)]


@pytest.mark.parametrize("weld", [[], ["mast"], ["cant"]])
def test_the_rebuilt_robot_moves_as_its_mjcf(tmp_path, weld):
    about = edited(tmp_path, toml=f"weld = {weld}\n", front=True)
    original = mujoco.MjModel.from_xml_path(str(about.mjcf))
    rebuilt = build.spec(about, "train").compile()
    joints = [rebuilt.joint(1 + i).name for i in range(rebuilt.nu)]
    assert len(joints) == 9 - 2 * (weld == ["cant"]) - (weld == ["mast"])
    qpos = original.key("bent").qpos.copy()
    qpos[2] = home(rebuilt)[2]
    before, after = posed(original, qpos), posed(rebuilt, home(rebuilt))
    np.testing.assert_allclose(
        inertia(rebuilt, after, joints), inertia(original, before, joints), atol=1e-9
    )
    np.testing.assert_allclose(
        after.body("port_keel").xpos, before.body("port_keel").xpos, atol=1e-9
    )


# ------------------------------------------------------------------------------- contacts of parts


def test_parts_and_pairs(biped):
    m = biped["train"]
    assert m.npair == 13
    feet = {m.geom(f"{side}_foot_bumper").id for side in ("left", "right")}
    for a, b, dim in zip(m.pair_geom1, m.pair_geom2, m.pair_dim, strict=True):
        assert dim == (3 if {a, b} == feet else 1)
    np.testing.assert_array_equal(m.pair_margin, contacts.PAIR_MARGIN)
    assert m.numeric("max_contact_points").data[0] == contacts.PAIR_CONTACTS
    assert m.nmesh == 0


def test_capsules_fit():
    angle = 2 * np.pi * np.arange(60) / 60
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * 0.04
    points = np.concatenate([circle + np.array([0.1, 0.2, z]) for z in np.linspace(0, 0.5, 41)])
    capsule = capsules.fit(points)
    assert capsule.radius == pytest.approx(0.04, abs=0.004)
    np.testing.assert_allclose(
        np.mean([capsule.start, capsule.end], axis=0), [0.1, 0.2, 0.25], atol=1e-3
    )
    ends = sorted([capsule.start[2], capsule.end[2]])
    beyond = points[:, 2] - np.clip(points[:, 2], *ends)
    assert np.mean(np.hypot(0.04, beyond) <= capsule.radius) == pytest.approx(0.9, abs=0.03)


def test_hips_count_unless_they_are_wide():
    rng = np.random.default_rng(0)
    thigh = rng.uniform([-0.04, 0.06, -0.4], [0.04, 0.14, 0.0], (4000, 3))
    plain = capsules.fit_all({"left_thigh": thigh, "right_thigh": thigh * [1, -1, 1]})
    for half_width, own in ((0.05, False), (0.2, True)):
        size = np.array([half_width, half_width, 0.05])
        hip = rng.uniform(-size, size, (4000, 3)) + np.array([0, 0.1, 0])
        clouds = {"left_hip": hip, "left_thigh": thigh}
        clouds |= {"right_hip": hip * [1, -1, 1], "right_thigh": thigh * [1, -1, 1]}
        fitted = capsules.fit_all(clouds)
        assert (set(fitted) == set(clouds)) is own
        assert (fitted["left_thigh"].radius == plain["left_thigh"].radius) is own
        np.testing.assert_array_equal(
            fitted["right_thigh"].start, fitted["left_thigh"].start * [1, -1, 1]
        )


def test_slim_capsules_leave_the_margin():
    def leg(y: float, radius: float) -> capsules.Capsule:
        return capsules.Capsule(np.array([0, y, 0.0]), np.array([0, y, 0.3]), radius)

    slim = capsules.slim({"left_shank": leg(0.05, 0.06), "right_shank": leg(-0.05, 0.06)})
    assert capsules.gap(*slim.values()) == pytest.approx(contacts.PAIR_MARGIN, abs=1e-6)
    same_limb = {"left_shank": leg(0.05, 0.06), "left_thigh": leg(0.05, 0.06)}
    assert capsules.slim(same_limb)["left_shank"].radius == 0.06


def sides(m: mujoco.MjModel, qpos: np.ndarray, depth: float) -> bool:
    """True if a part of the left leg is nearer than `depth` [m] to one of the right leg."""
    data = posed(m, qpos)
    a = anatomy.study(m, home(m))
    legs = {m.jnt_bodyid[1 + j]: name for name, limb in a.limbs.items() for j in limb}
    near = data.contact.geom[data.contact.dist < depth]
    return any(
        {"left_leg", "right_leg"} <= {legs.get(m.geom_bodyid[g]) for g in pair} for pair in near
    )


def test_training_feels_legs_that_touch(biped):
    train, high = biped["train"], biped["high"]
    rng = np.random.default_rng(0)
    low, upper = train.jnt_range[1:].T
    touching = felt = 0
    for _ in range(400):
        qpos = home(train)
        qpos[2] = 5.0
        qpos[7:] = rng.uniform(np.maximum(low, -1), np.minimum(upper, 1))
        qpos[[8, 12]] = rng.uniform(-0.4, 0.0, 2)  # legs inwards
        if sides(high, qpos, 0.0):
            touching += 1
            felt += sides(train, qpos, contacts.PAIR_MARGIN)
    assert touching >= 40
    assert felt >= 0.9 * touching


# ------------------------------------------------------------------------------- shipped robots


def check_mirrored_kinematics(m: mujoco.MjModel) -> None:
    a = anatomy.study(m, home(m))
    np.testing.assert_array_equal(a.permutation[a.permutation], np.arange(m.nu))
    np.testing.assert_array_equal(a.sign[a.permutation], a.sign)
    rng = np.random.default_rng(0)
    for _ in range(5):
        qpos = home(m)
        qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        angles = qpos[7:] + rng.uniform(-0.3, 0.3, m.nu)
        mirrored = angles[a.permutation] * a.sign
        places = []
        for q in (angles, mirrored):
            qpos[7:] = q
            places.append(posed(m, qpos).xpos[list(a.feet)])
        np.testing.assert_allclose(places[1], places[0][::-1] * [1, -1, 1], atol=1e-5)


def check_stands(m: mujoco.MjModel) -> None:
    """Falls on its soles from the home keyframe, and its servos hold the joints near home."""
    data = posed(m, home(m))
    assert not (data.contact.dist < 0).any()
    data.ctrl[:] = data.qpos[7:]
    for _ in range(round(0.2 / m.opt.timestep)):
        mujoco.mj_step(m, data)
    assert np.abs(data.qpos - home(m))[7:].max() < 0.4
    assert np.abs(data.qvel).max() < 20
    weight = 9.81 * m.body_mass.sum()
    feet = [data.sensor(f"{side}_foot_touch").data[0] for side in ("left", "right")]
    assert sum(feet) > 0.3 * weight
    assert min(feet) > 0.8 * max(feet)


def check_named_parts(m: mujoco.MjModel, high: bool) -> None:
    """Everything that the package reads by name, in the order of the joints."""
    names = [m.joint(i).name for i in range(1, m.njnt)]
    assert [m.actuator(i).name for i in range(m.nu)] == names
    xbot = model("xbot_l")
    for i in range(xbot.nsensor):
        assert m.sensor(xbot.sensor(i).name).type == xbot.sensor(i).type
    for name in ("speed_limit", "stand_height", "sole_drop"):
        assert (m.numeric(name).data > 0).all()
    assert m.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert m.camera("track") and m.light("sun") and m.site("torso_box")
    feet = set(anatomy.study(m, home(m)).feet)
    firm = m.geom_priority > 0
    assert set(m.geom_bodyid[firm]) == feet
    spheres = np.array(
        [m.geom(i).name.endswith(("toe_l", "toe_r", "heel_l", "heel_r")) for i in range(m.ngeom)]
    )
    assert spheres.sum() == 8 and firm[spheres].all()
    assert (m.geom_contype[spheres] == (0 if high else 1)).all()
    if high:
        assert (m.geom_contype[firm & ~spheres] & contacts.FLOOR_BIT).all()
    else:
        np.testing.assert_array_equal(firm, spheres)
        assert m.nmesh == 0 and not m.geom_contype[~spheres].any()


def names_of_geoms(m: mujoco.MjModel) -> list[str]:
    return [m.geom(i).name for i in range(m.ngeom)]


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_biped_is_complete(biped, fidelity):
    check_named_parts(biped[fidelity], fidelity == "high")
    check_mirrored_kinematics(biped[fidelity])
    check_stands(biped[fidelity])


def test_shipped_robots(shipped):
    train, high = shipped["train"], shipped["high"]
    for fidelity, m in shipped.items():
        check_named_parts(m, fidelity == "high")
        check_mirrored_kinematics(m)
        check_stands(m)
    a = anatomy.study(train, home(train))
    arms = "left_arm" in a.limbs
    hips = any(name.endswith("hip_bumper") for name in names_of_geoms(train))
    assert train.npair == {(True, False): 43, (True, True): 58, (False, False): 13}[arms, hips]
    assert {
        f"{s}_{r}" for s in ("left", "right") for r in ("hip", "knee", "ankle")
    } <= a.roles.keys()
    assert ("left_shoulder" in a.roles, "left_elbow" in a.roles) == (arms, arms)
    np.testing.assert_array_equal(home(train), home(high))
    np.testing.assert_allclose(train.body_mass, high.body_mass)
    bent = abs(home(train)[7:][a.roles["left_knee"]])
    assert 0.8 <= bent <= 1.1  # XBot-L: 1.05


def test_welds_keep_the_mass(shipped):
    m = shipped["train"]
    original = mujoco.MjModel.from_xml_path(str(description.read(name_of(m)).mjcf))
    assert m.body_subtreemass[1] == pytest.approx(original.body_subtreemass[1])


def name_of(m: mujoco.MjModel) -> str:
    return m.names[: m.names.index(b"\0")].decode()


# --------------------------------------------------------------------------------- descriptions


def edited(
    folder: Path,
    toml: str = "",
    front: bool = False,
    motor: str = "",
    xml: tuple[tuple[str, str], ...] = (),
    weld: str = "",
) -> description.Description:
    """The biped's description with lines added, and its MJCF with a text replaced."""
    text = (DATA / "biped.toml").read_text()
    text = toml + text if front else text + toml
    text = f'weld = ["{weld}"]\n' + text if weld else text
    text = text.replace("speed = 15", f"speed = 15, {motor}") if motor else text
    mjcf = (DATA / "biped.xml").read_text()
    for old, new in xml:
        assert old in mjcf
        mjcf = mjcf.replace(old, new)
    (folder / "biped.xml").write_text(mjcf)
    (folder / "biped.toml").write_text(text)
    return description.read(str(folder / "biped.toml"))


@pytest.mark.parametrize("second", ['<velocity joint="mast" kv="3" gear="2"/>', ""])
def test_position_and_velocity_actuators_of_a_joint_add_up(tmp_path, second):
    """80 N m/rad and 1 N m s/rad, and from the second one 3 * 2^2."""
    two = '<position joint="mast" kp="80" kv="1"/>' + second
    about = edited(tmp_path, xml=(('<position joint="mast"/>', two),))
    model = build.spec(about, "train").compile()
    mast = model.actuator("mast")
    assert mast.gainprm[0] == 80.0
    assert -mast.biasprm[2] == (13.0 if second else 1.0)


DESCRIPTIONS = {
    "unknown field": ('motor = 1\nmjcf = "biped.xml"', "unknown field 'motor' (closest: motors)"),
    "no mjcf": ("weld = []", "mjcf is missing"),
    "no file": ('mjcf = "other.xml"', "no such file"),
    "no package": ('mjcf = "nobody_has_this:robot.xml"', "pip install nobody-has-this"),
    "not TOML": ("mjcf = ", "not TOML"),
    "motor field": ('mjcf = "biped.xml"\n[motors]\nx = { kpp = 1 }', "(closest: kp)"),
    "motor value": (
        'mjcf = "biped.xml"\n[motors]\nx = { kp = "a" }',
        "motors.x.kp must be a number",
    ),
    "motor sign": (
        'mjcf = "biped.xml"\n[motors]\nx = { effort = 0 }',
        "motors.x.effort must be above 0",
    ),
    "motor table": ('mjcf = "biped.xml"\n[motors]\nx = 3', "motors.x must be a table"),
    "home value": ('mjcf = "biped.xml"\n[home]\nx = true', "home.x must be a number"),
    "weld value": ('mjcf = "biped.xml"\nweld = "x"', "weld must be a list of patterns"),
    "pattern": ('mjcf = "biped.xml"\nweld = ["("]', "not a regular expression"),
    "height": ('mjcf = "biped.xml"\nstand_height = -1', "stand_height must be above 0"),
    "prepared": ('mjcf = "biped.xml"\nprepared = 1', "prepared must be true or false"),
}


@pytest.mark.parametrize("case", DESCRIPTIONS)
def test_refused_descriptions(tmp_path, case):
    text, message = DESCRIPTIONS[case]
    (tmp_path / "biped.xml").write_text("<mujoco/>")
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(RobotError) as refused:
        description.read(str(path))
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_refused_names(tmp_path):
    with pytest.raises(RobotError, match=r"closest: unitree_g1.*shipped: .*xbot_l"):
        description.read("unitree_g2")
    with pytest.raises(RobotError, match="no such file"):
        description.read(str(tmp_path / "robot.toml"))


def test_a_model_is_no_description(tmp_path):
    """The message has the lines to write, and they work."""
    with pytest.raises(RobotError, match="an MJCF needs a description") as refused:
        description.read("my/biped.xml")
    lines = re.search(
        "write three lines to (.*) beside it, (.*) and (.*) and (.*) .rad/s", str(refused.value)
    )
    assert lines
    (tmp_path / lines[1]).write_text("\n".join(lines.groups()[1:]))
    (tmp_path / "biped.xml").write_text((DATA / "biped.xml").read_text())
    with pytest.raises(RobotError, match="joints 'port_cant', 'star_cant': no kp, kd; add"):
        build.spec(description.read(str(tmp_path / lines[1])), "train")
    (tmp_path / "ship.urdf").write_text("")
    (tmp_path / "ship.toml").write_text('mjcf = "ship.urdf"')
    for name in (str(tmp_path / "ship.urdf"), str(tmp_path / "ship.toml")):
        with pytest.raises(RobotError, match=r"ship\.urdf: a URDF must become an MJCF first"):
            description.read(name)


FREE = "<freejoint/>"
SHOE = '<geom name="left_foot" type="box" size="0.08 0.03 0.01" pos="0.02 0 -0.03"/>'
MASS = '<inertial pos="0 0 0" mass="0.4" diaginertia="0.001 0.001 0.001"/>'
EQUALITY = '<equality><joint joint1="mast" joint2="port_cant"/></equality>\n  <actuator>'
TENDON = '<tendon><fixed><joint joint="mast" coef="1"/></fixed></tendon>\n  <actuator>'
BUOY = """<body name="buoy" pos="3 0 1">
  <joint name="hinge" axis="0 1 0"/><geom size="0.1"/>
</body></worldbody>"""
TRUNK = '<geom type="box" size="0.06 0.1 0.12" pos="0 0 0.14" mass="6"/>'
ADDED, MOTOR = "davit|hook|ear", "{ kp = 20, kd = 1, effort = 20 }"
TILTED = ("0 0 0.6 1 0 0 0", f"0 0 0.6 {np.cos(0.1)} 0 {np.sin(0.1)} 0")  # by 0.2 rad about y


def hinged(name: str, place: str, inside: str = "") -> str:
    """A body with one joint, and with others inside it."""
    joint = f'<joint name="{name}" axis="0 1 0"/><geom size="0.02"/>'
    return f'<body name="{name}" pos="{place}">{joint}{inside}</body>'


def arms(*hooks: str, ears: bool = False) -> dict[str, str | tuple]:
    """Changes that give the biped two arms, which end in these hooks, and two ears."""
    both = ""
    for side, y in (("port", 0.15), ("star", -0.15)):
        ends = "".join(hinged(f"{side}_{x}", f"{i / 10} 0 -0.2") for i, x in enumerate(hooks))
        both += hinged(f"{side}_davit", f"0 {y} 0.2", ends)
        both += hinged(f"{side}_ear", f"0 {y / 2} 0.3") if ears else ""
    zeros = "0 " * both.count("<joint")
    key = ("0  0 -0.2 1", f"0  {zeros} 0 -0.2 1")
    return {"xml": ((TRUNK, TRUNK + both), key), "toml": f'"{ADDED}" = {MOTOR}\n'}


def tied(weld: str, *joints: str) -> dict[str, str | tuple]:
    """Changes that give the biped arms with two hooks, and that couple two joints of them: by an
    equality constraint, and by a tendon. The joints that match `weld` are welded."""
    one, two = joints
    equal = f'<equality><joint joint1="{one}" joint2="{two}"/></equality>'
    coupled = "".join(f'<joint joint="{name}" coef="1"/>' for name in joints)
    tendon = f"<tendon><fixed>{coupled}</fixed></tendon>\n  <actuator>"
    made = arms("hook_a", "hook_b")
    return made | {"xml": (*made["xml"], ("<actuator>", equal + tendon)), "weld": weld}


MAST, NOD = '<joint name="mast" axis="0 0 1"/>', '<joint name="nod" axis="0 1 0"/>'
BALL = '<geom name="left_foot" type="sphere" size="0.04" pos="0 0 -0.03"/>'
ROUND = '<geom type="capsule" fromto="-0.05 0 -0.03 0.09 0 -0.03" size="0.03"/>'
ROBOTS = {
    "no free joint": ({"xml": ((FREE, ""), ("0 0 0.6 1 0 0 0", ""))}, "put <freejoint/>"),
    "slide": ({"xml": (('"mast" axis', '"mast" type="slide" axis'),)}, "joint 'mast' is no hinge"),
    "no range": ({"xml": ((' range="-1.6 1.6"', ""),)}, "joint 'mast' has no range: add range"),
    "equality": ({"xml": (("<actuator>", EQUALITY),)}, "equality constraints (closed loops)"),
    "tendon": ({"xml": (("<actuator>", TENDON),)}, "tendons (closed loops)"),
    "broken": ({"xml": (("<actuator>", "<actuators>"),)}, "biped.xml: XML"),
    "no partner": (
        {"toml": "[home]\nport_sheet = -0.3\n"},
        "'port_lock' has no left-right partner",
    ),
    "two pitch joints": (
        {"toml": 'weld = ["rudder"]\n', "front": True},
        "has 2 pitch joints (port_sheet",
    ),
    "not level": ({"toml": "[home]\nrudder = -0.3\n"}, "joint 'port_rudder' is not level at home"),
    "how to level": ({"toml": "[home]\nrudder = -0.3\n"}, "add -0.200 rad to that joint"),
    "ball": ({"xml": ((SHOE, BALL),)}, "below joint 'port_rudder' is round: turned in any way"),
    "capsule": ({"xml": ((SHOE, ROUND),)}, "add a box as its sole"),
    "straightened": (
        {"xml": (TILTED, ("1 -0.5", "1 -0.7"))},
        "(the keyframe's base is tilted by 0.20 rad; here it is upright)",
    ),
    "forked arms": (
        arms("hook_a", "hook_b"),
        "'port_davit' forks, into port_hook_a, port_hook_b: weld all of these branches",
    ),
    "ears": (
        arms("hook", ears=True),
        "joints 'port_ear' and 'star_ear' are in no leg and no arm: weld them",
    ),
    "coupled to a joint that stays": (
        tied("hook", "port_davit", "port_hook_a"),
        "equality constraints (closed loops) are not supported",
    ),
    "no shoe": ({"xml": ((SHOE, MASS),)}, "the foot below joint 'port_rudder' has no shapes"),
    "no gains": (
        {"xml": (('<position joint="mast"/>', ""),)},
        "joint 'mast': no kp, kd, effort",
    ),
    "line to add": (
        {"xml": (('<position joint="mast"/>', ""),)},
        '"^(mast)$" = { kp = ..., kd = ..., ',
    ),
    "home pattern": (
        {"toml": "[home]\nelbow = 1\n"},
        "home: 'elbow' matches no joint; there are mast",
    ),
    "weld pattern": (
        {"toml": 'weld = ["wrist"]\n', "front": True},
        "weld: 'wrist' matches no joint",
    ),
    "motor pattern": ({"toml": '"toe" = { kp = 1 }\n'}, "motors: 'toe' matches no joint"),
    "keyframe": ({"toml": 'keyframe = "up"\n', "front": True}, "no 'up' in biped.xml; it has bent"),
    "range": (
        {"toml": "[home]\nlock = 2.5\n"},
        "2.5 rad is outside the range of joint 'port_lock'",
    ),
    "on its side": (
        {"xml": (("0 0 0.6 1 0 0 0", "0 0 0.6 1 1 0 0"),)},
        "the base lies on its side",
    ),
    "no pair of legs": (
        {"toml": 'weld = ["cant", "sheet", "lock", "rudder"]\n', "front": True},
        "found no pair of legs",
    ),
    "four pitch joints": (
        {"xml": (('axis="1 0 0"', 'axis="0 1 0"'), ('axis="-1 0 0"', 'axis="0 1 0"'))},
        "has 4 pitch joints (port_cant",
    ),
    "a joint elsewhere": (
        {"xml": (("</worldbody>", BUOY), ("0 -0.2 -1 -0.5", "0 -0.2 -1 -0.5 0"))},
        "joint 'hinge' is not on the robot",
    ),
    "half a body welded": (
        {
            "xml": ((MAST, MAST + NOD), ("0  0 -0.2 1", "0 0  0 -0.2 1")),
            "toml": 'weld = ["nod"]\n',
            "front": True,
        },
        "body 'crow' has several joints: weld all of them, or none",
    ),
    "tilted to the side": (
        {"xml": ((SHOE, SHOE.replace("pos", 'quat="0.995 0.0998 0 0" pos')),)},
        "or turn the foot's roll joint",
    ),
    "prepared": (
        {"toml": 'prepared = true\nweld = ["mast"]\n', "front": True},
        "weld: not with prepared",
    ),
}


def test_all_missing_values_of_motors_are_told_at_once(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(f"mjcf = '{BIPED.replace('.toml', '.xml')}'")
    with pytest.raises(RobotError) as refused:
        build.spec(description.read(str(path)), "train")
    assert str(refused.value).endswith(
        "joints 'port_cant', 'star_cant': no kp, kd, speed; add under [motors]: "
        '"^(mast|port_sheet|port_lock|port_rudder|star_sheet|star_lock|star_rudder)$" = '
        '{ speed = ... } and "^(port_cant|star_cant)$" = { kp = ..., kd = ..., speed = ... }'
    )


@pytest.mark.parametrize("case", ROBOTS)
def test_refused_robots(tmp_path, case):
    changes, message = ROBOTS[case]
    about = edited(tmp_path, **changes)
    with pytest.raises(RobotError) as refused:
        build.spec(about, "train")
    assert message in str(refused.value)
    assert str(tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_arm_may_fork_where_it_is_welded(tmp_path):
    """One hook of each hand is left: it is part of the arm."""
    a = studied(edited(tmp_path, **arms("hook_a", "hook_b"), weld="hook_b"))
    assert a.limbs["left_arm"] == (1, 2) and a.limbs["right_arm"] == (3, 4)


def test_what_couples_welded_joints_only_is_ignored(tmp_path):
    about = edited(tmp_path, **tied("hook", "port_hook_a", "port_hook_b"))
    m = build.spec(about, "high").compile()
    assert (m.neq, m.ntendon, m.nu) == (0, 0, 11)


ROPE = '<spatial><site site="s"/><geom geom="g"/><site site="t"/></spatial>'
LINEAR = '<fixed name="f"><joint joint="j" coef="1"/></fixed>'
LOOPS = {
    "one joint": ('<joint joint1="k"/>', "", (True, False, False)),
    "two joints": ('<joint joint1="j" joint2="k"/>', "", (True, True, False)),
    "two sites": ('<connect site1="s" site2="t"/>', "", (True, False, False)),
    "two bodies": ('<weld body1="a" body2="b"/>', "", (True, False, False)),
    "the world": ('<connect body1="a" anchor="0 0 0"/>', "", (True, True, True)),
    "a tendon": ('<tendon tendon1="f"/>', LINEAR, (True, True, False)),
    "a rope": ("", ROPE, (True, False, False)),
}


@pytest.mark.parametrize("case", LOOPS)
def test_constraints_bind_what_moves(case):
    """b turns on a by k, a on the free base by j: nothing is welded, then k, then both."""
    equality, tendon, binds = LOOPS[case]
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body><freejoint/><geom size="0.1"/>
        <body name="a"><joint name="j"/><geom size="0.1"/><site name="s"/>
          <body name="b"><joint name="k"/><geom name="g" size="0.1"/><site name="t" pos="0 0 1"/>
      </body></body></body></worldbody>
      <tendon>{tendon}</tendon><equality>{equality}</equality></mujoco>""")
    welds = (frozenset(w) for w in ((), (2,), (1, 2)))
    assert tuple(bool(loops.found(model, weld)) for weld in welds) == binds


@pytest.mark.parametrize(
    "kind", ["box", "rounded box", "ball", "capsule", "cylinder", "tilted box"]
)
def test_round_feet_are_told_from_flat_ones(kind):
    """A sole that is flat, but not level, is no round one, and an edge may be rounded."""
    shapes_of = {"ball": ("sphere", "0.05"), "capsule": ("capsule", "0.03 0.07")}
    shapes_of["cylinder"] = ("cylinder", "0.03 0.07")
    geom, size = shapes_of.get(kind, ("box", "0.1 0.04 0.02"))
    turn = {"capsule": 1.5708, "cylinder": 1.5708, "tilted box": 0.2}.get(kind, 0)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody><geom type="{geom}" size="{size}" '
        f'euler="0 {turn} 0"/></worldbody></mujoco>'
    )
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.geom_quat[0])
    points = shapes.points(model, 0) @ frame.reshape(3, 3).T
    if kind == "rounded box":
        points = np.clip(points, [-0.09, -0.03, -0.01], [0.09, 0.03, 0.01])
        points = points + 0.01 * np.sign(points) / 3**0.5
    said = {"box": "", "rounded box": "", "tilted box": "not level"}.get(kind, "is round")
    try:
        soles.find(points, "ankle", 1.0)
        assert not said
    except RobotError as error:
        assert said and said in str(error)


def test_bodies_with_several_joints(tmp_path):
    """Two joints move each boom; each link differs from its description once."""
    joint = '<joint name="{}_cant" axis="{} 0 0" range="-0.4 0.6"/>'
    twist = '<joint name="{}_twist" axis="0 0 {}"/>'
    sides = (("port", 1), ("star", -1))
    both = [(joint.format(*s), joint.format(*s) + twist.format(*s)) for s in sides]
    key = ("0  0 -0.2 1 -0.5  0 -0.2", "0  0 0 -0.2 1 -0.5  0 0 -0.2")
    motor = f'"twist" = {MOTOR}\n'
    edited(tmp_path, xml=(*both, key), toml=motor)
    it = robot.load(name=str(tmp_path / "biped.toml"))
    assert it.count == 11 and len(it.link_body_ids) == 10
    names = [it.mj_model.body(i).name for i in it.joint_body_ids]
    assert names[1:3] == ["port_boom", "port_boom"] and names[3] == "port_spar"
    heavier = randomize.nominal(it)
    heavier = heavier.replace(link_mass=1.1 * heavier.link_mass)
    assert float(randomize.total_mass(it, heavier)) == pytest.approx(1.1 * it.total_mass)
    assert {it.anatomy.roles[f"left_{r}"] for r in ("hip_roll", "hip_yaw")} == {1, 2}


def test_menagerie_is_looked_for_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr(description, "_package", lambda name: None)
    monkeypatch.delenv(description.MENAGERIE_ROOT, raising=False)
    path = tmp_path / "robot.toml"
    path.write_text('mjcf = "menagerie:ship/biped.xml"')
    with pytest.raises(RobotError, match=r"pip install mujoco-menagerie.*--no-deps envpool-assets"):
        description.read(str(path))
    (tmp_path / "ship").mkdir()
    (tmp_path / "ship" / "biped.xml").write_text("<mujoco/>")
    monkeypatch.setenv(description.MENAGERIE_ROOT, str(tmp_path))
    assert description.read(str(path)).mjcf == tmp_path / "ship" / "biped.xml"


def test_a_robot_of_menagerie_is_downloaded_and_what_fails_is_one_line(tmp_path, monkeypatch):
    class MenagerieError(Exception):
        """As the package has it."""

    def get(name):
        if name == "lost":
            raise MenagerieError("no network:\ntry again")
        return SimpleNamespace(path=lambda: tmp_path / name)

    there = SimpleNamespace(get=get, MenagerieError=MenagerieError)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", there)
    known = {"mujoco_menagerie": tmp_path}
    monkeypatch.setattr(description, "_package", known.get)
    monkeypatch.delenv(description.MENAGERIE_ROOT, raising=False)
    (tmp_path / "ship").mkdir()
    (tmp_path / "ship" / "biped.xml").write_text("<mujoco/>")
    path = tmp_path / "robot.toml"
    path.write_text('mjcf = "menagerie:ship/biped.xml"')
    assert description.read(str(path)).mjcf == tmp_path / "ship" / "biped.xml"
    for inside, said in (
        ("lost/biped.xml", "found no lost/biped.xml (no network: try again)"),
        ("ship/other.xml", "found no ship/other.xml"),
    ):
        path.write_text(f'mjcf = "menagerie:{inside}"')
        with pytest.raises(RobotError) as refused:
            description.read(str(path))
        assert str(refused.value).endswith(said)


def test_a_package_with_an_mjcf_is_not_imported(tmp_path, monkeypatch):
    """Its import would fail, or take seconds."""
    package = tmp_path / "shipyard"
    (package / "models").mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('imported')")
    (package / "models" / "ship.xml").write_text("<mujoco/>")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "robot.toml"
    path.write_text('mjcf = "shipyard:models/ship.xml"')
    assert description.read(str(path)).mjcf == package / "models" / "ship.xml"
    assert "shipyard" not in sys.modules


def test_mjcf_in_a_package(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text('mjcf = "kslc_jax:robots/xbot_l.xml"')
    assert description.read(str(path)).mjcf == description.FOLDER / "xbot_l.xml"


def test_robots_need_no_jax():
    code = "import sys, kslc_jax.robots.build; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_pictures_show_every_link_that_has_a_shape():
    """Of the first link, group 3 stays hidden. The second link has nothing but such shapes."""
    assert shapes.drawn(mujoco.MjModel.from_xml_string(DRAWN)) == [0, 2, 3, 5]


@pytest.mark.parametrize("name", ["xbot_l", BIPED])
def test_pictures_show_what_mujocos_viewer_shows(name):
    high = model(name, "high")
    assert shapes.drawn(high) == np.flatnonzero(high.geom_group <= 2).tolist()
