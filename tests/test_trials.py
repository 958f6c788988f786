"""Trials of a policy under fixed commands, and the numbers drawn from them."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import slow
from states import ACTOR, still_policy

from kslc_jax import commands, env, evaluate, observations
from kslc_jax import policy as policy_lib
from kslc_jax.config import ConfigError, HighFidelity, PhysicsConfig, preset
from kslc_jax.evaluation import gait_metrics, trials

DT = 0.01
C_MUJOCO = PhysicsConfig(engine="mujoco")


@pytest.fixture(scope="module")
def still():
    return still_policy(dataclasses.replace(preset("debug"), physics=C_MUJOCO))


@pytest.mark.parametrize(
    "physics",
    [HighFidelity(), *slow.cases("compiles, like high fidelity", C_MUJOCO)],
)
def test_servos_alone_stand_a_second_and_then_fall(still, physics):
    """Bare servos fall after about two seconds at either fidelity; what fell stays fallen."""
    setting = trials.Setting(physics, seconds=5.0)
    trace = trials.join(list(trials.run(still, setting, np.zeros((4, 3)))))
    assert trace.alive.shape == (500, 4) and trace.qpos.shape == (500, 4, 23)
    assert trace.alive[:80].all() and not trace.alive[-1].any()
    assert not np.any(np.diff(trace.alive.astype(int), axis=0) > 0)
    weight = (trace.contact[30:80]).mean()
    assert weight > 0.9


@pytest.mark.parametrize(("decimation", "steps"), [(2, 10), (4, 20), (3, 15)])
def test_high_fidelity_keeps_the_policys_control_step(still, decimation, steps):
    physics = dataclasses.replace(C_MUJOCO, decimation=decimation)
    policy = dataclasses.replace(still, config=dataclasses.replace(still.config, physics=physics))
    high = trials.engine(policy, "high")
    assert high.timestep == 0.001 and high.decimation == steps
    assert high.control_dt == pytest.approx(policy.config.control_dt)


def test_a_control_step_that_high_fidelity_cannot_have_is_refused(still):
    physics = dataclasses.replace(C_MUJOCO, timestep=0.0025, decimation=3)
    policy = dataclasses.replace(still, config=dataclasses.replace(still.config, physics=physics))
    with pytest.raises(ConfigError, match=r"control step of 0\.0075 s"):
        trials.engine(policy, "high")


def test_commands_hold(still):
    """The commanded velocity reaches the frames, at 2 m/s^2; a yaw rate keeps the heading ahead."""
    setting = trials.Setting(C_MUJOCO, seconds=1.0)
    config = trials.trial_config(still.config, setting, 2)
    assert config.command.resample_seconds >= 10.0 and config.env.noise_level == 0.0
    assert config.randomize.push_seconds == 0.0
    reset, step = (jax.jit(x, static_argnums=0) for x in (env.reset, env.step))
    at = observations.slices(ACTOR)["command"]
    for wanted in ([1.5, 0.0, 0.0], [0.5, -0.3, 0.0], [1.0, 0.0, 0.4]):
        state = reset(config, jax.random.key(1), still.curriculum)
        for i in range(1, 4):
            state = trials.with_command(config, state, jnp.array(wanted))
            state, _ = step(config, state, jnp.zeros(16), jax.random.key(2), still.curriculum)
            seen = state.history[-1, at] / np.array([2.0, 2.0, 1.0])
            due = np.array(wanted[:2]) * 0.02 * i / np.hypot(*wanted[:2])
            np.testing.assert_allclose(seen[:2], due, atol=1e-6)
            np.testing.assert_allclose(seen[2], wanted[2], atol=0.01)  # one step turns the robot


@pytest.mark.parametrize("rate", [0.3, 3.0, -3.0])
def test_a_yaw_rate_never_turns_the_other_way(still, rate):
    """A rate of 3 rad/s would ask for a heading 6 rad ahead, which is 0.28 rad behind."""
    state = env.reset(still.config, jax.random.key(1), still.curriculum)
    held = trials.with_command(still.config, state, jnp.array([0.0, 0.0, rate]))
    steered = commands.steer(still.config.command, held.command, jnp.zeros(()), 0.01)
    assert float(steered.velocity[2]) == pytest.approx(np.clip(rate, -1.0, 1.0), abs=1e-5)


def test_a_turn_that_has_ended_begins_again_only_with_another_command(still):
    """A robot that stands at a heading of 0 and is turned by 0.5 rad."""
    state = env.reset(still.config, jax.random.key(1), still.curriculum)

    def steps(yaw, heading=0.0, vx=0.0):
        """True if the robot may step under this command, at this yaw [rad]."""
        nonlocal state
        state = trials.with_command(still.config, state, jnp.array([vx, 0.0, 0.0]), heading)
        command = commands.steer(still.config.command, state.command, jnp.asarray(yaw), 1.0)
        state = state.replace(command=command)
        return bool(command.moving)

    assert still.config.command.stand_still and steps(0.5, vx=0.5)
    assert [steps(0.5), steps(0.5), steps(0.1), steps(0.5)] == [True, True, False, False]
    assert [steps(0.5, heading=0.01), steps(0.0, heading=0.01)] == [True, False]
    assert [steps(0.5, heading=0.01, vx=0.5), steps(0.5, heading=0.01)] == [True, True]


def test_one_trial_has_no_interval_and_a_rest_no_stride(xbot):
    trace = synthetic()
    one = jax.tree.map(lambda x: x[:, :1], trace)
    assert "forward_mean_ci" in gait_metrics.speed(trace, 2.0, DT)
    assert not [name for name in gait_metrics.speed(one, 2.0, DT) if name.endswith("_ci")]
    rest = trace.replace(linvel=0.01 * trace.linvel)
    assert "stride_length" not in gait_metrics.strides(rest, DT)


def synthetic(seconds=11.6, frequency=1.25, speed=2.0):
    """Two robots with perfect alternating steps: duty 40 %, so 20 % of the time in flight.

    9.6 s are left after settling: twelve whole cycles."""
    t = np.arange(0, seconds, DT)
    n, steps = 2, len(t)
    cycle = round(1.0 / (frequency * DT))  # in steps, so that rounding favours no side
    shifts = (cycle // 4, cycle // 4 + cycle // 2)  # nobody lands at the first sample that counts
    left, right = ((np.arange(steps) + shift) % cycle < 0.4 * cycle for shift in shifts)
    contact = np.stack([left, right], -1)[:, None].repeat(n, 1)
    q = np.zeros((steps, n, 23))
    swing = np.sin(2 * np.pi * frequency * t)[:, None]
    q[..., 7 + 2], q[..., 7 + 8] = 0.5 * swing, 0.5 * swing  # hips: mirrored axes
    q[..., 7 + 12], q[..., 7 + 14] = -0.3 * swing, -0.3 * swing  # shoulders against them
    zeros = np.zeros((steps, n, 3))
    return trials.Trace(
        alive=np.ones((steps, n), bool),
        mass=np.full((steps, n), 53.036),
        qpos=q,
        linvel=zeros + np.array([speed, 0, 0]),
        angvel=zeros,
        euler=zeros,
        joint_vel=np.zeros((steps, n, 16)),
        torque=np.ones((steps, n, 16)),
        contact=contact,
        foot_height=np.where(contact, 0.05, 0.15),
        angular_momentum=zeros + np.array([0.0, 3.0, 4.0]),
        command=zeros + np.array([speed, 0, 0]),
        leg=np.zeros((steps, n), int),
    )


def test_metrics_of_a_known_gait(xbot):
    m = gait_metrics.summary(synthetic(), 2.0, xbot, DT)
    assert gait_metrics.speed(synthetic(), 1.5, DT)["forward_bias"] == pytest.approx(0.5)
    assert "seconds_to_fall" not in m
    assert m["survival"] == 1.0 and m["forward_mean"] == pytest.approx(2.0)
    assert m["stride_frequency"] == pytest.approx(1.25, rel=0.001)
    assert m["stride_length"] == pytest.approx(1.6, rel=0.001)
    assert m["flight_share"] == pytest.approx(0.2, abs=0.02)
    assert m["clearance"] == pytest.approx(0.1)
    assert m["stance_difference"] == pytest.approx(0.0, abs=0.02)
    assert m["shoulder_hip_correlation"] == pytest.approx(-1.0)
    assert m["shoulder_range"] == pytest.approx(0.6, rel=0.05)
    assert m["momentum_rms"] == pytest.approx(5.0) and m["momentum_yaw_rms"] == pytest.approx(4.0)
    assert m["within_speed_limits"] == 1.0 and m["cost_of_transport"] == 0.0


def test_cost_of_transport_counts_the_mass_that_was_moved(xbot):
    """16 joints x 1 N m x 3 rad/s = 48 W, forwards or backwards at 2 m/s with 60 kg; then 50 kg at
    2 m/s and 70 kg at 3 m/s, each with 48 W."""

    def cost(trace):
        return gait_metrics.effort(trace, xbot, DT)["cost_of_transport"]

    trace = synthetic()
    trace = trace.replace(joint_vel=trace.joint_vel - 3.0, mass=0.0 * trace.mass + 60.0)
    assert cost(trace) == pytest.approx(48.0 / (9.81 * 120.0))
    assert cost(trace.replace(linvel=-trace.linvel)) == pytest.approx(48.0 / (9.81 * 120.0))
    faster = trace.linvel * np.array([1.0, 1.5])[:, None]
    two = trace.replace(mass=0.0 * trace.mass + [50.0, 70.0], linvel=faster)
    assert cost(two) == pytest.approx(48.0 / (9.81 * 155.0))


def test_a_chattering_foot_lands_once():
    """Off 0.1 s, on, off 0.03 s, on, off 0.1 s, on: two landings."""
    on = np.r_[np.zeros(10), np.ones(10), np.zeros(3), np.ones(5), np.zeros(10), np.ones(5)]
    contact = np.tile(on.astype(bool)[:, None, None], (1, 1, 2))
    np.testing.assert_array_equal(gait_metrics._touchdowns(contact, DT), [[2, 2]])


def test_a_limp_shows(xbot):
    trace = synthetic()
    contact = trace.contact.copy()
    contact[..., 1] = False
    limp = trace.replace(contact=contact)
    assert gait_metrics.summary(limp, 2.0, xbot, DT)["stance_difference"] == pytest.approx(2.0)


def test_a_fall_counts_as_zero_speed(xbot):
    """The paper's rule: one of two fell, so the mean of 2 and 0."""
    trace = synthetic()
    alive = trace.alive.copy()
    alive[500:, 1] = False
    m = gait_metrics.summary(trace.replace(alive=alive), 2.0, xbot, DT)
    assert m["survival"] == 0.5 and m["forward_mean"] == pytest.approx(1.0)
    assert m["forward_bias"] == pytest.approx(0.0, abs=1e-6)
    assert m["seconds_to_fall"] == pytest.approx(500 * DT)
    nobody = gait_metrics.summary(trace.replace(alive=alive & False), 2.0, xbot, DT)
    assert nobody["survival"] == 0.0 and nobody["forward_mean"] == 0.0


def test_bodies_angular_momenta_add_up_to_the_whole_bodys(xbot):
    model, data = xbot.mj_model, mujoco.MjData(xbot.mj_model)
    rng = np.random.default_rng(0)
    data.qpos[:] = xbot.default_qpos
    data.qpos[3:] += 0.5 * rng.normal(size=20)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:] = 3.0 * rng.normal(size=22)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    parts = gait_metrics.body_momentum(model, data)
    np.testing.assert_allclose(parts.sum(0), data.subtree_angmom[0], rtol=1e-9)


def test_arms_momentum_is_theirs_alone(xbot):
    """Arms swing against each other about a still body: the legs have (almost) none."""
    trace = synthetic()
    joint_vel = trace.joint_vel.copy()
    joint_vel[..., 12:16] = 3.0
    m = gait_metrics.momentum(trace.replace(joint_vel=joint_vel, linvel=0 * trace.linvel), xbot, DT)
    assert m["arms_momentum_yaw_rms"] > 0.2 > 10 * m["legs_momentum_yaw_rms"]


def test_sweep_and_table(still):
    """Four robots at high fidelity: the tests of the servos have compiled this program already."""
    args = evaluate.Args("still", speeds=(0.0, 1.0), seeds=2, seconds=3.0, fidelity="high")
    rows = evaluate.sweep(args, still)
    assert [r["command"] for r in rows] == [0.0, 1.0]
    assert all(r["survival"] == 0.0 for r in rows)
    assert evaluate.table(rows, "t").row_count == 2
    json.dumps(rows)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["no-such-policy"], "no run, checkpoint or shipped policy"),
        (["x", "--seeds", "0"], "seeds must be positive"),
    ],
)
def test_errors_are_one_line(argv, says, capsys):
    assert evaluate.main(argv) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and err[0].startswith("error: ") and says in err[0]


def test_speed_as_a_word_exits_with_2():
    assert evaluate.main(["x", "--speeds", "fast"]) == 2


def test_a_row_is_of_its_command_and_conditions(still, monkeypatch):
    asked = []

    def run(policy, setting, velocities, seed):
        asked.append((setting, seed))
        alive, moves = np.ones((300, len(velocities)), bool), np.tile(velocities, (300, 1, 1))
        yield synthetic(3.0).replace(alive=alive, linvel=moves)

    monkeypatch.setattr(trials, "run", run)
    monkeypatch.setattr(
        gait_metrics, "summary", lambda trace, *_: {"vx": trace.linvel[..., 0].mean()}
    )
    args = evaluate.Args(
        Path("x"), (0.5, 2.0), seeds=3, seconds=3.0, fidelity="high", noise=True, seed=5
    )
    marks = {}, {"beyond": ["speed"]}  # its range ends at 0.5 m/s
    rows = [{"command": v, "vx": v} | mark for v, mark in zip((0.5, 2.0), marks, strict=True)]
    assert evaluate.sweep(args, still) == rows
    ((setting, seed),) = asked
    assert setting.physics == HighFidelity() and setting.noise and seed == 5
    evaluate.sweep(dataclasses.replace(args, fidelity="train", noise=False), still)
    assert asked[1][0] == trials.Setting(still.config.physics, seconds=3.0)


def test_speed_numbers():
    """2 s at rest do not count, then 1 and 3 m/s +- 0.5, 0.1 +- 0.2 aside, -0.3 +- 0.4 rad/s."""
    trace = synthetic()
    sign = np.where(np.arange(len(trace.alive)) % 2, 1.0, -1.0)[:, None] * np.ones(2)
    linvel = np.stack([np.array([1.0, 3.0]) + 0.5 * sign, 0.1 + 0.2 * sign, 9.0 * sign], -1)
    linvel[:200] = 0.0
    angvel = np.stack([9.0 * sign, 9.0 * sign, 0.4 * sign - 0.3], -1)
    euler = np.zeros_like(linvel) + np.array([-0.02, 0.1, 3.0])
    m = gait_metrics.speed(trace.replace(linvel=linvel, angvel=angvel, euler=euler), 1.0, DT)
    expected = {
        **{"forward_mean": 2.0, "forward_rmse": 2**0.5, "forward_bias": 1.0},
        **{"forward_std": 0.5, "lateral_std": 0.2, "yaw_rate_std": 0.4},
        **{"lateral_mean": 0.1, "yaw_rate_mean": -0.3},
        **{"roll_deg": 1.145916, "pitch_deg": 5.729578},
        "forward_mean_ci": 12.7062,  # t of one degree of freedom x sqrt(2) / sqrt(2)
    }
    for name, value in expected.items():
        assert m[name] == pytest.approx(value, rel=1e-4), name


def test_effort_and_strides_by_hand(xbot):
    trace = synthetic()
    torque, joint_vel = 0 * trace.torque, 0 * trace.joint_vel
    torque[..., 3], joint_vel[::4, :, 3] = -0.5 * xbot.effort_limit[3], -12.5
    m = gait_metrics.effort(trace.replace(torque=torque, joint_vel=joint_vel), xbot, DT)
    assert m["within_speed_limits"] == pytest.approx(0.75, abs=0.01)
    assert m["peak_torque_share"] == pytest.approx(0.5)
    assert m["mean_torque_share"] == pytest.approx(0.5 / 16)
    s = gait_metrics.strides(trace.replace(foot_height=trace.foot_height * [1.0, 0.5]), DT)
    assert s["clearance"] == pytest.approx(0.05) and s["double_support_share"] == 0.0
    assert s["clearance_difference"] == pytest.approx(0.05 / 0.075)


def test_limbs_turn_with_the_body(xbot):
    """1 rad/s about the vertical: their moments of inertia about it, arms held out."""
    trace = synthetic(3.0)
    qpos = 0.0 * trace.qpos
    qpos[..., 3] = 1.0
    spin = trace.angvel + np.array([0.0, 0.0, 1.0])
    m = gait_metrics.momentum(
        trace.replace(qpos=qpos, linvel=0 * trace.linvel, angvel=spin), xbot, DT
    )
    assert m["legs_momentum_yaw_rms"] == pytest.approx(0.448, abs=0.01)
    assert m["arms_momentum_yaw_rms"] == pytest.approx(0.603, abs=0.01)


@pytest.mark.slow(reason="compiles; the quick suite pins what the policy does in a second")
def test_the_shipped_policy_walks_and_runs():
    """4 s, of which 2 s count: at 3 m/s it is still gathering speed."""
    policy = policy_lib.load_policy("xbot_l_run")
    args = evaluate.Args(Path("xbot_l_run"), speeds=(1.0, 3.0), seeds=1, seconds=4.0)
    walk, run = evaluate.sweep(args, policy)
    assert walk["survival"] == run["survival"] == 1.0
    assert walk["forward_mean"] == pytest.approx(1.0, abs=0.1)
    assert run["forward_mean"] == pytest.approx(2.83, abs=0.2)
    assert run["flight_share"] > 0.1 and run["shoulder_hip_correlation"] < -0.8


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("xbot_l_run", "xbot_l_run"),
        ("runs/mine", "mine"),
        ("runs/mine/checkpoints", "mine"),
        ("runs/mine/checkpoints/120", "mine"),
        ("runs/mine/snapshots/120", "mine"),
        ("runs/7", "7"),
        ("runs/mine/seed-2", "mine-seed2"),
        ("runs/mine/seed-2/snapshots/120", "mine-seed2"),
    ],
)
def test_results_name_a_run_and_no_folder(path, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert policy_lib.policy_name(path) == name
    assert policy_lib.policy_name(tmp_path / path) == name
    assert policy_lib.policy_name(".") == tmp_path.name


def test_drift_is_that_of_the_robot_that_drifts_most():
    """Two robots drift by 3 and 4 cm in one second, in opposite directions: means hide it."""
    trace, seconds = synthetic(), 1.0
    start = round(gait_metrics.SETTLE / DT)
    steps = start + round(seconds / DT) + 1
    qpos = np.zeros((steps, 2, trace.qpos.shape[-1]))
    qpos[start:, 0, 0] = np.linspace(0.0, 0.03, steps - start)
    qpos[start:, 1, 0] = -np.linspace(0.0, 0.04, steps - start)
    rest = jax.tree.map(lambda x: np.zeros((steps, 2, *x.shape[2:]), x.dtype), trace)
    rest = rest.replace(qpos=qpos, alive=np.ones((steps, 2), bool))
    assert gait_metrics.speed(rest, 0.0, DT)["drift"] == pytest.approx(0.04 / seconds)
    assert "drift" not in gait_metrics.speed(rest, 1.0, DT)
