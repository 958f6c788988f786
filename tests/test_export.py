"""Exported files against JAX, and the stand-alone runner of exported files against the package."""

import copy
import dataclasses
import functools
import importlib.util
import json
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import slow
from states import ACTOR, MIRROR, XBOT

from kslc_jax import (
    checkpoint_format,
    contract,
    curriculum,
    env,
    export,
    motors,
    networks,
    observations,
    physics,
    randomize,
)
from kslc_jax import policy as policy_lib
from kslc_jax.config import XBOT_L, ConfigError, PhysicsConfig, preset
from kslc_jax.evaluation import trials
from kslc_jax.robots import description

SCALE = np.array(([0.25] * 4 + [0.85] * 2) * 2 + [0.25] * 4)
"""rad per unit of action. The ankles: 0.15 x 85 N m / (15 N m/rad)."""
RUNNER = Path(__file__).parents[1] / "examples" / "onnx_runner.py"
V_MAX, CYCLE = 2.0, 0.55
ROBOTS = 8
STEPPED = dataclasses.replace(
    preset("debug").physics, engine="mujoco", timestep=0.001, decimation=10
)
"""Physics of the runner: C MuJoCo with steps of 1 ms, as at high fidelity."""


@functools.cache
def make_policy(kind):
    """A policy with random parameters that stands for a second. Its curriculum is past the start.

    symmetric: a mirror-symmetric network, with the clock and commands of the laptop preset. plain:
    an ordinary network, with the clock and commands of the paper, and held arms.
    """
    config, paper = preset("debug"), preset("paper")
    if kind == "plain":
        config = dataclasses.replace(
            config,
            env=dataclasses.replace(config.env, arms="held"),
            network=dataclasses.replace(config.network, symmetric=False, estimator=()),
            gait=paper.gait,  # its reference pose moves no arms
            command=paper.command,
        )
    config = dataclasses.replace(config, physics=PhysicsConfig(engine="mujoco"))
    params = jax.jit(networks.init, static_argnums=0)(config, jax.random.key(0))
    bias = jax.random.normal(jax.random.key(1), (32,))  # fresh networks have none
    params = jax.tree.map(lambda x: x + 0.5 * bias[: x.size] if x.ndim == 1 else x, params)
    reached = curriculum.init(config).replace(
        v_max=jnp.asarray(V_MAX), cycle_time=jnp.asarray(CYCLE)
    )
    return policy_lib.Policy(config, params, reached, 7)


@pytest.fixture(scope="module")
def symmetric():
    return make_policy("symmetric")


@pytest.fixture(scope="module", params=["symmetric", "plain"])
def policy(request):
    return make_policy(request.param)


@pytest.fixture(scope="module", params=["symmetric", *slow.cases("compiles again", "plain")])
def acting(request):
    """`policy` for tests that compile its golden trace."""
    return make_policy(request.param)


@pytest.fixture(scope="module")
def onnx_file(policy, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "policy.onnx"
    path.write_bytes(export.to_onnx(policy))
    return path


@pytest.fixture(scope="module")
def runner():
    spec = importlib.util.spec_from_file_location("onnx_runner", RUNNER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def histories(policy, batch=5):
    shape = batch, policy.config.env.frames, observations.actor_width(XBOT)
    return np.asarray(jax.random.normal(jax.random.key(1), shape))


# ------------------------------------------------------------------------------------- the network


@pytest.mark.parametrize("form", ["onnx", "stablehlo"])
def test_the_file_acts_as_the_policy(policy, form, tmp_path):
    path = tmp_path / "policy"
    path.write_bytes(export.WRITE[form](policy))
    network = export.READ[form](path)
    for batch in (1, 5):
        seen = histories(policy, batch)
        wanted = networks.policy(policy.config, policy.params, seen).mean
        got = network(seen)
        assert got.shape == (batch, 16) and got.dtype == np.float32
        np.testing.assert_allclose(got, wanted, atol=2e-6)
        assert np.abs(wanted).max() > 0.3


def test_onnxruntime_gets_the_processors_that_are_allowed(onnx_file, monkeypatch):
    opened, seen = onnxruntime.InferenceSession, []
    monkeypatch.setattr(export.processors, "usable", lambda: 3)
    monkeypatch.setattr(
        onnxruntime, "InferenceSession", lambda *how, **on: seen.append(opened(*how, **on))
    )
    export.read_onnx(onnx_file)
    assert seen[0].get_session_options().intra_op_num_threads == 3


def test_the_symmetric_actor_as_a_plain_mlp_mirrors(symmetric, tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes(export.to_onnx(symmetric))
    network = export.read_onnx(path)
    permutation, sign = observations.mirror_map(ACTOR, XBOT)
    joints, joint_sign = MIRROR
    seen = histories(symmetric)
    mirrored = (seen[..., permutation] * sign).astype(np.float32)
    np.testing.assert_allclose(network(mirrored), network(seen)[:, joints] * joint_sign, atol=2e-6)


def test_the_graph_estimates_the_velocity_and_then_acts(policy, onnx_file):
    model = onnx.load(onnx_file)
    estimator = ["Gemm", "Elu", "Gemm", "Concat"] if policy.config.network.estimator else []
    actor = ["Gemm", "Elu"] * 2 + ["Gemm"]
    assert [n.op_type for n in model.graph.node] == ["Flatten", *estimator, *actor]
    (history,), (action,) = model.graph.input, model.graph.output
    dims = [d.dim_param or d.dim_value for d in history.type.tensor_type.shape.dim]
    assert dims == ["batch", 3, 59]
    assert [d.dim_param or d.dim_value for d in action.type.tensor_type.shape.dim] == ["batch", 16]
    assert model.opset_import[0].version == 17 and model.ir_version == 8


def test_metadata(symmetric, xbot):
    """The numbers are typed by hand where the paper or Humanoid-Gym gives them."""
    data = contract.metadata(symmetric)
    assert data["metadata_version"] == 5 and data["train_step"] == 7
    assert tuple(data["joint_names"]) == xbot.joint_names
    assert data["kp"][:6] == [200, 200, 350, 350, 15, 15] and data["kd"] == [10] * 16
    assert data["effort_limit"][3] == 212.5
    assert data["speed_limit"] == [12] * 12 + [7] * 4
    assert data["default_joint_pos"] == [0] * 16 and data["control_dt"] == 0.01
    assert data["action_scale"] == pytest.approx(SCALE) and data["action_clip"] == 18
    assert data["history_length"] == 3 and data["observation_clip"] == 18
    assert sum(c["width"] for c in data["frame"]) == observations.actor_width(XBOT)
    assert data["frame"][1] == {"name": "command", "width": 3, "scale": (2, 2, 1)}
    assert data["gait"] == {
        "cycle_time": pytest.approx(CYCLE),
        "v_max": V_MAX,
        "cycle_follows_speed": False,
        "base_cycle_time": 0.64,
        "cycle_from_speed": 0.5,
        "cycle_factor": 0.94,
        "speed_step": 0.5,
    }
    assert data["command"]["stand_still"] and data["command"]["dead_zone"] == 0.2
    assert data["held_joints"] == []


def test_the_file_holds_the_metadata_as_json(policy, onnx_file):
    stored = {p.key: json.loads(p.value) for p in onnx.load(onnx_file).metadata_props}
    assert stored == json.loads(json.dumps(contract.metadata(policy)))


def test_held_arms_are_named():
    held = contract.metadata(make_policy("plain"))["held_joints"]
    assert len(held) == 4 and all("shoulder" in name or "elbow" in name for name in held)


# ---------------------------------------------------------------------------------- the comparison


def test_a_wrong_file_is_found(symmetric, monkeypatch, tmp_path):
    monkeypatch.setattr(export, "recorded", histories)
    other = dataclasses.replace(
        symmetric, params=jax.tree.map(lambda x: x * 1.0001, symmetric.params)
    )
    path = tmp_path / "other.onnx"
    path.write_bytes(export.to_onnx(other))
    with pytest.raises(ConfigError, match="differs from JAX"):
        export.compare(symmetric, path, "onnx")


def test_without_onnxruntime_it_says_so(policy, onnx_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    said = export.compare(policy, onnx_file, "onnx")
    assert "not compared" in said and "onnxruntime" in said and "pip install" in said


# -------------------------------------------------------------------------------- the command line


@pytest.fixture(scope="module")
def saved(symmetric, tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies") / "saved"
    policy_lib.save_policy(symmetric, folder)
    return folder


@pytest.fixture(scope="module")
def contracted(acting, tmp_path_factory):
    """The exported file with its data, robot and a golden trace of a second beside it."""
    onnx_file = tmp_path_factory.mktemp("contract") / "policy.onnx"
    onnx_file.write_bytes(export.to_onnx(acting))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contract, "golden", functools.partial(contract.golden, seconds=1.0))
        written = contract.write(acting, onnx_file)
    assert [path.name for path in written] == ["policy.json", "policy.xml", "policy.npz"]
    return onnx_file


def test_no_exported_file_names_a_folder(symmetric, saved, contracted):
    """Not the package's, nor that of Python and its packages, of the temporary files, of the user.
    StableHLO keeps the names of the source files."""
    stablehlo = export.to_stablehlo(symmetric)
    assert b"networks.py" in stablehlo and b"/networks.py" not in stablehlo
    stored = [path for path in saved.rglob("*") if path.is_file()]
    beside = [contracted.with_suffix(x) for x in (".onnx", ".json", ".xml", ".npz")]
    assert len(stored) > 5
    found = {path: path.read_bytes() for path in stored + beside} | {"stablehlo": stablehlo}
    trace = np.load(contracted.with_suffix(".npz"))
    assert all(trace[name].dtype.kind in "fi" for name in trace)  # numbers; the file is packed
    package = Path(export.__file__).parents[1]
    private = {package, sys.prefix, Path(jax.__file__).parents[1], saved.parent, contracted.parent}
    private |= {Path.home(), Path(tempfile.gettempdir())}
    for where, content in found.items():
        assert not [folder for folder in private if f"{folder}/".encode() in content], where


def test_a_policy_folder_is_the_whole_policy(symmetric, saved):
    back = policy_lib.load_policy(saved)
    assert back.config == symmetric.config and back.step == symmetric.step
    jax.tree.map(np.testing.assert_array_equal, back.params, symmetric.params)
    jax.tree.map(np.testing.assert_array_equal, back.curriculum, symmetric.curriculum)
    with pytest.raises(checkpoint_format.CheckpointError, match="cannot write"):
        policy_lib.save_policy(symmetric, saved)


def test_orbax_has_to_be_asked_for(saved, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(export, "recorded", histories)
    out = tmp_path / "mine"
    assert export.main([str(saved), str(out), "--format", "orbax"]) == 0
    assert "equals JAX within 0.0e+00" in capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir() if p.is_dir()) == ["meta", "params"]


@pytest.mark.slow(reason="compiles the trials whose observations it records")
def test_command_line(saved, tmp_path, capsys, monkeypatch):
    seen, recorded = [], export.recorded
    monkeypatch.setattr(export, "recorded", lambda p: seen.append(recorded(p)) or seen[0])
    monkeypatch.setattr(contract, "golden", lambda policy: {})
    out = tmp_path / "new folder" / "policy.onnx"
    assert export.main([str(saved), str(out)]) == 0
    said = capsys.readouterr().out
    assert "over 1000 recorded observations" in said and str(out) in said
    assert onnx.load(out).producer_name == "kslc_jax"
    assert seen[0].shape == (1000, 3, 59)
    newest = seen[0][:, -1]
    assert len(np.unique(newest, axis=0)) > 900  # a policy that acts, under several commands
    assert len(np.unique(newest[:, 2])) > 3


def test_stablehlo_has_its_metadata_beside_it(saved, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(export, "recorded", histories)
    monkeypatch.setattr(contract, "golden", lambda policy: {})
    out = tmp_path / "policy.bin"
    assert export.main([str(saved), str(out), "--format", "stablehlo"]) == 0
    assert "equals JAX within" in capsys.readouterr().out
    beside = json.loads((tmp_path / "policy.json").read_text())
    assert beside["gait"]["v_max"] == V_MAX and beside["latency_budget"] == 0.005


def test_errors_are_one_line(saved, tmp_path, capsys):
    damaged = tmp_path / "damaged"
    (damaged / "params").mkdir(parents=True)
    a_file = tmp_path / "file"
    a_file.touch()
    for policy, out, says in (
        (saved, "policy.pt", "neither .onnx nor .stablehlo"),
        ("no-such-policy", "policy.onnx", "no run, checkpoint or shipped policy"),
        (damaged, tmp_path / "policy.onnx", "no readable checkpoint"),
        (saved, a_file / "policy.onnx", str(a_file)),
        (saved, tmp_path, "neither .onnx nor .stablehlo"),
    ):
        assert export.main([str(policy), str(out)]) == 2
        err = capsys.readouterr().err.strip().splitlines()
        assert len(err) == 1 and err[0].startswith("error: ") and says in err[0], err


def test_onnx_missing_is_one_line(saved, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert export.main([str(saved), str(tmp_path / "policy.onnx")]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and "pip install 'kslc_jax[export]'" in err[0]


# ---------------------------------------------------------------------------------------- runner


@pytest.fixture(scope="module")
def trajectory(policy):
    """101 states of `ROBOTS` environments from the default pose, each with its own command."""
    config = trials.trial_config(policy.config, trials.Setting(STEPPED), ROBOTS)
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, reset_joint_noise=0.0))

    def run(key):
        reset = jax.vmap(lambda k: env.reset(config, k, policy.curriculum))
        return jax.lax.scan(one, reset(jax.random.split(key, ROBOTS)), None, length=101)[1]

    def one(states, _):
        def step(state):
            action, key = policy.act_on(state.history), jax.random.key(0)
            return env.step(config, state, action, key, policy.curriculum)[0]

        return jax.vmap(step)(states), states

    return jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(3)))


def controller_of(runner, path, states, i):
    """A controller of the runner with command and phase of the start of environment `i`."""
    command = states.command
    vx, vy = command.wanted[0, i].tolist()
    controller = runner.Controller(path, vx, vy, command.heading[0, i])
    controller.phase = float(states.gait.phase[0, i])
    return controller


@pytest.mark.slow(reason="compiles a rollout; the golden trace has the same frames")
def test_the_runners_frames_are_the_packages(runner, policy, onnx_file, trajectory):
    """The runner has its own code for observations. All frames of one second are compared."""
    qpos, qvel = trajectory.physics.qpos, trajectory.physics.qvel
    assert (trajectory.time == np.arange(len(qpos))[:, None]).all()  # no robot has fallen
    assert trajectory.command.moving.all() != policy.config.command.stand_still
    for i in range(ROBOTS):
        controller = controller_of(runner, onnx_file, trajectory, i)
        for q, v, history in zip(qpos[:, i], qvel[:, i], trajectory.history[:, i], strict=True):
            controller.targets(q[3:7], v[3:6], q[7:], v[6:])
            np.testing.assert_allclose(controller.history, history, atol=1e-5)


@pytest.mark.slow(reason="compiles a rollout")
def test_the_runner_moves_as_the_package_does(runner, onnx_file, trajectory):
    """The runner simulates 0.8 s alone: actions, torques, servos, physics steps. Its model is the
    package's, where parts meet: the legs of a random policy do."""
    steps = 80
    model = copy.copy(physics.robot_for(STEPPED).mj_model)
    for i in range(ROBOTS):
        controller = controller_of(runner, onnx_file, trajectory, i)
        track = runner.simulate(controller, model, 0.01 * steps)
        wanted = trajectory.physics.qpos[: steps + 1, i, :3]
        np.testing.assert_allclose(track, wanted, atol=1e-4)


@pytest.fixture(scope="module")
def checker():
    spec = importlib.util.spec_from_file_location("check_trace", RUNNER.with_name("check_trace.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_golden_trace_is_what_its_policy_does(acting, contracted):
    policy, trace = acting, np.load(contracted.with_suffix(".npz"))
    np.testing.assert_allclose(trace["command"][:, 0], np.array([0, 0.25, 0.5]) * V_MAX, rtol=1e-6)
    assert trace["steps"].min() > 50 and trace["target"].shape == (3, 100, 16)
    clock = np.abs(trace["frame"][:, 0, :2]).max(axis=1)  # off while it stands
    assert (clock > 0.5).tolist() == [not policy.config.command.stand_still, True, True]
    frames = np.zeros((3, *policy.init().history.shape), np.float32)
    act = jax.jit(jax.vmap(policy.act_on))
    for step in range(int(trace["steps"].min())):
        frames = np.concatenate([frames[:, 1:], trace["frame"][:, step, None]], axis=1)
        action = np.clip(np.asarray(act(frames)), -18, 18)
        held = policy.config.env.arms == "held"
        action[:, XBOT.is_arm] *= not held
        np.testing.assert_allclose(trace["action"][:, step], action, atol=1e-5)
    np.testing.assert_allclose(trace["target"], SCALE * trace["action"], atol=1e-6)


def test_the_runner_follows_the_golden_trace(runner, checker, contracted):
    assert checker.first_difference(runner.Controller, contracted, 1e-4) is None


def test_the_data_name_the_robot_and_the_other_files(acting, checker, contracted, tmp_path):
    data = json.loads(contracted.with_suffix(".json").read_text())
    assert data["robot"] == "XBot-L" and set(data["sha256"]) == {".onnx", ".xml", ".npz"}
    model = mujoco.MjModel.from_xml_path(str(contracted.with_suffix(".xml")))
    ranges = np.array([model.joint(name).range for name in data["joint_names"]])
    np.testing.assert_allclose(np.c_[data["joint_lower"], data["joint_upper"]], ranges, atol=1e-6)
    assert checker.foreign_file(contracted) is None
    for path in contracted.parent.iterdir():  # under another name, as a whole
        shutil.copy(path, tmp_path / f"run{path.suffix}")
    assert checker.foreign_file(tmp_path / "run.onnx") is None
    for suffix in (".onnx", ".xml", ".npz"):
        changed = tmp_path / f"run{suffix}"
        before = changed.read_bytes()
        changed.write_bytes(before[:-1] + b"x")
        assert checker.foreign_file(tmp_path / "run.onnx") == changed
        changed.write_bytes(before)


def test_the_checker_gives_the_recorded_actions(runner, checker, contracted):
    """So an error of one step does not reach the next one, in which it would grow."""

    class Forgetful(runner.Controller):
        def targets(self, *measured):
            target = super().targets(*measured)
            self.action = self.action + 0.1
            return target

    assert checker.first_difference(Forgetful, contracted, 1e-4) is None


def test_the_checker_names_the_first_wrong_target(runner, checker, contracted):
    """A program that mixes up two joints, and one that forgets to advance its clock."""

    class Mixed(runner.Controller):
        def targets(self, *measured):
            target = super().targets(*measured)
            return target if self.history[0].any() else target + 0.001 * np.eye(16)[3]

    class Stopped(runner.Controller):
        def targets(self, *measured):
            phase, target = self.phase, super().targets(*measured)
            self.phase = phase
            return target

    said = checker.first_difference(Mixed, contracted, 1e-4)
    assert said.startswith("trial 0 (vx 0.00 m/s), step 0 (0.00 s): left_knee_joint should go to ")
    said = checker.first_difference(Stopped, contracted, 1e-5)
    assert re.match(r"trial \d \(vx \d\.\d\d m/s\), step [1-9]\d* ", said)


def test_the_runner_refuses_a_timestep_that_does_not_fill_the_control_step(runner, onnx_file):
    model = mujoco.MjModel.from_xml_path(str(description.read(XBOT_L).mjcf))
    controller = runner.Controller(onnx_file, 0.0)
    for timestep in (0.003, 0.004, 0.0015, 0.02):
        model.opt.timestep = timestep
        with pytest.raises(SystemExit, match=rf"^error: timestep {timestep} s does not divide .*"):
            runner.simulate(controller, model, 0.1)
    counts = [runner.steps_per_control(0.01, x) for x in (0.001, 0.0005, 0.01 / 3, 0.005, 0.01)]
    assert counts == [10, 20, 3, 2, 1]


def test_the_runners_clock_takes_the_measured_time(runner, onnx_file):
    """A control step that took twice as long moves the gait by twice as much."""
    measured = (np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(16), np.zeros(16))
    once, twice = (runner.Controller(onnx_file, 1.0) for _ in range(2))
    once.targets(*measured)
    once.targets(*measured)
    twice.targets(*measured, dt=2 * twice.meta.control_dt)
    assert twice.phase == pytest.approx(once.phase) and once.phase > 0


def test_the_runner_walks_on_at_the_edge_of_the_dead_zone(runner, onnx_file):
    controller = runner.Controller(onnx_file, 0.19)
    assert controller.meta.command.dead_zone == 0.2
    seen = []
    for vx in (0.21, 0.19, -0.181, 0.179, 0.19):
        controller.command(vx)
        seen.append(round(float(controller.wanted[0]), 3))
    assert seen == [0.21, 0.2, -0.2, 0.0, 0.0]


def test_the_runner_does_not_turn_back_and_forth_while_it_stands(runner, onnx_file):
    """A turn on the spot begins above 0.1 rad/s, 0.2 rad from the heading. Once it has ended it
    begins again only with another command, as in training."""
    controller = runner.Controller(onnx_file, 0.0, heading=0.3)
    command = controller.meta.command
    assert (command.turning, command.heading_gain) == (0.1, 0.5)

    def turns(yaw):
        quat = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        return controller.frame(quat, np.zeros(3), np.zeros(16), np.zeros(16))[4] != 0.0

    marches = not command.stand_still  # and shows its yaw rate at any time
    turned = [turns(yaw) for yaw in (0.0, 0.05, 0.11, 0.05, -0.5)]
    assert turned == [True, True, marches, marches, marches]
    controller.command(0.0, heading=0.3)  # the same as before
    assert turns(-0.5) == marches
    controller.command(0.0, heading=0.31)
    assert turns(-0.5) and turns(0.0)


def test_the_runner_refuses_another_robot(runner, policy, onnx_file, tmp_path, capsys, monkeypatch):
    """Its MJCF has another order of joints or servos, other joints or other gains."""
    text = contract.mjcf(policy)
    line = {name: re.search(f'<general name="{name}".*\n', text)[0] for name in XBOT.joint_names}
    knee, yaw = line["left_knee_joint"], line["left_leg_yaw_joint"]
    assert 'gainprm="350" biasprm="0 -350 ' in knee
    swapped = text.replace(knee, "KNEE").replace(yaw, knee).replace("KNEE", yaw)
    meta = runner.SimpleNamespace(**contract.metadata(policy))
    for changed, says in (
        (text, None),
        (swapped, "the joint of actuator 1 is left_knee_joint, not left_leg_yaw_joint"),
        (text.replace(yaw, ""), "the joint of actuator 1 is left_leg_pitch_joint, not left_leg_y"),
        (
            text.replace("left_knee_joint", "left_knee"),
            "joint 3 is left_knee, not left_knee_joint",
        ),
        (text.replace(knee, knee.replace("350", "700")), "the gain of left_knee_joint is 700, not"),
        (text.replace(knee, knee.replace("-350", "-70")), "the gain of left_knee_joint is 70, not"),
    ):
        said = runner.difference(meta, mujoco.MjModel.from_xml_string(changed))
        assert said == says or said.startswith(says)
    path = tmp_path / "other.xml"
    path.write_text(swapped)
    monkeypatch.setattr(sys, "argv", ["runner", str(onnx_file), "--model", str(path)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(RUNNER), run_name="__main__")
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.count("\n") == 1
    assert said.startswith(f"error: {path} is not the robot of {onnx_file}: the joint of actuator")


def test_motor_torque_is_the_packages(runner, symmetric, xbot):
    rng = np.random.default_rng(0)
    q, target = rng.uniform(-1, 1, (2, 200, 16))
    dq = rng.uniform(-20, 20, (200, 16))
    one = jax.tree.map(np.asarray, randomize.nominal(XBOT))
    meta = runner.SimpleNamespace(**contract.metadata(symmetric))
    np.testing.assert_allclose(
        runner.motor_torque(meta, target, q, dq),
        motors.motor_torque(xbot, one, q, dq, target, np),
        atol=1e-9,
    )


def test_the_runner_alone(contracted, tmp_path):
    """In a separate process, outside the repository, without JAX and kslc_jax."""
    check = (
        "import runpy, sys; sys.argv = sys.argv[1:];"
        "runpy.run_path(sys.argv[0], run_name='__main__');"
        "assert not {'jax', 'kslc_jax', 'flax', 'onnx'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", check, str(RUNNER), str(contracted), "--seconds", "4"],
        capture_output=True, text=True, cwd=tmp_path, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "mean forward speed" in done.stdout and "fell after" in done.stdout
