"""Frames against tables typed by hand: order, scales, noise, history and mirroring."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from states import ACTOR, CRITIC, MIRROR, XBOT, make_command, make_gait, make_signals

from kslc_jax import gait, observations, randomize, signals
from kslc_jax.config import EnvConfig, PhysicsConfig, preset
from kslc_jax.physics import PhysicsState, initial_state

KEY = jax.random.key(0)
QUIET = EnvConfig(noise_level=0.0)

# Different numbers for all components of a frame.
Q = 0.01 * np.arange(1, 17)
DQ = 1.0 + 0.1 * np.arange(16)
ACTION = -2.0 + 0.2 * np.arange(16)
REFERENCE = 0.3 - 0.02 * np.arange(16)


def make_sources(**changes) -> observations.Sources:
    parts = dict(
        signals=make_signals(
            joint_pos=Q,
            joint_vel=DQ,
            base_linvel=[1.5, -0.2, 0.1],
            base_angvel=[0.3, -0.4, 0.5],
            base_euler=[0.01, 0.02, -3.0],
            foot_contact=[True, False],
        ),
        gait=make_gait(clock=[0.6, 0.8], stance=[False, True]),
        command=make_command(velocity=[2.0, -0.3, 0.7]),
        dynamics=randomize.nominal(XBOT, friction=1.3),
        reference=jnp.asarray(REFERENCE, jnp.float32),
        last_action=jnp.asarray(ACTION, jnp.float32),
        push=jnp.array([0.11, -0.12, 0.21, -0.22, 0.23]),
        base_mass=jnp.asarray(24.0),
    )
    return observations.Sources(**{**parts, **changes})


# ------------------------------------------------------------------------------------------ tables


def test_widths():
    assert observations.actor_width(XBOT) == 59 and observations.critic_width(XBOT) == 89
    assert observations.width(ACTOR) == 59 and observations.width(CRITIC) == 89


# The paper's Table II: component, width, True if the actor sees it. The critic sees all.
TABLE_II = [
    (("clock",), 2, True),
    (("command",), 3, True),
    (("joint_pos",), 16, True),
    (("joint_vel",), 16, True),
    (("base_angvel",), 3, True),
    (("base_euler",), 3, True),
    (("last_action",), 16, True),
    (("friction",), 1, False),
    (("base_mass",), 1, False),
    (("base_linvel",), 3, False),
    (("push_linear",), 2, False),
    (("push_angular",), 3, False),
    (("tracking_difference",), 16, False),
    (("stance",), 2, False),
    (("contact",), 2, False),
]


def test_components_are_the_papers_table_2():
    actor = {c.name: c.width for c in ACTOR}
    critic = {c.name: c.width for c in CRITIC}
    assert actor == {n[0]: dims for n, dims, seen in TABLE_II if seen}
    assert critic == {n[0]: dims for n, dims, _ in TABLE_II}


def test_slices():
    actor, critic = observations.slices(ACTOR), observations.slices(CRITIC)
    assert {n: (s.start, s.stop) for n, s in actor.items()} == {
        "clock": (0, 2),
        "command": (2, 5),
        "joint_pos": (5, 21),
        "joint_vel": (21, 37),
        "last_action": (37, 53),
        "base_angvel": (53, 56),
        "base_euler": (56, 59),
    }
    assert {n: (s.start, s.stop) for n, s in critic.items()} == {
        "clock": (0, 2),
        "command": (2, 5),
        "joint_pos": (5, 21),
        "joint_vel": (21, 37),
        "last_action": (37, 53),
        "tracking_difference": (53, 69),
        "base_linvel": (69, 72),
        "base_angvel": (72, 75),
        "base_euler": (75, 78),
        "push_linear": (78, 80),
        "push_angular": (80, 83),
        "friction": (83, 84),
        "base_mass": (84, 85),
        "stance": (85, 87),
        "contact": (87, 89),
    }


# Wanted velocity x 2, mean velocity error x 2, air time x 2 and swing height x 10.
REMEMBERED = {
    "wanted": (5.0, -0.6),
    "mean_error": (1.4, -0.2),
    "air_time": (0.0, 0.3),
    "swing_height": (0.0, 0.6),
}


def test_the_critic_may_see_what_rewards_remember():
    """By hand. All that `gait.update` carries from step to step is then in the frame."""
    memory = dict(mean_error=[0.7, -0.1], air_time=[0.0, 0.15], swing_height=[0.0, 0.06])
    command = make_command(velocity=[2.0, -0.3, 0.7], wanted=[2.5, -0.3])
    src = make_sources(gait=make_gait(**memory), command=command)
    config = EnvConfig(critic_memory=True)
    frame = observations.critic_frame(config, XBOT, src)
    assert observations.critic_width(XBOT, True) == 97 and frame.shape == (97,)
    np.testing.assert_array_equal(frame[:89], observations.critic_frame(EnvConfig(), XBOT, src))
    np.testing.assert_allclose(frame[89:], np.concatenate(list(REMEMBERED.values())), atol=1e-6)
    permutation, sign = observations.mirror_map(observations.critic_table(XBOT, True), XBOT)
    np.testing.assert_allclose(
        (frame[permutation] * sign)[89:], [5.0, 0.6, 1.4, 0.2, 0.3, 0.0, 0.6, 0.0], atol=1e-6
    )


def test_the_critic_sees_without_noise():
    assert [c.noise for c in CRITIC] == [0.0] * 15


def test_every_component_has_a_value():
    values = observations._values(make_sources())
    for table in (ACTOR, CRITIC):
        for c in table:
            assert values[c.name].shape == (c.width,), c.name


# ------------------------------------------------------------------------------------------ frames

# Scales: vx and vy x 2, yaw rate x 1, joint speed x 0.05, linear velocity x 2, mass / 30.
ACTOR_FRAME = np.concatenate(
    [[0.6, 0.8], [4.0, -0.6, 0.7], Q, 0.05 * DQ, ACTION, [0.3, -0.4, 0.5], [0.01, 0.02, -3.0]]
)
CRITIC_FRAME = np.concatenate(
    [
        ACTOR_FRAME[:53],
        Q - REFERENCE,
        [3.0, -0.4, 0.2],
        [0.3, -0.4, 0.5],
        [0.01, 0.02, -3.0],
        [0.11, -0.12],
        [0.21, -0.22, 0.23],
        [1.3],
        [0.8],
        [0.0, 1.0],
        [1.0, 0.0],
    ]
)


@pytest.mark.parametrize("jit", [False, True])
def test_frames_by_hand(jit):
    actor = lambda src: observations.actor_frame(QUIET, XBOT, src, KEY)  # noqa: E731
    critic = lambda src: observations.critic_frame(EnvConfig(), XBOT, src)  # noqa: E731
    actor, critic = (jax.jit(f) if jit else f for f in (actor, critic))
    np.testing.assert_allclose(actor(make_sources()), ACTOR_FRAME, atol=1e-6)
    np.testing.assert_allclose(critic(make_sources()), CRITIC_FRAME, atol=1e-6)


def test_frames_are_clipped_at_18():
    src = make_sources(
        signals=make_signals(joint_vel=np.full(16, 500.0), joint_pos=np.full(16, -30.0)),
        last_action=jnp.full(16, 17.5),
    )
    frame = observations.actor_frame(EnvConfig(), XBOT, src, KEY)
    np.testing.assert_array_equal(frame[21:37], np.full(16, 18.0))
    np.testing.assert_array_equal(frame[5:21], np.full(16, -18.0))
    np.testing.assert_array_equal(frame[37:53], np.full(16, 17.5))
    critic = observations.critic_frame(EnvConfig(observation_clip=3.0), XBOT, src)
    assert float(jnp.max(jnp.abs(critic))) == 3.0


# Noise level 0.6 times 0.05, 0.5 (times the scale 0.05), 0.1 and 0.03.
NOISE = np.concatenate(
    [np.zeros(5), np.full(16, 0.03), np.full(16, 0.015), np.zeros(16), [0.06] * 3, [0.018] * 3]
)


@pytest.fixture(scope="module")
def noisy():
    """Deviations of 4000 noisy frames from the clean frame: [4000, 59], at noise level 0.6."""
    frame = jax.jit(
        jax.vmap(lambda key: observations.actor_frame(EnvConfig(), XBOT, make_sources(), key))
    )
    return np.asarray(frame(jax.random.split(KEY, 4000))) - ACTOR_FRAME


def test_noise_has_the_tables_size(noisy):
    np.testing.assert_allclose(noisy.std(axis=0), NOISE, rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(noisy.mean(axis=0), 0.0, atol=0.06 * 5 / np.sqrt(4000))


def test_noise_is_gaussian_and_independent(noisy):
    """5 % lie beyond 1.96 standard deviations, and no two numbers share their noise."""
    z = noisy[:, NOISE > 0] / NOISE[NOISE > 0]
    assert np.mean(np.abs(z) > 1.959964) == pytest.approx(0.05, abs=0.003)
    correlation = np.corrcoef(z.T) - np.eye(z.shape[1])
    assert np.abs(correlation).max() < 0.08


def test_noise_level_scales_all_of_it():
    key = jax.random.key(1)
    one, two = (
        observations.actor_frame(EnvConfig(noise_level=level), XBOT, make_sources(), key)
        - ACTOR_FRAME
        for level in (0.5, 1.0)
    )
    np.testing.assert_allclose(two, 2 * one, atol=2e-6)
    assert float(jnp.max(jnp.abs(one))) > 0.01


def test_noise_factor_of_the_episode_scales_it_too():
    key, dynamics = jax.random.key(1), randomize.nominal(XBOT, friction=1.3)
    none, half = (
        observations.actor_frame(
            EnvConfig(noise_level=1.0), XBOT, make_sources(dynamics=dynamics.replace(noise=x)), key
        )
        for x in (0.0, 0.5)
    )
    level = observations.actor_frame(EnvConfig(noise_level=0.5), XBOT, make_sources(), key)
    np.testing.assert_array_equal(half, level)
    np.testing.assert_allclose(none, ACTOR_FRAME, atol=1e-6)


# ----------------------------------------------------------------------------------------- history


def test_history_is_oldest_first():
    history = jnp.zeros((3, 2))
    for i in range(1, 6):
        history = observations.append_frame(history, jnp.full(2, float(i)))
        newest = [max(i - 2, 0), max(i - 1, 0), i]
        np.testing.assert_array_equal(history[:, 0], newest)


def test_presets_have_the_papers_history():
    paper = preset("paper").env
    assert (paper.frames, paper.privileged_frames) == (15, 3)


# ------------------------------------------------------------------------------------------ mirror

# By hand: swap the sides and negate every joint. Legs: 0 to 5, 6 to 11. Arms: 12, 13 and 14, 15.
PARTNER = [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5, 14, 15, 12, 13]


def mirrored(x: np.ndarray) -> np.ndarray:
    return -np.asarray(x)[PARTNER]


@pytest.mark.parametrize("table", [ACTOR, CRITIC], ids=["actor", "critic"])
def test_mirroring_twice_changes_nothing(table):
    permutation, sign = observations.mirror_map(table, XBOT)
    n = observations.width(table)
    assert sorted(permutation) == list(range(n))
    assert set(sign.tolist()) == {-1.0, 1.0}
    np.testing.assert_array_equal(permutation[permutation], np.arange(n))
    np.testing.assert_array_equal(sign * sign[permutation], np.ones(n))


@settings(max_examples=20, deadline=None, derandomize=True, database=None)
@given(st.lists(st.floats(-18, 18, width=32), min_size=59, max_size=59))
def test_mirror_is_an_involution_on_any_frame(values):
    permutation, sign = observations.mirror_map(ACTOR, XBOT)
    x = np.asarray(values, np.float32)
    np.testing.assert_array_equal((x[permutation] * sign)[permutation] * sign, x)


def mirrored_sources() -> observations.Sources:
    """The sources of the robot mirrored at its x-z plane."""
    return make_sources(
        signals=make_signals(
            joint_pos=mirrored(Q),
            joint_vel=mirrored(DQ),
            base_linvel=[1.5, 0.2, 0.1],
            base_angvel=[-0.3, -0.4, -0.5],
            base_euler=[-0.01, 0.02, 3.0],
            foot_contact=[False, True],
        ),
        gait=make_gait(clock=[-0.6, -0.8], stance=[True, False]),
        command=make_command(velocity=[2.0, 0.3, -0.7]),
        reference=jnp.asarray(mirrored(REFERENCE), jnp.float32),
        last_action=jnp.asarray(mirrored(ACTION), jnp.float32),
        push=jnp.array([0.11, 0.12, -0.21, -0.22, -0.23]),
    )


def frames(src: observations.Sources):
    return (
        (ACTOR, observations.actor_frame(QUIET, XBOT, src, KEY)),
        (CRITIC, observations.critic_frame(QUIET, XBOT, src)),
    )


def test_frame_of_the_mirrored_state_is_the_mirrored_frame():
    for (table, here), (_, there) in zip(
        frames(make_sources()), frames(mirrored_sources()), strict=True
    ):
        permutation, sign = observations.mirror_map(table, XBOT)
        np.testing.assert_allclose(here[permutation] * sign, there, atol=1e-6)
        assert float(jnp.max(jnp.abs(here - there))) > 1.0


def test_mirrored_physics_gives_the_mirrored_frame(xbot):
    """The mirrored qpos and qvel go through signals and gait. In the mirror y, roll, yaw and their
    rates change sign."""
    config = PhysicsConfig()
    rng = np.random.default_rng(0)
    q, dq = rng.uniform(-0.5, 0.5, 16), rng.uniform(-5, 5, 16)
    quat = np.array([0.9, 0.1, -0.3, 0.2])
    quat /= np.linalg.norm(quat)
    linear, angular = rng.normal(size=3), rng.normal(size=3)

    def state(position, quat, linear, angular, q, dq, touch) -> PhysicsState:
        qpos = jnp.asarray(np.concatenate([position, quat, q]), jnp.float32)
        qvel = jnp.asarray(np.concatenate([linear, angular, dq]), jnp.float32)
        start = initial_state(config, qpos, qvel)
        data = start.sensordata
        for side, force in zip(("left", "right"), touch, strict=True):
            data = data.at[xbot.sensor(f"{side}_foot_touch")].set(force)
        return start.replace(sensordata=data)

    flip = np.array([1.0, -1.0, 1.0])
    here = state([1.0, 2.0, 0.9], quat, linear, angular, q, dq, (100.0, 0.0))
    there = state(
        [1.0, -2.0, 0.9],
        quat * [1, -1, 1, -1],
        linear * flip,
        angular * -flip,
        mirrored(q),
        mirrored(dq),
        (0.0, 100.0),
    )

    def source(physics, phase, command, action, push):
        now = signals.read(xbot, physics)
        clock = gait.update(
            preset("paper").gait, make_gait(phase=phase), now, command, jnp.asarray(1e9), 0.01
        )
        return make_sources(
            signals=now,
            gait=clock,
            command=command,
            reference=gait.reference_pose(preset("laptop").gait, xbot, clock, command),
            last_action=jnp.asarray(action, jnp.float32),
            push=jnp.asarray(push),
        )

    one = source(
        here, 0.2, make_command(velocity=[2.0, 0.2, 0.3]), ACTION, [0.1, 0.2, 0.3, 0.4, 0.5]
    )
    two = source(
        there,
        0.7,
        make_command(velocity=[2.0, -0.2, -0.3]),
        mirrored(ACTION),
        [0.1, -0.2, -0.3, 0.4, -0.5],
    )
    for (table, a), (_, b) in zip(frames(one), frames(two), strict=True):
        permutation, sign = observations.mirror_map(table, XBOT)
        np.testing.assert_allclose(a[permutation] * sign, b, atol=1e-5)


def test_mirror_of_the_joints_is_the_robots():
    permutation, sign = MIRROR
    assert permutation.tolist() == PARTNER and sign.tolist() == [-1.0] * 16


def test_signals_are_what_they_are_called(xbot):
    """Signals of a robot with random pose and velocity, against numpy."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, quat)
    turn = turn.reshape(3, 3)
    linear, rate, q, dq = (rng.normal(size=n) for n in (3, 3, 16, 16))
    qpos, qvel = jnp.asarray(np.r_[1, 2, 3, quat, q]), jnp.asarray(np.r_[linear, rate, dq])
    data = np.arange(xbot.mj_model.nsensordata) + 0.5
    data[xbot.sensor("left_foot_touch")], data[xbot.sensor("right_foot_touch")] = 4.9, 5.1
    state = initial_state(PhysicsConfig(), qpos, qvel)
    state = state.replace(sensordata=jnp.asarray(data), torque=jnp.arange(16.0))
    now = signals.read(xbot, state)

    def both(name):
        return [data[xbot.sensor(f"{side}_{name}")] for side in ("left", "right")]

    expected = {
        **{"joint_pos": q, "joint_vel": dq, "torque": np.arange(16.0), "base_angvel": rate},
        **{"base_linvel": turn.T @ linear, "base_velocity": np.r_[linear, turn @ rate]},
        **{"gravity": -turn[2], "foot_pos": both("foot_pos"), "foot_vel": both("foot_linvel")},
        **{"knee_pos": both("knee_pos"), "foot_force": [4.9, 5.1]},
        **{"foot_contact": [False, True], "angular_momentum": data[xbot.sensor("angmom")]},
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(now, name), value, atol=1e-5, err_msg=name)
