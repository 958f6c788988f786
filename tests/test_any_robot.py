"""The package with another robot: the biped of tests/data, without arms and with other names."""

import copy
import ctypes.util
import dataclasses
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from family import COMMANDS, main
from packages import described
from states import BIPED, XBOT, random_params

from kslc_jax import (
    checkpoint_format,
    compare,
    config,
    contract,
    curriculum,
    env,
    export,
    fingerprint,
    gait,
    networks,
    observations,
    physics,
    policy,
    randomize,
    records,
    rewards,
    robot,
    signals,
    sim2sim,
    similar,
    train,
    train_step,
)
from kslc_jax.commands import Command
from kslc_jax.evaluation import gait_metrics, options, perturbations, trials, variation
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.robots import copying, description
from kslc_jax.robots.description import RobotError
from kslc_jax.training import run_folder, same_training, starting
from kslc_jax.training.checkpoint_process import LocalStorage

ENVS = 3


@pytest.fixture(scope="module")
def biped() -> robot.Robot:
    return robot.load(name=BIPED)


@pytest.fixture(scope="module")
def setup() -> config.Config:
    """Debug preset for the biped, without noise."""
    made = similar.preset("debug", BIPED)
    quiet = dataclasses.replace(
        made.env, num_envs=ENVS, noise_level=0.0, action_delay=0.0, action_noise=0.0
    )
    quiet = dataclasses.replace(quiet, reset_joint_noise=0.0)
    return dataclasses.replace(
        made, env=quiet, physics=dataclasses.replace(made.physics, engine="mujoco")
    )


@pytest.fixture(scope="module")
def untrained(setup) -> policy.Policy:
    return policy.Policy(setup, random_params(setup, scale=0.1), curriculum.init(setup), 0)


# ------------------------------------------------------------------------------------- similarity


@pytest.mark.parametrize("name", config.PRESETS)
def test_presets_of_xbot_l_stay_as_they_are(name):
    assert similar.factors(XBOT).keys() and set(similar.factors(XBOT).values()) == {1.0}
    assert similar.preset(name) == config.preset(name)


def test_a_quarter_of_the_height_and_an_eighth_of_the_mass():
    """By hand: times and speeds halve, torques are 1/32, momenta 1/64."""
    small = dataclasses.replace(XBOT, length_ratio=0.25, mass_ratio=0.125)
    laptop = config.preset("laptop")
    c = similar.scaled(laptop, small)
    assert (c.curriculum.v_limit, c.gait.cycle_time, c.curriculum.cycle_min) == (2.0, 0.32, 0.19)
    assert c.command.vy == (-0.15, 0.15) and c.randomize.base_mass == (-0.625, 0.625)
    assert c.rewards.momentum_scale == pytest.approx(3.0 / 64, rel=1e-2)  # three digits
    assert c.rewards.base_height_target == pytest.approx(0.2225, rel=1e-2)
    assert c.rewards.weights.torques == pytest.approx(-1e-5 * 32**2, rel=1e-2)
    assert c.rewards.weights.dof_acc == pytest.approx(-3e-7 / 16, rel=1e-2)
    assert (c.rewards.contact_force_range, c.rewards.longest_air_time) == (50.0, 0.25)
    assert c.rewards.weights.action_smoothness == laptop.rewards.weights.action_smoothness
    assert c.rewards.feet_distance == laptop.rewards.feet_distance  # of the same shape
    paper = similar.scaled(config.preset("paper"), small)
    assert paper.curriculum.top_error == 1e9  # what is switched off stays so


def test_sums_over_joints_scale_with_their_number(biped):
    c, factors = config.preset("laptop"), similar.factors(biped)
    assert biped.count == 9
    for term in ("action_smoothness", "dof_vel_limits"):
        assert factors[f"rewards.weights.{term}"] == 16 / 9
    weight = factors["rewards.weights.stand_still"]
    assert weight * factors["rewards.restless"] == pytest.approx(16 / 9)
    assert weight * factors["rewards.shuffle"] == pytest.approx(1.0)
    assert factors["rewards.shuffle_speed"] == pytest.approx(biped.length_ratio**0.5)
    assert factors["rewards.joint_pos_kernel"] == pytest.approx(4 / 3)
    assert similar.scaled(c, biped).rewards.joint_pos_clip == pytest.approx(0.375)
    assert factors["rewards.knee_distance"] == pytest.approx(0.2 / XBOT.knees_apart)


def test_a_description_overrides_the_scaled_config(tmp_path):
    def described(line: str) -> str:
        text = Path(BIPED).read_text().replace("biped.xml", BIPED.replace(".toml", ".xml"))
        path = tmp_path / f"{abs(hash(line))}.toml"
        path.write_text(f"{text}\n[config]\n{line}\n")
        return str(path)

    c = similar.preset("laptop", described('"gait.reference_scale" = 0.2'))
    assert c.gait.reference_scale == 0.2 and c.curriculum.v_limit < 4.5
    c = similar.preset("laptop", described("[config.gait]\nreference_scale = 1\narm_swing = 0.1"))
    assert (c.gait.reference_scale, c.gait.arm_swing) == (1.0, 0.1)
    assert isinstance(c.gait.reference_scale, float)
    for line, says in (
        ('"gait.reference" = 0.2', "unknown field 'reference'"),
        ('"gait.reference_scale" = "much"', '"much" is not a valid value'),
        ('"gait.reference_scale" = true', "true is not a valid value"),
        ('"physics.engine" = "quick"', '"quick" is not a valid value'),
        ('"physics.robot" = "xbot_l"', "'xbot_l' is not a valid value"),
        ('"command.vy" = [-0.2, 0.2, 0.3]', "is not a valid value"),
        ('"randomize.punch" = [0]', "is not a valid value"),
        ('"network.actor" = ["512"]', '"512" is not a valid value'),
        ('"gait.reference_scale.left" = 1', "has no field 'left'"),
    ):
        with pytest.raises(config.ConfigError, match=says):
            similar.preset("laptop", described(line))


def test_too_little_of_the_trunk_is_an_error(biped):
    """The biped's trunk weighs 6 kg: it cannot give away 6."""
    with pytest.raises(config.ConfigError, match=r"-6 kg leave 0\.0 of the trunk's 6\.0"):
        randomize.sample(config.RandomizeConfig(base_mass=(-6.0, 0.0)), biped, jax.random.key(0))


# ---------------------------------------------------------------------------------- one robot


def command(vx: float) -> Command:
    velocity = jnp.array([vx, 0.0, 0.0])
    yes = jnp.ones((), bool)
    return Command(velocity, jnp.zeros(()), moving=yes, wanted=velocity[:2], turns=yes)


def test_widths_follow_from_the_number_of_joints(biped, setup):
    assert observations.actor_width(biped) == 11 + 3 * 9
    assert observations.critic_width(biped) == 25 + 4 * 9
    assert observations.critic_width(biped, memory=True) == 61 + 8
    state = env.reset(setup, jax.random.key(0), curriculum.init(setup))
    assert state.history.shape == (3, 38) and state.privileged_history.shape[-1] == 69
    assert state.last_action.shape == (9,) and state.dynamics.link_mass.shape == (10,)


def test_joint_angles_count_from_home(biped, setup):
    home = jnp.asarray(biped.default_qpos, jnp.float32)
    state = physics.initial_state(setup.physics, home, jnp.zeros(15))
    now = signals.read(biped, state)
    assert (
        float(jnp.max(jnp.abs(now.joint_pos))) == 0.0 and np.abs(biped.default_qpos[7:]).max() > 0.2
    )
    assert float(now.foot_pos[0, 1] - now.foot_pos[1, 1]) == pytest.approx(0.2, abs=1e-5)


def reference(biped, setup, phase: float) -> np.ndarray:
    """Reference joint angles from home, at this phase and half of the full speed."""
    still = command(0.5 * setup.gait.full_speed)
    clock, stance = gait.clock_of(setup.gait, jnp.asarray(phase), still)
    state = gait.init(setup.gait, jax.random.key(0), still, jnp.zeros(2))
    state = state.replace(clock=clock, stance=stance)
    return np.asarray(gait.reference_pose(setup.gait, biped, state, still))


def feet_of(biped, angles: np.ndarray) -> np.ndarray:
    """[2, 3] position of the feet at these angles from home; the base stays where it is."""
    data = mujoco.MjData(biped.mj_model)
    data.qpos[:] = biped.default_qpos
    data.qpos[7:] += angles
    mujoco.mj_kinematics(biped.mj_model, data)
    return data.xpos[list(biped.anatomy.feet)].copy()


def test_the_reference_swings_one_foot_forward_and_up_and_then_the_other(biped, setup):
    rest = feet_of(biped, np.zeros(9))
    permutation, sign = biped.anatomy.permutation, biped.anatomy.sign
    for phase, swings, stands in ((0.25, 1, 0), (0.75, 0, 1)):
        angles = reference(biped, setup, phase)
        moved = feet_of(biped, angles) - rest
        assert moved[swings, 2] > 0.03 and abs(moved[stands, 2]) < 0.01
        other = reference(biped, setup, phase + 0.5)
        np.testing.assert_allclose(other, angles[permutation] * sign, atol=1e-5)
    lower, upper = biped.reference_range
    for phase in np.linspace(0, 1, 21):
        angles = reference(biped, setup, phase)
        assert np.all(angles >= lower - 1e-6) and np.all(angles <= upper + 1e-6)


def test_a_robot_without_yaw_has_its_roll_in_the_posture_term(biped):
    assert biped.roll_and_yaw("left") == [1] and biped.roll_and_yaw("right") == [5]
    assert XBOT.roll_and_yaw("right") == [6, 7]


def mirrored_state(biped, state: physics.PhysicsState) -> physics.PhysicsState:
    """The state of the mirrored robot: y, and rotations about x and z, change sign."""
    permutation, sign = biped.anatomy.permutation, biped.anatomy.sign
    qpos, qvel = np.asarray(state.qpos).copy(), np.asarray(state.qvel).copy()
    qpos[:7] *= [1, -1, 1, 1, -1, 1, -1]
    qvel[:6] *= [1, -1, 1, -1, 1, -1]
    qpos[7:], qvel[6:] = qpos[7:][permutation] * sign, qvel[6:][permutation] * sign
    return state.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))


def test_the_mirrored_robot_moves_as_the_mirror_image(biped, setup):
    """0.2 s on the floor: model, soles, servos and mirror map are symmetric."""
    permutation, sign = biped.anatomy.permutation, biped.anatomy.sign
    home = jnp.asarray(biped.default_qpos, jnp.float32).at[2].add(-0.05)
    rng = np.random.default_rng(0)
    push = jnp.asarray(rng.normal(0, 0.3, 15), jnp.float32)
    here = physics.initial_state(setup.physics, home, push)
    there = mirrored_state(biped, here)
    target = home[7:] + jnp.asarray(rng.normal(0, 0.2, 9), jnp.float32)
    other = target[permutation] * sign
    step = jax.jit(lambda s, t: physics.step(setup.physics, s, t, randomize.nominal(biped), 1.0))
    for _ in range(20):
        here, there = step(here, target), step(there, other)
    np.testing.assert_allclose(there.qpos, mirrored_state(biped, here).qpos, atol=2e-4)


def test_every_reward_term_is_finite_and_the_episode_goes_on(biped, setup):
    start = curriculum.init(setup)
    state = env.reset(setup, jax.random.key(0), start)
    new, out = jax.jit(lambda s: env.step(setup, s, jnp.zeros(9), jax.random.key(1), start))(state)
    assert out.terms.keys() == rewards.TERMS.keys()
    assert all(np.isfinite(value) for value in out.terms.values())
    assert not bool(out.terminated) and int(new.time) == 1


def test_the_actor_of_a_mirrored_history_gives_the_mirrored_action(biped, untrained):
    table = observations.actor_table(biped)
    at, factor = observations.mirror_map(table, biped)
    history = jax.random.normal(jax.random.key(1), untrained.init().history.shape)
    there = untrained.act_on(history[:, at] * factor)
    permutation, sign = biped.anatomy.permutation, biped.anatomy.sign
    np.testing.assert_allclose(there, untrained.act_on(history)[permutation] * sign, atol=1e-6)


def test_the_train_step_has_consistent_shapes(setup):
    state = jax.eval_shape(lambda: train_step.init(setup, 0))
    new, _ = jax.eval_shape(lambda s: train_step.step(setup, s), state)
    assert jax.tree.map(lambda x: x.shape, new) == jax.tree.map(lambda x: x.shape, state)


# ----------------------------------------------------------------------------- trials and policies


@pytest.mark.slow(reason="compiles a trial")
def test_a_trial_at_high_fidelity_has_all_metrics_but_those_of_arms(biped, untrained):
    setting = trials.Setting(trials.engine(untrained, "high"), seconds=1.0)
    assert setting.physics.robot == BIPED
    trace = trials.join(list(trials.run(untrained, setting, np.zeros((2, 3)))))
    assert trace.qpos.shape == (100, 2, 16) and trace.mass[0, 0] == pytest.approx(biped.total_mass)
    trace = trace.replace(alive=np.ones_like(trace.alive))
    longer = trials.join([trace] * 3)  # metrics begin after two seconds
    found = gait_metrics.summary(longer, 0.0, physics.robot_for(setting.physics), 0.01)
    assert {"knee_range_difference", "legs_momentum_rms", "stance_difference"} <= found.keys()
    assert not any("arm" in name or "shoulder" in name for name in found)


@pytest.mark.slow(reason="compiles a trial")
def test_a_robot_without_hands_carries_nothing_in_them(biped, untrained):
    setting = trials.Setting(
        trials.engine(untrained, "high"), seconds=0.01, variation=Variation(hands=0.5)
    )
    (trace,) = trials.run(untrained, setting, np.zeros((1, 3)), chunk=0.01)
    assert trace.mass[0, 0] == pytest.approx(biped.total_mass)


def test_a_policy_knows_its_robot(untrained, tmp_path):
    policy.save_policy(untrained, tmp_path / "policy")
    loaded = policy.load_policy(tmp_path / "policy")
    assert loaded.config.physics.robot == str(tmp_path / "policy" / "robot" / "biped.toml")
    history = jnp.ones(untrained.init().history.shape)
    np.testing.assert_array_equal(loaded.act_on(history), untrained.act_on(history))
    ours = checkpoint_format.metadata(untrained.config, {}, {})
    theirs = checkpoint_format.metadata(config.preset("debug"), {}, {})
    ours["robot"] = theirs["robot"]
    del ours["checksums"]
    with pytest.raises(checkpoint_format.CheckpointError, match=r"another robot.*not of biped"):
        checkpoint_format.checked_metadata(ours, False, tmp_path / "policy")


@pytest.fixture
def mine(setup, tmp_path):
    """(config of a robot in a user's folder, that folder). Its MJCF lies elsewhere and has an
    include."""
    home = tmp_path / "mine"
    for name in ("about", "models/parts"):
        (home / name).mkdir(parents=True)
    source = Path(BIPED).with_suffix(".xml").read_text()
    include = '<include file="parts/nothing.xml"/></mujoco>'
    (home / "models" / "biped.xml").write_text(source.replace("</mujoco>", include))
    (home / "models" / "parts" / "nothing.xml").write_text("<mujoco><visual/></mujoco>")
    described = Path(BIPED).read_text().replace('"biped.xml"', '"../models/biped.xml" # mine')
    (home / "about" / "biped.toml").write_text(described)
    engine = dataclasses.replace(setup.physics, robot=str(home / "about" / "biped.toml"))
    return dataclasses.replace(setup, physics=engine), home


def test_a_policy_takes_its_robot_along(mine, untrained, tmp_path):
    """It loads on another machine, and none of its files names a folder of this one."""
    setup, home = mine
    policy.save_policy(dataclasses.replace(untrained, config=setup), tmp_path / "here")
    shutil.rmtree(home)
    (tmp_path / "here").rename(tmp_path / "there")
    loaded = policy.load_policy(tmp_path / "there")
    robot_file = tmp_path / "there" / "robot" / "biped.toml"
    assert loaded.config.physics.robot == str(robot_file)
    assert 'mjcf = "mjcf/biped.xml"' in robot_file.read_text()
    history = jnp.ones(untrained.init().history.shape)
    np.testing.assert_array_equal(loaded.act_on(history), untrained.act_on(history))
    stored = [path for path in (tmp_path / "there").rglob("*") if path.is_file()]
    assert len(stored) > 5 and not [p for p in stored if bytes(tmp_path) in p.read_bytes()]
    policy.save_policy(loaded, tmp_path / "again")
    assert policy.load_policy(tmp_path / "again").config != loaded.config  # its own copy
    shutil.rmtree(tmp_path / "again" / "robot")
    said = r"again .*: its robot is missing, robot/biped\.toml: copy the folder robot of its run"
    with pytest.raises(checkpoint_format.CheckpointError, match=said):
        policy.load_policy(tmp_path / "again")


def test_a_training_keeps_its_robot(mine, tmp_path):
    """The run folder has a copy. Asked for by its description, the robot must have its numbers."""
    setup, home = mine
    run, about = tmp_path / "runs" / "x", home / "about" / "biped.toml"
    run.mkdir(parents=True)
    run_folder.open_folder(run, setup, False, {})
    kept = run_folder.read_config(run)
    assert kept.physics.robot == str(run / "robot" / "biped.toml")
    assert str(tmp_path) not in (run / "config.json").read_text()
    (tmp_path / "link").symlink_to(run)
    assert run_folder.read_config(tmp_path / "link") == kept
    same_training.difference(kept, setup)
    run_folder.open_folder(run, kept, True, {})
    (run / "robot").rename(run / "robots")
    with pytest.raises(config.ConfigError, match=f"copy the folder robot of its run to {run}"):
        run_folder.read_config(run)
    (run / "robots").rename(run / "robot")
    stronger = home / "stronger" / "biped.toml"  # in another place: robots are cached
    stronger.parent.mkdir()
    stronger.write_text(about.read_text().replace("kp = 60", "kp = 66"))
    engine = dataclasses.replace(setup.physics, robot=str(stronger))
    with pytest.raises(config.ConfigError, match=r"biped.toml has changed since .* 60 -> 66"):
        same_training.difference(kept, dataclasses.replace(setup, physics=engine))


@pytest.mark.parametrize("file", ["biped.toml", "biped.xml", "part.xml"])
def test_a_robot_that_changed_needs_a_new_process(tmp_path, file):
    """Compiled programs keep the robot's numbers. So the old ones are not used without a word."""
    data = Path(BIPED).parent
    (tmp_path / "biped.toml").write_text((data / "biped.toml").read_text())
    (tmp_path / "part.xml").write_text("<mujoco><visual/></mujoco>")
    text = (data / "biped.xml").read_text()
    (tmp_path / "biped.xml").write_text(
        text.replace("<compiler ", '<include file="part.xml"/><compiler ', 1)
    )
    mine = str(tmp_path / "biped.toml")
    before = similar.preset("debug", mine)
    assert similar.preset("debug", mine) == before
    changed = tmp_path / file
    os.utime(changed, ns=(0, changed.stat().st_mtime_ns + 10**9))
    with pytest.raises(RobotError, match=r"biped.toml: a file of this robot changed after this"):
        similar.preset("debug", mine)


def test_a_faulty_robot_can_be_mended(tmp_path):
    """What could not be loaded is read again."""
    data = Path(BIPED).parent
    good = (data / "biped.toml").read_text()
    shutil.copyfile(data / "biped.xml", tmp_path / "biped.xml")
    mine = tmp_path / "biped.toml"
    mine.write_text(good.replace('mjcf = "biped.xml"', 'mjcf = "biped.xm"'))
    with pytest.raises(RobotError, match="no such file"):
        similar.preset("debug", str(mine))
    mine.write_text("stand_height = -1\n" + good)
    with pytest.raises(RobotError):
        similar.preset("debug", str(mine))
    mine.write_text(good)
    assert similar.preset("debug", str(mine)).physics.robot == str(mine)


def test_a_robot_with_an_absolute_path_is_not_copied(tmp_path):
    """The copy would work on this machine only, and name one of its folders."""
    data = Path(BIPED).parent
    (tmp_path / "biped.toml").write_text((data / "biped.toml").read_text())
    text = (data / "biped.xml").read_text()
    meshes = f'<compiler meshdir="{tmp_path}" '
    assert text.count("<compiler ") == 1
    (tmp_path / "biped.xml").write_text(text.replace("<compiler ", meshes))
    with pytest.raises(RobotError, match=r"meshdir=.* of <compiler> is an absolute path"):
        copying.copy(str(tmp_path / "biped.toml"), tmp_path / "robot")


def test_the_copy_of_a_robot_keeps_names_beyond_ascii(tmp_path):
    data = Path(BIPED).parent
    text = (data / "biped.toml").read_text()
    assert text.count("biped.xml") == 1
    (tmp_path / "biped.toml").write_text(text.replace("biped.xml", "röboter.xml"), "utf-8")
    (tmp_path / "röboter.xml").write_text((data / "biped.xml").read_text())
    copying.copy(str(tmp_path / "biped.toml"), tmp_path / "robot")
    copied = description.read(str(tmp_path / "robot" / "biped.toml")).mjcf
    assert copied == tmp_path / "robot" / "mjcf" / "röboter.xml" and copied.is_file()


def test_the_copy_of_a_robot_in_a_package_is_its_description(tmp_path):
    about = described("unitree_g1").path
    copying.copy(str(about), tmp_path / "robot")
    assert [p.name for p in (tmp_path / "robot").iterdir()] == ["unitree_g1.toml"]


def test_the_exported_model_is_the_robots(biped, untrained):
    again = mujoco.MjModel.from_xml_string(contract.mjcf(untrained))
    trained = physics.robot_for(untrained.config.physics).mj_model.opt
    assert trained.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    for name in ("timestep", "cone", "iterations", "ls_iterations", "integrator", "solver"):
        assert getattr(again.opt, name) == getattr(trained, name), name
    np.testing.assert_allclose(again.body_mass, biped.mj_model.body_mass, rtol=1e-5)
    np.testing.assert_allclose(again.actuator_gainprm[:, 0], biped.kp)
    assert [again.actuator(i).name for i in range(again.nu)] == list(biped.joint_names)
    data = contract.metadata(untrained)
    np.testing.assert_allclose(data["default_joint_pos"], biped.default_qpos[7:])
    assert sum(c["width"] for c in data["frame"]) == 38


EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.slow(reason="compiles a trace; the quick suite has XBot-L's")
def test_the_runner_repeats_the_golden_trace(setup, tmp_path):
    """The biped's home pose is not zero, and its actions are as large as a trained policy's."""
    pytest.importorskip("onnxruntime", reason="the extra 'export' is not installed")
    network = dataclasses.replace(setup.network, init_mean=1.0)
    loud = dataclasses.replace(setup, network=network)
    made = policy.Policy(loud, networks.init(loud, jax.random.key(0)), curriculum.init(loud), 0)
    out, trace = tmp_path / "policy.onnx", contract.golden(made, 1.0)
    assert np.nanmax(np.abs(trace["action"])) > 0.3 and trace["steps"].min() > 20
    out.write_bytes(export.to_onnx(made))
    out.with_suffix(".json").write_text(json.dumps(contract.metadata(made)))
    np.savez(out.with_suffix(".npz"), **trace)
    check = runpy.run_path(str(EXAMPLES / "check_trace.py"))["first_difference"]
    runner = runpy.run_path(str(EXAMPLES / "onnx_runner.py"))
    assert check(runner["Controller"], str(out), 1e-4) is None
    model = mujoco.MjModel.from_xml_string(contract.mjcf(made))
    model.opt.timestep = 0.001
    track = runner["simulate"](runner["Controller"](str(out), 0.0), model, 0.2)
    high = robot.load("high", name=BIPED)
    assert len(track) == 21 and track[0, 2] == pytest.approx(high.default_qpos[2], abs=1e-5)
    assert 0.5 * high.stand_height < track[-1, 2] < track[0, 2]  # it falls on its feet


@pytest.mark.slow(reason="each robot compiles its own train step")
@pytest.mark.parametrize("name", sorted(description.known()))
def test_every_shipped_robot_learns_for_two_train_steps(name):
    described(name)
    init, step = train_step.make(similar.preset("debug", name))
    first = init()
    before = jax.tree.map(np.array, first.learner.params)
    state, _ = step(first)
    state, metrics = step(state)
    assert float(metrics["finite"]) == 1.0 and float(metrics["broken"]) == 0.0
    moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), before, state.learner.params)
    assert all(jax.tree.leaves(moved))


# --------------------------------------------------------------------------------- command line


def test_the_command_line_takes_a_robot():
    args = train.parse(["--robot", BIPED, "--preset", "debug"])
    assert args.config == similar.preset("debug", BIPED)
    assert str(train.headline(args)[1]) == "runs/biped-debug-seed0"
    with pytest.raises(RobotError, match=r"unknown robot 'unitree_g2' \(closest: unitree_g1\)"):
        train.parse(["--robot", "unitree_g2"])


@pytest.mark.slow(reason="a process of its own")
def test_help_knows_the_robot():
    """Its numbers are the defaults that the help shows."""
    asked = [sys.executable, "-m", "kslc_jax.train", "--robot", BIPED, "--help"]
    done = subprocess.run(asked, capture_output=True, text=True, check=True)
    shown = similar.preset("laptop", BIPED).rewards.base_height_target
    assert f"{shown:g}" in done.stdout


def test_a_training_does_not_start_from_another_robots_policy(tmp_path, capsys):
    """Nor does the check of it take a compilation."""
    given = ["--start-from", "xbot_l_run", "--run-dir", str(tmp_path)]
    assert train.main(["--robot", BIPED, "--preset", "debug", *given]) == 2
    said = capsys.readouterr().err.strip()
    assert (
        said.endswith("of the robot XBot-L, not of biped, or its joints have another order")
        and "\n" not in said
    )


def test_starting_from_another_robots_policy_names_the_numbers(mine, untrained, tmp_path):
    setup, home = mine
    about = home / "about" / "biped.toml"
    about.write_text(about.read_text().replace("kp = 60", "kp = 66"))
    known = dataclasses.replace(untrained, robot=fingerprint.fingerprint(BIPED))
    policy.save_policy(known, tmp_path / "policy")
    with pytest.warns(UserWarning, match="trained with another robot: kp of .* 60 -> 66"):
        init, _ = train_step.make(setup)
        starting.from_policy(tmp_path / "policy", setup, init, LocalStorage(), None)


def test_starting_from_a_policy_of_another_control_step_says_so(setup, untrained, tmp_path):
    policy.save_policy(untrained, tmp_path / "policy")
    slower = dataclasses.replace(setup.physics, decimation=2 * setup.physics.decimation)
    init, _ = train_step.make(setup)
    with pytest.warns(UserWarning, match=r"control step of 0.01 s, this training one of 0.02 s"):
        other = dataclasses.replace(setup, physics=slower)
        starting.from_policy(tmp_path / "policy", other, init, LocalStorage(), None)


def test_legs_may_have_neither_roll_nor_yaw(biped, setup):
    """The term of these joints then asks for nothing of them: 1 - 0.01 |q|."""
    roles = biped.anatomy.roles
    pitch = {name: joint for name, joint in roles.items() if not name.endswith(("roll", "yaw"))}
    assert len(pitch) < len(roles)
    anatomy = dataclasses.replace(biped.anatomy, roles=pitch)
    flat = dataclasses.replace(biped, anatomy=anatomy)
    joints = jnp.full(biped.count, 0.2)
    x = SimpleNamespace(signals=SimpleNamespace(joint_pos=joints))
    value = rewards.default_joint_pos(setup.rewards, flat, setup.control_dt, x)
    assert float(value) == pytest.approx(1.0 - 0.01 * 0.2 * 3.0, abs=1e-6)


def test_every_field_of_the_config_scales_or_is_known_not_to():
    """A new field that depends on the robot's size belongs in `similar.factors`, else in the
    file."""

    def names(part, prefix=""):
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            inside = dataclasses.is_dataclass(value)
            yield from names(value, f"{prefix}{field.name}.") if inside else [prefix + field.name]

    same = (Path(BIPED).parent / "fields_of_no_size.txt").read_text().split()
    terrain = dataclasses.replace(config.preset("laptop").physics, terrain=config.TerrainConfig())
    whole = dataclasses.replace(config.preset("laptop"), physics=terrain)
    assert {*names(whole)} - {*similar.factors(robot.load(name=BIPED))} == {*same}


def test_speeds_of_trials_fit_the_robot():
    ours = (0.5, 4.0)
    assert options.speeds_for(config.XBOT_L, None, ours) == ours
    assert options.speeds_for(BIPED, (1.0,), ours) == (1.0,)
    root = np.sqrt(robot.load(name=BIPED).length_ratio)
    assert options.speeds_for(BIPED, None, ours) == pytest.approx(np.array(ours) * root, abs=0.005)


def test_a_robot_is_tried_under_what_it_can_have():
    """The biped has no arms. A foot that is a capsule cannot have another sole."""
    physics_config = config.HighFidelity(robot=BIPED)
    high = physics.robot_for(physics_config)
    plain = trials.Setting(physics_config)

    def setting(condition):
        fields = perturbations.settings(perturbations.changes(condition), plain.randomize)
        return dataclasses.replace(plain, **fields)

    possible = variation.for_robot(perturbations.ALL, high)
    assert [c.split("=")[0] for c in perturbations.ALL if c.split("=")[0] in ("hands", "sole")]
    assert len(possible) == 15 and "hands" not in {c.split("=")[0] for c in possible}
    assert "payload=5" not in possible  # a payload of its size
    for condition in possible:
        trials.require(setting(condition), high)
    with pytest.raises(config.ConfigError, match="leave it out"):
        trials.require(setting("hands=0.5"), high)
    model = copy.copy(high.mj_model)
    model.geom_type[high.foot_shapes[1]] = mujoco.mjtGeom.mjGEOM_CAPSULE
    round_foot = dataclasses.replace(high, mj_model=model)
    assert len(variation.for_robot(perturbations.ALL, round_foot)) == 14
    with pytest.raises(config.ConfigError, match="a foot of biped is not one box"):
        trials.require(setting("sole=0.01"), round_foot)
    held = dataclasses.replace(plain.randomize, held_arms=1.0)
    with pytest.raises(config.ConfigError, match="has no arms"):
        trials.require(dataclasses.replace(plain, randomize=held), high)
    with pytest.raises(config.ConfigError, match="has no arms"):  # so in training, in the viewer
        randomize.sample(held, high, jax.random.key(0))


def test_the_soles_of_a_turned_foot_wander_inside_it():
    """The box of the left foot is turned by 0.5 rad in its link, that of the right by half a turn.

    In the frame of the described box, the new one lies within its outline.
    """
    high = robot.load("high", name=BIPED)
    plain, feet = copy.copy(high.mj_model), [int(foot[0]) for foot in high.foot_shapes]
    plain.geom_quat[feet] = [[np.cos(0.25), 0, 0, np.sin(0.25)], [0, 0, 0, 1]]
    turned = dataclasses.replace(high, mj_model=plain)
    assert variation._foot_boxes(turned) == tuple(feet)
    nominal = {"geom_pos": jnp.asarray(plain.geom_pos)}
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for seed in range(5):
        fields = variation._soles(0.02, turned, jax.random.key(seed), nominal)
        for foot in feet:
            frames = np.zeros((2, 9))
            mujoco.mju_quat2Mat(frames[0], plain.geom_quat[foot])
            mujoco.mju_quat2Mat(frames[1], np.asarray(fields["geom_quat"][foot], float))
            described, new = frames.reshape(2, 3, 3)
            size = np.asarray(fields["geom_size"][foot])
            corners = fields["geom_pos"][foot] - plain.geom_pos[foot] + (signs * size) @ new.T
            inside = np.abs(corners @ described)
            assert (inside <= plain.geom_size[foot] + 1e-3).all()
            assert (plain.geom_size[foot] - size)[:2].max() > 1e-3
            assert 1.0 - variation.TILT < new[2, 2] < 1.0  # tilted a little


@pytest.mark.slow(reason="compiles a trial for each of sixteen conditions: minutes")
def test_the_biped_is_tried_in_full_mujoco(untrained, tmp_path, capsys):
    policy.save_policy(untrained, tmp_path / "policy")
    out = tmp_path / "out.json"
    short = ["--perturb", "all", "--speeds", "0.3", "--seeds", "1", "--seconds", "3"]
    assert sim2sim.main([str(tmp_path / "policy"), *short, "--json", str(out)]) == 0
    assert len(records.read_conditions(out)) == 16


def test_a_robot_is_chosen_by_its_own_option(capsys):
    """The field of the config alone would leave the numbers of another robot."""
    assert train.main(["--preset", "debug", "--physics.robot", BIPED]) == 2
    assert f"use --robot {BIPED}, which scales" in capsys.readouterr().err
    wanted = dataclasses.replace(similar.preset("debug", BIPED), seed=4)
    presets = {name: similar.preset(name, BIPED) for name in config.PRESETS}
    words = config.options(wanted, presets)
    assert words == ["--robot", BIPED, "--preset", "debug", "--seed", "4"]
    assert train.parse(words).config == wanted


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """The run folder of a training of the biped that was resumed."""
    folder = tmp_path_factory.mktemp("runs") / "biped-seed0"
    run = ["--run-dir", str(folder), "--steps"]
    assert train.main(["--robot", BIPED, "--preset", "debug", *run, "256"]) == 0
    assert train.main(["--resume", *run, "512"]) == 0
    return folder


@pytest.mark.slow(reason="compiles a train step: a minute")
def test_the_biped_trains_and_resumes(trained):
    assert policy.load_policy(trained).step == 4


SHORT = "--seeds 1 --seconds 3"
ONE = f"--speeds 0.3 {SHORT}"
LINES = {
    "evaluate": (
        f"evaluate RUN {ONE} --json OUT/found.json",
        "plots performance OUT/found.json --out OUT/performance.png",
        "plots momentum OUT/found.json --out OUT/momentum.png",
    ),
    "learning": (f"learning RUN {ONE}", "plots learning RUN --out OUT/learning.png"),
    "judge": (f"judge RUN --quick {SHORT} --json OUT/judged.json", "judge OUT/judged.json"),
    "falls": ("falls RUN --robots 16 --seconds 3 --json OUT/falls.json",),
    "sim2sim": (
        f"sim2sim RUN {ONE} --perturb payload=1 --json OUT/found.json",
        "plots conditions OUT/found.json --out OUT/conditions.png",
    ),
    "sim2sim --schedule": (
        f"sim2sim RUN --schedule stop {SHORT} --json OUT/found.json",
        "plots schedules OUT/found.json --out OUT/schedules.png",
    ),
    "export": (
        "export RUN OUT/policy.onnx",
        "export RUN OUT/policy --format orbax",
        f"evaluate OUT/policy {ONE} --fidelity high",
    ),
    "plots": ("plots training RUN --out OUT/training.png",),
}
"""Lines of commands that a user of another robot types. RUN is a run folder, OUT a new one."""


def test_all_commands_that_take_a_policy_are_tried():
    tried = {line.split()[0] for lines in LINES.values() for line in lines}
    assert tried == {*COMMANDS} - {"compare", "doctor", "play", "reproduce", "train"}


@pytest.mark.slow(reason="compiles a train step, and one or more trials for each: minutes")
@pytest.mark.parametrize("name", LINES)
def test_every_command_takes_the_biped(trained, tmp_path, name):
    for line in LINES[name]:
        words = line.replace("RUN", str(trained)).replace("OUT", str(tmp_path)).split()
        assert main(words[0])(words[1:]) == 0, line
        written = [Path(word) for word in words if word.startswith(str(tmp_path))]
        assert all(path.exists() for path in written), line


@pytest.mark.slow(reason="a process of its own, in which GL is chosen before MuJoCo is imported")
def test_the_biped_is_filmed(trained, tmp_path):
    strip, film = tmp_path / "strip.png", tmp_path / "film.webp"
    words = f"--speeds 0.3 --seconds 0.5 --gait-strip {strip} --video {film}".split()
    if not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))):
        pytest.skip("no off-screen GL")
    command = [sys.executable, "-m", "kslc_jax.play", str(trained), *words]
    env = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    assert strip.stat().st_size > 5_000 and film.stat().st_size > 5_000


@pytest.mark.slow(reason="compiles a train step: a minute")
def test_a_training_has_no_published_numbers(trained, capsys):
    assert main("reproduce")([str(trained)]) == 2
    said = capsys.readouterr().err.strip()
    assert "only shipped policies have published numbers: xbot_l_run" in said and "\n" not in said


def test_compare_takes_a_robot(tmp_path):
    args = compare.Args(out=tmp_path, robot=BIPED, variants=("kslc", "no-arms"), seeds=(0,))
    first, second = compare.jobs(args)
    assert first.config == similar.preset("laptop", BIPED) and first.train[:2] == ("--robot", BIPED)
    assert second.config == similar.preset("laptop", BIPED, ("arms",))
