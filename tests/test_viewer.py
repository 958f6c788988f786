"""The live viewer: session, pacer, figure, panel, page. Also `play`: films and errors."""

import copy
import dataclasses
import io
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import orbax.checkpoint as ocp
import pytest
from states import BIPED, still_policy

import kslc_jax.viewer
from kslc_jax import config, files, play, robot
from kslc_jax import ground as ground_lib
from kslc_jax import policy as policy_lib
from kslc_jax.config import ConfigError, PhysicsConfig, preset
from kslc_jax.evaluation import perturbations, schedules, trials
from kslc_jax.viewer import films, following, session

C_MUJOCO = PhysicsConfig(engine="mujoco")
BROWSERS = ("chromium-headless-shell", "chromium", "google-chrome")


@pytest.fixture(scope="module")
def still():
    """`still_policy` that always starts in the same pose. All tests use its config, so that they
    share the compiled programs."""
    base = preset("debug")
    env = dataclasses.replace(base.env, reset_joint_noise=0.0)
    quiet = dataclasses.replace(base, env=env, physics=C_MUJOCO)
    made = still_policy(quiet)
    # On a named device, like the loaded parameters of `viewer`: both run the same programs.
    return dataclasses.replace(made, params=jax.device_put(made.params, jax.devices()[0]))


@pytest.fixture(scope="module")
def run_dir(still, tmp_path_factory):
    """A run folder with the checkpoints 2 and 10 of the policy `still`."""
    root = tmp_path_factory.mktemp("run")
    reached = {"curriculum/v_max": 1.5, "curriculum/cycle_time": 0.6}
    meta = {"schema": 1, "config": config.to_dict(still.config), "metrics": reached}
    for step in ("2", "10"):
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as writer:
            items = ocp.args.Composite(
                params=ocp.args.StandardSave(still.params), meta=ocp.args.JsonSave(meta)
            )
            writer.save(root / files.CHECKPOINTS / step, args=items)
    return root


# ------------------------------------------------------------------------------------------ session


@pytest.mark.parametrize("rate", [0.25, 1.0, 2.0])
def test_pacer_keeps_the_rate(rate):
    pacer = session.Pacer(dt=0.01)
    steps = [pacer.due(i / 30, rate) for i in range(10 * 30 + 1)]
    assert sum(steps) == pytest.approx(10.0 * rate / 0.01, abs=1)
    assert max(steps) - min(steps[1:]) <= 1


def test_pacer_forgets_what_it_cannot_make_up_for():
    pacer = session.Pacer(dt=0.01, longest=0.1)
    assert pacer.due(5.0, 1.0) == 0
    assert pacer.due(65.0, 1.0) == 10
    assert pacer.due(75.0, 0.0) == 0 and pacer.due(75.02, 1.0) == 2


@pytest.mark.slow(reason="compiles two programs; with a schedule the quick suite compares the same")
def test_a_session_is_a_trial(still):
    """With the same start, command and policy, the motion equals that of `trials.run`."""
    command = np.array([0.3, 0.1, 0.2])
    trace = next(trials.run(still, trials.Setting(C_MUJOCO), command[None]))
    live = session.Session(still, C_MUJOCO)
    qpos = [live.advance(command).qpos for _ in range(80)]
    np.testing.assert_allclose(qpos, trace.qpos[:80, 0], atol=2e-5)


def test_heading_is_kept_where_turning_ended(still):
    live = session.Session(still, C_MUJOCO)
    for _ in range(30):
        live.advance(np.array([0.0, 0.0, 0.5]))
    yaw = 2 * np.arctan2(live.view.qpos[6], live.view.qpos[3])
    live.advance(np.zeros(3))
    assert float(live._memory.env.command.heading) == pytest.approx(yaw, abs=0.01)


def in_the_air(live, yaw):
    """Lifts the robot of a session by 5 m and turns it to the heading `yaw` [rad]."""
    memory = live._memory
    turn = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    qpos = memory.env.physics.qpos.at[2].add(5.0).at[3:7].set(np.array(turn))
    lifted = memory.env.replace(physics=memory.env.physics.replace(qpos=qpos))
    live._memory, live.view = memory.replace(env=lifted), live.view.replace(qpos=qpos)


def topple(live):
    """Lays the robot of a session on its side: it has fallen in the next step."""
    memory, side = live._memory, np.array([0.15, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    lying = memory.env.physics.replace(qpos=memory.env.physics.qpos.at[2:7].set(side))
    live._memory = memory.replace(env=memory.env.replace(physics=lying))


def velocity_of_mass(live):
    """Velocity [3, m/s] of the centre of mass of the robot of a session, in the world frame."""
    model, state = live._model, live._memory.env.physics
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data.subtree_linvel[0].copy()


@pytest.mark.parametrize(("link", "angle"), [("base_link", 0.0), ("left_knee_link", 2.0)])
def test_a_shove_in_the_air_changes_the_velocity_by_force_times_time_by_mass(still, link, angle):
    """At any link. The direction counts from the robot's heading, here 0.5 rad. The shove lasts
    0.08 s of the 0.12 s."""
    left, shoved = (session.Session(still, C_MUJOCO) for _ in range(2))
    for live in (left, shoved):
        in_the_air(live, yaw=0.5)
    shoved.shove(link, 100.0, angle)
    for _ in range(12):
        left.advance(np.zeros(3))
        shoved.advance(np.zeros(3))
    change = velocity_of_mass(shoved) - velocity_of_mass(left)
    mass = robot.load("train").total_mass
    way = np.array([np.cos(0.5 + angle), np.sin(0.5 + angle), 0.0])
    np.testing.assert_allclose(change, 100.0 * 0.08 / mass * way, atol=2e-3)


def test_a_shove_ends_with_the_episode(still):
    live = session.Session(still, C_MUJOCO)
    live.shove("base_link", 300.0, 0.0)
    live.advance(np.zeros(3))
    assert live._force.any()
    live.reset()
    assert not live._force.any()


MINE = schedules.Schedule(
    "mine",
    top=0.5,
    steps=(
        schedules.Step(0.2, 0.5),
        schedules.Step(0.2, 0.3, yaw_rate=0.4),
        schedules.Step(0.2, 0.0, heading=0.3),
    ),
)
VX = [0.5] * 20 + [0.3] * 20 + [0.0] * 20
"""Commands of `MINE` in its 60 control steps [m/s]."""


def test_a_session_follows_a_schedule_as_a_trial_does(still):
    """A command of the user interrupts a leg. The next leg begins after it."""
    trace = next(trials.run(still, trials.Setting(C_MUJOCO, schedule=MINE), np.zeros((1, 3))))
    live = session.Session(still, C_MUJOCO, schedule=MINE)
    views = [live.advance() for _ in range(70)]
    np.testing.assert_allclose([v.qpos for v in views], trace.qpos[:70, 0], atol=2e-5)
    np.testing.assert_allclose([v.command[0] for v in views], [*VX, *VX[:10]])
    np.testing.assert_allclose(live.advance(np.array([0.4, 0.0, 0.1])).command, [0.4, 0.0, 0.1])
    np.testing.assert_allclose(live.advance().command, [0.3, 0.0, 0.4])


def test_a_fallen_robot_starts_the_schedule_anew(still):
    live = session.Session(still, C_MUJOCO, schedule=MINE)
    views = [live.advance() for _ in range(70)]
    topple(live)
    views += [live.advance() for _ in range(170)]
    fell = next(i for i, v in enumerate(views) if v.fallen)
    again = [v.command[0] for v in views[fell + 101 : fell + 161]]
    np.testing.assert_allclose(again, VX)


def test_a_session_has_the_disturbances_of_play(still):
    args = play.Args(Path("x"), punch=300.0, hold_arms=True)
    live = session.Session(still, C_MUJOCO, randomize=play.randomize(args))
    assert live._memory.env.disturbances.arms_held
    assert live._config.randomize == dataclasses.replace(
        trials.NOMINAL, punch=(300.0, 300.0), held_arms=1.0
    )


def test_a_standing_robot_does_not_turn_back_and_forth(still):
    """As in training: a turn on the spot that has ended begins again only with another command."""
    live, stand = session.Session(still, C_MUJOCO), np.zeros(3)

    def steps(yaw, command):
        """True if the robot may step after one control step from this yaw [rad]."""
        memory, quat = live._memory, [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        turned = memory.env.physics.replace(qpos=memory.env.physics.qpos.at[3:7].set(quat))
        live._memory = memory.replace(env=memory.env.replace(physics=turned))
        live.advance(command)
        return bool(live._memory.env.command.moving)

    assert still.config.command.stand_still
    assert [steps(yaw, stand) for yaw in (0.0, 0.5, -0.5)] == [False] * 3
    assert steps(0.0, np.array([0.0, 0.0, 0.12]))
    assert [steps(yaw, stand) for yaw in (0.0, 0.5)] == [False] * 2
    assert steps(0.5, np.array([0.5, 0.0, 0.0]))
    assert steps(0.5, stand) and steps(0.5, stand)  # a new command
    assert [steps(yaw, stand) for yaw in (0.1, 0.5)] == [False] * 2
    leg = live._memory.leg
    live._memory = live._memory.replace(leg=leg.replace(heading=leg.heading + 0.01))
    assert steps(0.5, stand)


def test_a_joystick_that_trembles_at_the_edge_of_the_dead_zone():
    before, seen = (False, False), []
    for vx in (0.19, 0.2, 0.21, 0.19, 0.185, -0.19, 0.179, 0.19, 0.21):
        velocity, before = session.steady(np.array([vx, 0.0, 0.3]), before, 0.2)
        seen.append((round(float(velocity[0]), 3), before[0]))
        assert velocity[2] == 0.3 and before[1]
    assert seen == [
        *((0.19, False), (0.2, False), (0.21, True), (0.2, True), (0.2, True), (-0.2, True)),
        *((0.179, False), (0.19, False), (0.21, True)),
    ]


def test_a_joystick_that_trembles_at_the_edge_of_turning():
    before, seen = (False, False), []
    for rate in (0.095, 0.1, 0.105, 0.095, -0.095, 0.089, 0.095):
        velocity, before = session.steady(np.array([0.0, 0.0, rate]), before, 0.2)
        seen.append((round(float(velocity[2]), 3), before[1]))
        assert not velocity[:2].any() and not before[0]
    assert seen == [
        *((0.095, False), (0.1, False), (0.105, True), (0.1, True), (-0.1, True)),
        *((0.089, False), (0.095, False)),
    ]


def test_a_session_turns_on_at_the_edge_of_turning(still):
    live = session.Session(still, C_MUJOCO)
    moving = []
    for rate in (0.095, 0.11, 0.095, 0.08):
        live.advance(np.array([0.0, 0.0, rate]))
        moving.append(bool(live._memory.env.command.moving))
    assert moving == [False, True, True, False]


def test_a_session_refuses_another_control_step(still):
    slower = dataclasses.replace(C_MUJOCO, decimation=2 * C_MUJOCO.decimation)
    with pytest.raises(ConfigError, match=r"acts every 0.01 s, but .* is 0.02 s"):
        session.Session(still, slower)


def test_a_session_walks_on_at_the_edge_and_a_fresh_one_stands(still):
    """The environment's own dead zone does not make the edge zero, in any direction."""
    live, fresh = (session.Session(still, C_MUJOCO) for _ in range(2))
    live.advance(np.array([0.5, 0.0, 0.0]))
    for angle in np.linspace(0.0, 6.0, 7):
        command = 0.19 * np.array([np.cos(angle), np.sin(angle), 0.0])
        live.advance(command)
        fresh.advance(command)
        moving = live._memory.env.command.wanted
        assert np.hypot(*moving) == pytest.approx(0.2, rel=1e-4)
        assert (fresh._memory.env.command.velocity == 0.0).all()
    live.advance(np.array([0.17, 0.0, 0.0]))
    assert (live._memory.env.command.wanted == 0.0).all()


def test_a_fallen_robot_lies_a_second_and_starts_anew(still):
    live = session.Session(still, C_MUJOCO)
    views = [live.advance(np.zeros(3)) for _ in range(20)]
    topple(live)
    views += [live.advance(np.zeros(3)) for _ in range(120)]
    fell = next(i for i, v in enumerate(views) if v.fallen)
    lying = views[fell : fell + 101]
    assert all(v is lying[0] for v in lying) and lying[0].qpos[2] < 0.75
    after = views[fell + 101]
    assert not after.fallen and after.qpos[2] > 0.85
    assert not live.reset().fallen and live.view.qpos[2] == pytest.approx(0.95)


# ------------------------------------------------------------------------------------------ picture


def volume(model, geom) -> float:
    """Volume of a primitive geom [m^3]."""
    a, b, c = model.geom_size[geom]
    kinds = mujoco.mjtGeom
    return {
        kinds.mjGEOM_SPHERE: 4 / 3 * np.pi * a**3,
        kinds.mjGEOM_ELLIPSOID: 4 / 3 * np.pi * a * b * c,
        kinds.mjGEOM_BOX: 8 * a * b * c,
        kinds.mjGEOM_CYLINDER: 2 * np.pi * a**2 * b,
        kinds.mjGEOM_CAPSULE: 2 * np.pi * a**2 * b + 4 / 3 * np.pi * a**3,
    }[kinds(model.geom_type[geom])]


def test_meshes_have_the_geoms_size_and_place():
    shapes = pytest.importorskip(
        "kslc_jax.viewer.shapes", reason="the extra 'viewer' is not installed"
    )
    model = robot.load("high").mj_model
    drawn = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    assert len(drawn) > 40
    for geom in drawn:
        mesh = shapes.mesh(model, geom)
        assert mesh.volume == pytest.approx(volume(model, geom), rel=0.03), model.geom(geom).name
        np.testing.assert_allclose(mesh.bounds.mean(0), model.geom_pos[geom], atol=1e-3)


def test_a_mesh_keeps_its_size_and_place():
    """As the links of other robots have it. MuJoCo moves a mesh's origin to its centre."""
    shapes = pytest.importorskip(
        "kslc_jax.viewer.shapes", reason="the extra 'viewer' is not installed"
    )
    spec = mujoco.MjSpec()
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    spec.add_mesh(name="wedge", uservert=corners.flatten(), userface=np.ravel(faces))
    body = spec.worldbody.add_body(pos=[0, 0, 1])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wedge", pos=[0.05, 0, 0])
    mesh = shapes.mesh(spec.compile(), 0)
    assert mesh.volume == pytest.approx(0.3 * 0.2 * 0.1 / 6, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, [[0.05, 0, 0], [0.35, 0.2, 0.1]], atol=1e-6)


@pytest.fixture(scope="module")
def viewer(run_dir):
    """A viewer on a free port. It steps only when a test calls `frame`."""
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from kslc_jax.viewer.app import Viewer

    made = Viewer(run_dir, "train", port=0)
    yield made
    made.server.stop()


def test_figure_follows_or_stays(viewer, xbot):
    qpos = xbot.default_qpos.copy()
    qpos[:2] = 3.0, -2.0
    data = mujoco.MjData(xbot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(xbot.mj_model, data)
    viewer.figure.show(viewer.session.view.replace(qpos=qpos))
    for body, frame in viewer.figure._bodies.items():
        np.testing.assert_allclose(frame.position, data.xpos[body], atol=1e-6)
        np.testing.assert_allclose(frame.wxyz, data.xquat[body], atol=1e-6)
    np.testing.assert_allclose(viewer.figure._world.position, [-3.0, 2.0, 0.0])
    viewer.figure.follow, qpos[0] = False, 4.0
    viewer.figure.show(viewer.session.view.replace(qpos=qpos))
    np.testing.assert_allclose(viewer.figure._world.position, [-3.0, 2.0, 0.0])


def test_panel(viewer):
    panel = viewer.panel
    vx = panel._sliders[0]
    assert (vx.min, vx.max) == (-0.5, 2.0)
    panel._change(np.array([1.9, 0.0, 0.2]))
    panel._change(np.array([0.25, 0.0, 0.2]))
    np.testing.assert_allclose(panel.command, [2.0, 0.0, 0.4])
    panel.allow(1.0)
    assert panel.command[0] == vx.max == 1.5
    panel.allow(1.5)
    panel._stop()
    assert not panel.command.any()


def test_the_panel_chooses_a_shove(viewer):
    """A click on a link selects it."""
    panel, rng = viewer.panel, np.random.default_rng(0)
    assert panel.take_shove(rng) is None
    panel._shove_wanted.set()
    first = panel.take_shove(rng)
    assert first[:2] == ("base_link", panel._newtons.value) and panel.take_shove(rng) is None
    panel._shove_wanted.set()
    assert panel.take_shove(rng)[2] != first[2]  # another random direction
    viewer.figure._choose("left_knee_link")
    panel._direction.value = "left"
    panel._shove_wanted.set()
    assert panel.take_shove(rng) == ("left_knee_link", panel._newtons.value, np.pi / 2)
    panel.offer(viewer.session.links, 1.0)  # the same robot: the choice stays
    assert panel._link.value == "left_knee_link"
    panel.offer(("trunk", "hand"), 0.5)
    assert panel._link.value == "trunk"
    force = panel._newtons  # of half the mass
    assert (force.min, force.max, force.step, force.value) == (25.0, 500.0, 25.0, 100.0)
    panel.offer(viewer.session.links, 1.0)
    assert (force.max, force.value) == (1000.0, 200.0)
    panel._direction.value = "random"


def test_the_camera_fits_the_size_of_the_robot(viewer):
    from kslc_jax.viewer.figure import CAMERA

    biped, shown = robot.load("high", name=BIPED), viewer.figure.robot
    camera = viewer.server.initial_camera
    np.testing.assert_allclose(camera.position, CAMERA)
    viewer.figure.draw(biped)
    np.testing.assert_allclose(camera.position, biped.length_ratio * np.array(CAMERA))
    viewer.figure.draw(shown)


def test_the_robot_follows_the_schedule_until_the_user_commands(viewer, monkeypatch):
    """The sliders show its command. Their own movement is not the user's."""
    box = viewer.server.gui.add_checkbox("Schedule mine", True)
    monkeypatch.setattr(viewer.panel, "_schedule", box)
    monkeypatch.setattr(viewer.session, "schedule", MINE)
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: None})
    viewer.reset()
    viewer.frame(500.0)
    viewer.frame(500.1)
    assert viewer.panel.command is None
    assert [s.value for s in viewer.panel._sliders] == [0.5, 0.0, 0.0]
    viewer.panel._moved(SimpleNamespace(client=object()))
    assert box.value is False and viewer.panel.command[0] == 0.5
    box.value = True
    viewer.panel._change(np.array([0.25, 0.0, 0.0]))  # a key: from the schedule's command on
    viewer.frame(500.2)
    assert viewer._recent[-1].command[0] == pytest.approx(0.75)
    viewer.panel._stop()
    viewer.reset()


def test_frames_step_only_while_watched(viewer, monkeypatch):
    viewer.reset()
    viewer.frame(0.0)
    viewer.frame(0.05)
    assert len(viewer._recent) == 0
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: None})
    viewer.panel._change(np.array([0.5, 0.0, 0.0]))
    viewer.frame(0.10)
    viewer.frame(0.15)
    assert len(viewer._recent) == 10 and viewer._recent[-1].command[0] == 0.5
    assert "of 0.50 commanded, up" in viewer.panel.status.content
    viewer.panel._pause()
    viewer.frame(0.20)
    assert len(viewer._recent) == 10
    viewer.panel._pause()
    viewer.panel._stop()


def test_the_page_says_when_it_is_too_slow(viewer, monkeypatch):
    """Frames come 0.2 s apart, and each simulates at most 0.1 s. This is half of real time: too
    slow at 1x, enough at 0.5x."""
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: None})
    view = viewer.session.view
    monkeypatch.setattr(viewer.session, "advance", lambda *_: view)  # the robot does not matter
    titles = []
    monkeypatch.setattr(viewer.panel._gui, "set_panel_label", titles.append)
    viewer._paced.clear()

    def play(start, apart, frames):
        for i in range(frames):
            viewer.frame(start + i * apart)
        return viewer.panel.status.content

    assert "\nreal-time factor 1.00, train step" in play(1000.0, 0.05, 30)
    assert "**real-time factor 0.50, too slow**, train step" in play(1001.5, 0.2, 40)
    assert titles[-1] == "kslc_jax, 0.50x real time"
    viewer.panel.rate.value = "0.5x"
    assert "\nreal-time factor 0.50, train step" in play(1009.5, 0.2, 40)
    viewer.panel.rate.value = "1x"
    viewer.reset()  # the status of a fallen robot is "fallen", not "paused"
    viewer.panel._pause()
    assert "paused" in play(1017.5, 0.05, 1) and titles[-1] == "kslc_jax"
    viewer.panel._pause()


def test_policies_of_a_run(run_dir):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from kslc_jax.viewer.app import policies

    found = policies(run_dir)
    assert list(found)[:2] == [str(run_dir), "step 2"]
    assert found[str(run_dir)].name == "10" and found["step 2"].name == "2"


def test_switching_policy(viewer):
    viewer.panel.policy.value = "step 2"
    viewer.frame(0.0)
    assert viewer.session.policy.step == 2


# ---------------------------------------------------------------------------------------- following


@pytest.fixture
def training(run_dir, still, tmp_path):
    """A run folder as a training fills it: the checkpoints 2 and 10; it keeps more on request."""
    folder = tmp_path / "r"
    shutil.copytree(run_dir, folder)
    (folder / files.CONFIG).write_text("{}")

    def keep(kind, step):
        reached = still.curriculum.replace(v_max=step / 10)
        policy = dataclasses.replace(still, curriculum=reached, step=step)
        policy_lib.save_policy(policy, folder / kind / str(step))

    keep.folder = folder
    return keep


def test_each_new_policy_is_named_once(training):
    follower = following.Follower(training.folder)
    checkpoints, snapshots = (training.folder / x for x in (files.CHECKPOINTS, files.SNAPSHOTS))
    assert follower.fresh(0.0) == checkpoints / "10"
    training(files.SNAPSHOTS, 12)
    assert follower.fresh(0.5) is None  # it looks once a second
    assert follower.fresh(1.5) == snapshots / "12"
    assert follower.fresh(3.0) is None
    training(files.CHECKPOINTS, 12)
    assert follower.fresh(4.5) is None  # the same policy
    (checkpoints / "14.orbax-checkpoint-tmp-1" / "params").mkdir(parents=True)
    assert follower.fresh(6.0) is None  # half-written
    training(files.CHECKPOINTS, 14)
    assert follower.fresh(7.5) == checkpoints / "14"
    shutil.rmtree(checkpoints / "14")  # the training has gone back
    assert follower.fresh(9.0) == snapshots / "12"


def test_following_waits_for_the_first_checkpoint(training, capsys, monkeypatch):
    hidden = training.folder / "hidden"
    (training.folder / files.CHECKPOINTS).rename(hidden)
    training(files.SNAPSHOTS, 1)
    naps = []

    def sleep(seconds):
        naps.append(seconds)
        if len(naps) == 3:
            hidden.rename(training.folder / files.CHECKPOINTS)

    monkeypatch.setattr(following, "LOOK_SECONDS", 0.0)
    monkeypatch.setattr(following.time, "sleep", sleep)
    assert following.Follower(training.folder).wait().name == "10"
    assert len(naps) == 3 and capsys.readouterr().out.count("waiting for the first") == 1


def test_following_waits_for_the_training(training, tmp_path, capsys, monkeypatch):
    """So that its command and that of the training can be pasted together."""
    run_dir, naps = tmp_path / "runs" / "mine", []

    def sleep(seconds):
        naps.append(seconds)
        if len(naps) == 2:  # the lock comes before the config
            run_dir.mkdir(parents=True)
            (run_dir / files.LOCK).touch()
        if len(naps) == 4:
            shutil.copytree(training.folder, run_dir, dirs_exist_ok=True)

    monkeypatch.setattr(following, "LOOK_SECONDS", 0.0)
    monkeypatch.setattr(following.time, "sleep", sleep)
    assert following.Follower(run_dir).wait() == run_dir / files.CHECKPOINTS / "10"
    said = f"waiting for the first checkpoint in {run_dir}; no training has begun there yet\n"
    assert len(naps) == 4 and capsys.readouterr().out == said


def test_following_does_not_wait_for_several_seeds(tmp_path, monkeypatch):
    run_dir = tmp_path / "mine"

    def sleep(seconds):
        (run_dir / "seed-3").mkdir(parents=True)
        (run_dir / "seed-3" / files.CONFIG).touch()

    monkeypatch.setattr(following.time, "sleep", sleep)
    with pytest.raises(ConfigError, match=r"several trainings, name one: .*/mine/seed-3$"):
        following.Follower(run_dir).wait()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file is no run folder of a training"):
        following.Follower(tmp_path / "file")


def test_the_robot_goes_on_with_a_newer_policy(viewer, training, monkeypatch):
    monkeypatch.setattr(viewer, "_follower", following.Follower(training.folder))
    viewer.panel.policy.value = viewer._given
    viewer.frame(0.0)
    assert viewer.session.policy.step == 10
    for _ in range(5):
        viewer.session.advance(np.zeros(3))
    before = viewer.session.view
    training(files.SNAPSHOTS, 20)
    viewer.frame(2.0)
    assert viewer.session.policy.step == 20 and viewer.session.view is before
    assert viewer.panel._sliders[0].max == pytest.approx(2.5)  # v_max and a margin
    viewer.panel.policy.value = "step 2"  # chosen by hand: it stays
    viewer.frame(4.0)
    training(files.SNAPSHOTS, 30)
    viewer.frame(6.0)
    assert viewer.session.policy.step == 2
    viewer.panel.policy.value = viewer._given
    viewer.frame(8.0)
    assert viewer.session.policy.step == 30


def test_a_policy_that_is_gone_again_is_left_out(viewer, training, monkeypatch):
    monkeypatch.setattr(viewer, "_follower", following.Follower(training.folder))
    step = viewer.session.policy.step
    training(files.SNAPSHOTS, 40)
    shutil.rmtree(training.folder / files.SNAPSHOTS / "40" / "meta")
    viewer.frame(10.0)
    assert viewer.session.policy.step == step


# --------------------------------------------------------------------------------------------- CLI


def test_port_in_use_is_one_line(run_dir, capsys):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert play.main([str(run_dir), "--port", str(port)]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and f"{port}: the port is in use" in err[0]


def test_viewer_not_installed_is_one_line(run_dir, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "kslc_jax.viewer.app", None)
    assert play.main([str(run_dir)]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and "pip install 'kslc_jax[viewer]'" in err[0]


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["no-such-policy"], "no run, checkpoint or shipped policy"),
        (["x", "--port", "70000"], "port must lie in"),
        (["x", "--seconds", "0"], "seconds must be positive"),
        (["x", "--follow", "--video", "x.mp4"], "follow is for the live viewer"),
        (["xbot_l_run", "--follow"], "xbot_l_run is no run folder of a training"),
        (["x", "--punch", "-1"], "punch must be a force in newtons"),
        (["x", "--top", "2"], "top is the fastest command of a schedule"),
        (["x", "--schedule", "stop", "--top", "0"], "top must be a positive speed"),
        (["xbot_l_run", "--schedule", "dance"], "schedule: no file 'dance' (known names: stop"),
        (
            ["x", "--engine", "drake", "--video", "x.gif", "--punch", "200"],
            "punch: drake knows no forces on links",
        ),
        (["x", "--engine", "drake"], "engine: drake is for --gait-strip and --video only"),
    ],
)
def test_errors_are_one_line(argv, says, capsys):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    assert play.main(argv) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and err[0].startswith("error: ") and says in err[0]


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("box", False)],
)
def test_which_addresses_are_local(host, local):
    assert play.is_local(host) is local


def test_caption_writes_into_the_corner():
    black = np.zeros((480, 640, 3), np.uint8)
    written = films.caption(black, "commanded 2.0 m/s\nactual 1.95 m/s")
    assert written.shape == black.shape and written[:100, :320].max() == 255
    assert not written[100:].any() and not written[:, 320:].any()


def test_a_strip_that_fails_leaves_the_models_camera_as_it_was(monkeypatch, xbot):
    from kslc_jax.viewer import render

    def fails(*args, **kwargs):
        raise render.RenderError("no GL")

    monkeypatch.setattr(render, "_renderer", fails)
    camera = robot.load("high").mj_model.vis.global_
    before = camera.fovy
    with pytest.raises(render.RenderError):
        render.gait_strip(xbot, np.tile(xbot.default_qpos, (10, 1)), dt=0.1)
    assert camera.fovy == before != render.LONG_LENS


def test_a_strip_shows_each_window_of_the_ground_once():
    """On a slope of 10 degrees: 7 m away and 16 m away the ground is another window, higher."""
    from kslc_jax.viewer import render

    terrain = perturbations.terrain("slope:10")
    robot_on_slope = robot.load("high", terrain=terrain)
    ground, model = ground_lib.largest(terrain), copy.copy(robot_on_slope.mj_model)
    (floor,) = robot_on_slope.ground_geom_ids
    known: set = set()
    places = [np.array([x, 0.0, 1.0]) for x in (0.0, 2.0, 7.0, 9.0, 16.0)]
    new = [render._put_window(robot_on_slope, model, ground, place, known) for place in places]
    assert new == [True, False, True, False, False]
    rise = 12.0 * np.tan(np.radians(10.0))
    np.testing.assert_allclose(model.geom_pos[floor][:2], [12.0, 0.0], atol=1e-6)
    heights = sorted(place[2] for place in known)
    assert heights[1] - heights[0] == pytest.approx(rise, rel=1e-5)


@pytest.fixture
def blank_renderer(monkeypatch):
    """Replaces the renderer by one that gives black pictures without GL."""
    blank = SimpleNamespace(
        frames=lambda robot, qpos, ground: (np.zeros((480, 640, 3), np.uint8) for _ in qpos)
    )
    monkeypatch.setitem(sys.modules, "kslc_jax.viewer.render", blank)
    monkeypatch.setattr(kslc_jax.viewer, "render", blank, raising=False)


def film_two_speeds(out: Path) -> None:
    """Writes half a second at 1 m/s and half a second at 2 m/s."""
    linvel, command = np.zeros((2, 150, 2, 3))
    linvel[..., 0], command[..., 0] = (0.9, 2.1), (1.0, 2.0)
    trace = SimpleNamespace(
        qpos=np.zeros((150, 2, 23)), linvel=linvel, command=command, ground=None
    )
    films.write_video(out, robot.load("high"), trace, [range(100, 150)] * 2, dt=0.01)


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # imageio, which reads the film
def test_video_carries_the_speeds(blank_renderer, monkeypatch, tmp_path):
    """The film has two speeds, half a second each at 50 frames a second, with text."""
    imageio = pytest.importorskip("imageio.v2", reason="the extra 'video' is not installed")
    pytest.importorskip("imageio_ffmpeg", reason="the extra 'video' is not installed")
    said = []
    write = films.caption
    monkeypatch.setattr(films, "caption", lambda p, text: said.append(text) or write(p, text))
    film_two_speeds(tmp_path / "out.mp4")
    frames = imageio.mimread(tmp_path / "out.mp4", memtest=False)
    assert len(frames) == 50 and max(f.max() for f in frames) > 200
    assert set(said) == {
        "commanded 1.0 m/s\nactual 0.90 m/s",
        "commanded 2.0 m/s\nactual 2.10 m/s",
    }


@pytest.mark.parametrize("suffix", films.ANIMATIONS)
def test_animations_last_as_long_and_repeat(suffix, blank_renderer, monkeypatch, tmp_path):
    """Every fourth of 2 x 50 steps of 10 ms is a picture of 40 ms. The file may store equal
    pictures as one longer picture, so the test checks the total time. imageio_ffmpeg is not
    needed."""
    from PIL import Image, ImageSequence

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    film_two_speeds(tmp_path / f"out{suffix}")
    with Image.open(tmp_path / f"out{suffix}") as film:
        assert film.size == (640, 480) and film.is_animated and film.info["loop"] == 0
        shown = [(f.load(), f.info["duration"])[1] for f in ImageSequence.Iterator(film)]
        assert sum(shown) == 2 * 13 * 40 and np.asarray(film.convert("L")).max() > 200


@pytest.mark.parametrize(
    ("fall", "steps"), [(150, (100, 150)), (120, (70, 120)), (30, (0, 30)), (0, (0, 1))]
)
def test_what_is_shown_ends_with_the_fall(fall, steps):
    assert films.shown(np.arange(150) < fall, start=100) == range(*steps)


def test_where_nothing_can_be_written_nothing_is_simulated(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(play, "record", None)
    (tmp_path / "file").touch()
    for name, out in (("gait-strip", "out.png"), ("video", "out.mp4")):
        assert play.main(["xbot_l_run", f"--{name}", str(tmp_path / "file" / out)]) == 2
        assert "cannot write" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "kslc_jax.viewer.render", SimpleNamespace())
    monkeypatch.setattr(kslc_jax.viewer, "render", SimpleNamespace(), raising=False)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"pip install 'kslc_jax\[video\]'"):
        play.draw(play.Args(Path("x"), video=tmp_path / "out.mp4"), None)


@pytest.mark.slow(reason="a process of its own")
def test_a_gl_that_does_not_work_is_named(tmp_path):
    command = [
        *(sys.executable, "-m", "kslc_jax.play", "xbot_l_run", "--speeds", "1", "--seconds", "0.1"),
        *("--gait-strip", str(tmp_path / "never.png")),
    ]
    env = {**os.environ, "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "nonsense"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith("error: ")


# -------------------------------------------------------------------------------------------- page


@pytest.mark.slow(reason="a minute: a browser that draws in software")
def test_the_page(run_dir):
    """In a real browser there is no error, the picture shows the robot, and slider and key change
    the command."""
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    browser_path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser_path is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    from kslc_jax.viewer.app import Viewer

    made = Viewer(run_dir, "train", port=0)
    stop = threading.Event()

    def serve():
        while not stop.wait(0.03):
            made.frame(time.monotonic())

    thread = threading.Thread(target=serve)
    thread.start()
    errors = []
    try:
        with playwright.sync_playwright() as p:
            software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = p.chromium.launch(
                executable_path=browser_path, args=["--no-sandbox", *software]
            )
            page = browser.new_page(viewport={"width": 900, "height": 700})
            page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(f"http://127.0.0.1:{made.server.get_port()}")
            page.get_by_text("commanded, ").wait_for()
            # While viser connects, it shows its own address in a text field.
            vx = page.locator("input[inputmode=decimal]:visible").first
            vx.fill("0.75")
            vx.press("Enter")
            page.get_by_text("of 0.75 commanded").wait_for()
            page.mouse.click(20, 650)
            page.keyboard.press("i")
            page.get_by_text("of 1.00 commanded").wait_for()
            picture = page.screenshot(timeout=60_000, clip=dict(x=0, y=0, width=500, height=700))
            browser.close()
    finally:
        stop.set()
        thread.join()
        made.server.stop()
    assert errors == []
    assert colours_of_the_robot(picture) > 0.005


def colours_of_the_robot(png: bytes) -> float:
    """Share of the pixels of a picture that have the orange of the joints."""
    from PIL import Image

    rgb = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
    orange = (rgb[..., 0] - rgb[..., 2] > 80) & (rgb[..., 0] > rgb[..., 1])
    return float(orange.mean())
