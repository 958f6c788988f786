"""`python -m kslc_jax.doctor robot`: what is derived, and the warnings, each on a broken biped."""

import dataclasses
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from packages import described

from kslc_jax import doctor, robot
from kslc_jax.checkup import findings, picture, report, statics, trials
from kslc_jax.checkup.findings import Patient
from kslc_jax.config import preset
from kslc_jax.errors import UserError
from kslc_jax.robots import description

DATA = Path(__file__).parent / "data"
BIPED = str(DATA / "biped.toml")


@pytest.fixture(scope="module")
def biped() -> Patient:
    return report.patient(BIPED)


@pytest.fixture(scope="module")
def xbot_l() -> Patient:
    return report.patient("xbot_l")


def broken(folder: Path, toml: str = "", *xml: tuple[str, str]) -> Patient:
    """The biped with lines added to its description, and with texts of its MJCF replaced."""
    text = (DATA / "biped.toml").read_text()
    mjcf = (DATA / "biped.xml").read_text()
    for old, new in xml:
        assert old in mjcf
        mjcf = mjcf.replace(old, new)
    (folder / "biped.xml").write_text(mjcf)
    (folder / "robot.toml").write_text(text + toml)
    return report.patient(str(folder / "robot.toml"))


# --------------------------------------------------------------------------------------- derived


def test_rows_of_the_biped(biped):
    rows = report.geometry_rows(biped.train)
    assert rows[0] == ("0", "mast", "-", "z", "0.00", "-1.60 to 1.60", "0 -")
    assert rows[5] == ("5", "star_cant", "right hip roll", "-x", "0.00", "-0.40 to 0.60", "1 +")
    assert rows[7] == ("7", "star_lock", "right knee", "-y", "-1.00", "-2.20 to 0.10", "3 -")
    motors = report.motor_rows(biped.train)
    assert motors[1][:-2] == ("1", "port_cant", "60", "2", "30", "15", "0.01")
    facts = dict(report.fact_rows(biped))
    stand = 0.1 + 2 * 0.25 * math.cos(0.5) + 0.04
    assert facts["standing height"] == f"{stand:.3f} m, {stand / 0.89:.2f} of XBot-L's (hull)"
    assert facts["trunk"] == "crow, 6.0 kg"
    assert facts["soles"].startswith("0.160 m x 0.060 m, 0.040 m below the ankle, 0.0 degrees")
    assert facts["feet, knees apart"] == "0.200 m, 0.200 m"
    assert facts["contacts in training"].startswith("13 pairs of 7 parts")
    assert facts["observations"] == "actor 38, critic 69"  # 11 + 3 x 9, 33 + 4 x 9


def test_an_upright_base_is_told_where_the_keyframe_tilts_it(tmp_path, biped):
    tilted = f"0 0 0.6 {math.cos(0.1)} {math.sin(0.1)} 0 0"
    facts = dict(report.fact_rows(broken(tmp_path, "", ("0 0 0.6 1 0 0 0", tilted))))
    assert facts["base"].endswith("there it is tilted by 0.20 rad")
    assert "base" not in dict(report.fact_rows(biped))


def test_axis_names():
    assert report.axis_name(np.array([0.0, -1.0, 0.02])) == "-y"
    assert report.axis_name(np.array([0.8, 0.0, -0.6])) == "0.80 0.00 -0.60"


def test_standing_torque_is_weight_times_arm(biped):
    """The ground pushes below the centre of mass with half of the weight. The knee is in front of
    it; the thigh and the trunk above the knee rest on it, the shank and the foot do not."""
    it = biped.train
    model, data = it.mj_model, statics.posed(it, it.default_qpos)
    knee, com = data.xanchor[1 + 3], data.sensor("com").data
    below = [model.body(name).id for name in ("port_oar", "port_keel")]
    masses = model.body_mass[below]
    moment = it.total_mass / 2 * (com[0] - knee[0])
    moment -= masses @ (data.xipos[below, 0] - knee[0])
    torque = statics.standing_torque(it)
    assert torque[3] == pytest.approx(9.81 * moment, rel=1e-6)
    assert torque[3] < -5
    assert torque[7] == pytest.approx(-torque[3])  # star_lock turns the other way
    assert torque[0] == pytest.approx(0, abs=1e-9)


def test_the_foot_lift_of_the_biped(biped):
    """Thigh and shank of 0.25 m; the reference turns them by a and by -a, from 0.5 and -0.5."""
    a = biped.config.gait.reference_scale
    lift = 0.5 * (math.cos(0.5) - math.cos(0.5 + a))
    assert statics.foot_lift(biped.config, biped.train) == pytest.approx(lift, abs=1e-6)


def test_contacts_in_random_poses(biped, monkeypatch):
    monkeypatch.setattr(statics, "POSES", 200)
    monkeypatch.setattr(statics, "SPREAD", 1.6)
    missed, there = statics.unfelt(biped.train, biped.high)
    assert 0 == missed < there
    deaf = robot.load(name=BIPED, iterations=7)  # another model than the fixture's
    deaf.mj_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert statics.unfelt(deaf, biped.high) == (there, there)


@pytest.mark.parametrize("name", description.known())
def test_training_feels_the_contacts_of_every_shipped_robot(name):
    described(name)
    missed, there = statics.unfelt(robot.load(name=name), robot.load("high", name=name))
    assert there > 20 and missed <= 0.02 * there


# -------------------------------------------------------------------------------------- warnings


def static_findings(x: Patient) -> list[findings.Finding]:
    return [finding for look in findings.STATIC for finding in look(x)]


@pytest.mark.parametrize("name", ["xbot_l", BIPED])
def test_nothing_is_wrong_with_these(name):
    assert static_findings(report.patient(name)) == []


CASES = {
    "gains": ('"lock" = { kp = 30 }\n', (), "motors: kp", "port_lock, star_lock: standing"),
    "stiff ankles": (
        '"rudder" = { kp = 12 }\n',
        (),
        "motors: kp",
        "the ankles' stiffness is 0.34 m g h",
    ),
    "effort": (
        '"lock" = { effort = 11 }\n',
        (),
        "motors: effort",
        "port_lock, star_lock: standing on one leg takes 1.1 times",
    ),
    "actions too strong": (
        '"_cant" = { kp = 240 }\n',
        (),
        "motors: kp, effort",
        "port_cant, star_cant: an action of 1 takes 2 of the largest",
    ),
    "actions too weak": (
        '"mast" = { kp = 5 }\n[config]\n"env.least_torque" = 0.0\n',
        (),
        "motors: kp, effort",
        "mast: an action of 1 takes 0.021",
    ),
    "mass": (
        "",
        (('<geom type="sphere" size="0.03"/>', '<geom type="sphere" size="0.03" mass="4e-4"/>'),),
        "mjcf: inertial",
        "port_cant, star_cant: the link weighs 0.4 g",
    ),
    "armature": (
        '"rudder" = { kd = 3, armature = 0 }\n',
        (),
        "motors: armature",
        "port_rudder, star_rudder: no armature",
    ),
    "gains of one side": (
        '"port_sheet" = { kp = 100 }\n',
        (),
        "motors: kp",
        "port_sheet, star_sheet: left and right differ by 20%",
    ),
    "range of one side": (
        "",
        (('axis="-1 0 0" range="-0.4 0.6"', 'axis="-1 0 0" range="-0.4 0.7"'),),
        "mjcf: range",
        "port_cant, star_cant: the ranges are no mirror images, by 0.10 rad",
    ),
    "mass of one side": (
        "",
        (
            (
                '-0.21" size="0.04"/>\n          <!-- The knee',
                '-0.21" size="0.04" mass="2"/>\n<!-- ',
            ),
        ),
        "mjcf: inertial",
        "port_sheet, star_sheet: left and right differ by",
    ),
    "balance": (
        "",
        (('pos="0 0 0.14" mass="6"', 'pos="0.25 0 0.14" mass="6"'),),
        "home",
        "cm in front of the toes",
    ),
    "below the ground": (
        "",
        (('0 0 0.07 0 0 -0.12" size="0.03"', '0 0 0.07 0.04 0 -0.2" size="0.03"'),),
        "home",
        "port_oar is",
    ),
    "legs overlap": (
        "",
        (("0 0.1 -0.05", "0 0.025 -0.05"), ("0 -0.1 -0.05", "0 -0.025 -0.05")),
        "home",
        "overlap at home",
    ),
    "out of range": (
        "",
        (('axis="0 1 0" range="-0.1 2.2"', 'axis="0 1 0" range="-0.1 1.2"'),),
        "home, config: gait",
        "port_lock, star_lock: the reference motion leaves the range by",
    ),
    "too fast": (
        '[config]\n"gait.cycle_time" = 0.2\n"curriculum.cycle_min" = 0.1\n',
        (),
        "config: gait",
        "the reference motion asks for",
    ),
    "low feet": (
        '[config]\n"gait.reference_scale" = 0.05\n',
        (),
        'config: "gait.reference_scale"',
        "the reference motion lifts the foot by",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said(case, tmp_path, monkeypatch):
    monkeypatch.setattr(statics, "POSES", 10)  # no case is about contacts in random poses
    toml, xml, field, text = CASES[case]
    found = static_findings(broken(tmp_path, toml, *xml))
    lines = [finding.text for finding in found if finding.field == field]
    assert any(text in line for line in lines), found
    assert len(found) <= 4 and not any("\n" in finding.text for finding in found)


def test_home_outside_the_range(xbot_l):
    """Other MJCFs are refused; one of ours may have such a home."""
    upper = xbot_l.train.joint_upper.copy()
    upper[4] = -0.2  # the left ankle, at 0
    x = dataclasses.replace(xbot_l, train=dataclasses.replace(xbot_l.train, joint_upper=upper))
    (finding,) = findings.home_range(x)
    assert finding.field == "home" and "home is 0.20 rad outside" in finding.text


def test_findings_of_trials():
    assert findings.contacts(10, 100) == [] and findings.contacts(0, 0) == []
    assert "11 of 100 contacts" in findings.contacts(11, 100)[0].text
    assert findings.passive(2.4, 4.0) == []
    assert "4 s without a policy" in findings.passive(math.inf, 4.0)[0].text
    assert findings.engines(1e-5) == []
    assert "2.0e-03 rad apart" in findings.engines(2e-3)[0].text
    assert findings.engines(math.nan)


# ----------------------------------------------------------------------------------------- trials


def test_xbot_l_falls_and_stiff_ankles_stand(xbot_l, tmp_path):
    assert trials.fall_time(xbot_l.train) == pytest.approx(2.4, abs=0.1)
    firm = '"rudder" = { kp = 60, kd = 4 }\n"lock|sheet|_cant" = { kp = 400, kd = 10 }\n'
    stiff = broken(tmp_path, firm)
    assert trials.fall_time(stiff.train) == math.inf


def test_sag_is_the_weight_of_the_limbs_over_kp(biped):
    """Without the ground, a joint bends by the torque of gravity on its limb over kp."""
    it = biped.train
    sag = trials.sag(it)
    torque = statics.posed(it, it.default_qpos).qfrc_bias[6:]
    np.testing.assert_allclose(sag, -torque / it.kp, atol=2e-3)
    assert np.abs(sag).max() > 5e-3


def test_trials_have_the_physics_of_training(tmp_path):
    """[config] counts, and the ground is flat for the checks."""
    physics = "timestep = 0.0025\ndecimation = 4\niterations = 7\n"
    it = broken(tmp_path, f"[config.physics]\n{physics}terrain.rough = 0.02\n").train
    assert it.mj_model.opt.timestep == 0.0025 and it.mj_model.opt.iterations == 7
    assert it.terrain is None and math.isfinite(trials.fall_time(it))


@pytest.mark.slow(reason="compiles MJX")
def test_engines_agree_on_the_biped():
    config = dataclasses.replace(preset("laptop").physics, robot=BIPED)
    assert trials.engines_apart(config) < findings.AGREEMENT


# ---------------------------------------------------------------------------------------- command


def test_the_picture(biped, tmp_path):
    out = tmp_path / "robot.png"
    picture.draw(biped.high, out)
    assert 10_000 < out.stat().st_size < 300_000
    with pytest.raises(UserError, match="cannot write"):
        picture.draw(biped.high, out / "no folder" / "robot.png")


def test_the_command(tmp_path, capsys):
    """It ends with 0, also with warnings, and its picture is there."""
    broken(tmp_path, '"lock" = { kp = 30 }\n')
    out = tmp_path / "new" / "robot.png"
    words = ["robot", str(tmp_path / "robot.toml"), "--no-engines", "--picture", str(out)]
    assert doctor.main(words) == 0
    said = capsys.readouterr().out
    assert "star_lock" in said and "observations" in said and "falls after" in said
    assert "one thing looks wrong" in said and "motors: kp" in said
    assert out.is_file()


@pytest.mark.parametrize(
    ("name", "message"),
    [("unitree_g9", "closest: unitree_g1"), ("nowhere.toml", "no such file")],
)
def test_robots_that_cannot_be_used(name, message, capsys):
    assert doctor.main(["robot", name]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def test_a_home_outside_the_range_is_refused(tmp_path, capsys):
    (tmp_path / "biped.xml").write_text((DATA / "biped.xml").read_text())
    path = tmp_path / "robot.toml"
    path.write_text((DATA / "biped.toml").read_text() + "[home]\nlock = 2.5\n")
    assert doctor.main(["robot", str(path)]) == 2
    assert "outside the range of joint 'port_lock'" in capsys.readouterr().err


@pytest.mark.slow(reason="half a minute: reads meshes and compiles MJX")
def test_the_g1(capsys):
    described("unitree_g1")
    assert doctor.main(["robot", "unitree_g1"]) == 0
    said = capsys.readouterr().out
    assert "actor 74, critic 117" in said and "nothing looks wrong" in said
