"""Gait clock, stance mask, reference pose, air time and swing height, against values by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from states import MIRROR, joints, make_command, make_gait, make_signals

from kslc_jax import curriculum, gait, robot
from kslc_jax.config import GaitConfig, preset

DT = 0.01
PAPER = preset("paper").gait
GROWING = dataclasses.replace(PAPER, reference_speed_gain=1.0, arm_swing=0.5, elbow_bend=1.0)
SWEEPING = dataclasses.replace(GROWING, stride_sweep=0.35)
KEY = jax.random.key(0)


@functools.partial(jax.jit, static_argnums=0)
def update(config: GaitConfig, state, signals, command, cycle_time):
    return gait.update(config, state, signals, command, cycle_time, DT)


def at_phase(phase: float, command=None, config: GaitConfig = PAPER) -> gait.GaitState:
    """State at `phase`. The cycle is very long, so that the clock hardly moves in the step."""
    start = make_gait(phase=phase, stance=[False, False], clock=[9.0, 9.0])
    command = make_command() if command is None else command
    return update(config, start, make_signals(), command, jnp.asarray(1e9))


# ------------------------------------------------------------------------------------------- clock


@pytest.mark.parametrize(
    ("phase", "left", "right"),
    [
        (0.0, True, True),
        (0.0159, True, True),  # sin(2 pi 0.0159) = 0.09974 < 0.1
        (0.0160, True, False),  # 0.10036
        (0.25, True, False),
        (0.4840, True, False),  # 0.10036
        (0.4842, True, True),  # 0.09911
        (0.5, True, True),
        (0.5158, True, True),  # -0.09911
        (0.5160, False, True),  # -0.10036
        (0.75, False, True),
        (0.9840, False, True),
        (0.9842, True, True),
    ],
)
def test_stance_mask(phase, left, right):
    assert at_phase(phase).stance.tolist() == [left, right]
    fresh = gait.clock_of(PAPER, jnp.asarray(phase), make_command())[1]
    assert fresh.tolist() == [left, right]


@pytest.mark.parametrize(
    ("phase", "sin", "cos"),
    [(0.0, 0, 1), (0.125, 0.70710678, 0.70710678), (0.25, 1, 0), (0.5, 0, -1), (0.75, -1, 0)],
)
def test_clock(phase, sin, cos):
    np.testing.assert_allclose(at_phase(phase).clock, [sin, cos], atol=1e-6)


@pytest.mark.parametrize(
    ("vx", "phase", "left", "right"),
    [
        (0.0, 0.0159, True, True),  # slow: double support as before
        (3.5, 0.0, False, False),  # at full speed both feet fly while abs(sin) < 0.3
        (3.5, 0.0484, False, False),  # sin = 0.2992
        (3.5, 0.0486, True, False),  # sin = 0.3004
        (-3.5, 0.0484, False, False),
        (7.0, 0.0486, True, False),
        (1.75, 0.0001, True, False),  # (1.75 / 3.5)^2 (0.3 + 0.1) = 0.1: neither overlap nor flight
        (2.475, 0.0158, False, False),  # half way: both fly while abs(sin) < 0.1
        (2.475, 0.0161, True, False),
    ],
)
def test_double_support_turns_into_flight_with_the_square_of_the_speed(vx, phase, left, right):
    config = dataclasses.replace(PAPER, double_support_at_speed=-0.3)
    state = at_phase(phase, make_command(velocity=[vx, 0.0, 0.0]), config)
    assert state.stance.tolist() == [left, right]


def test_the_mean_error_forgets_over_a_cycle():
    """A first-order filter with dt / cycle = 0.01 / 0.5 a step. After one cycle with an error of
    1 m/s it is at 1 - 0.98^50 = 0.6358. A new command that the robot follows at once adds none."""
    state, signals = make_gait(), make_signals(base_linvel=[1.5, -2.0, 5.0])
    for _ in range(50):
        command = make_command(velocity=[0.5, 0.0, 0.0])
        state = update(PAPER, state, signals, command, jnp.asarray(0.5))
    np.testing.assert_allclose(state.mean_error, [0.63583, -1.27166], rtol=1e-4)
    exact = make_command(velocity=[1.5, -2.0, 0.0])
    ramp = exact.replace(velocity=jnp.zeros(3))
    for command in (exact, ramp):  # on a ramp no error counts
        after = update(PAPER, state, signals, command, jnp.asarray(0.5))
        np.testing.assert_allclose(after.mean_error, 0.98 * state.mean_error, rtol=1e-5)


def test_clock_runs_once_around_in_a_cycle():
    """A step is 0.01 / 0.64 = 1/64 of a cycle: a quarter after 16 steps, back at 0 after 64."""
    state, phases = make_gait(), []
    for _ in range(64):
        state = update(PAPER, state, make_signals(), make_command(), jnp.asarray(0.64))
        phases.append(float(state.phase))
    assert phases[0] == 1 / 64 and phases[15] == 0.25 and phases[62] == 63 / 64 and phases[63] == 0


def test_shorter_cycle_goes_on_from_the_same_phase():
    """The phase is integrated: 0.25 + 0.01 / 0.5, not time / 0.5."""
    state = make_gait(phase=0.25)
    state = update(PAPER, state, make_signals(), make_command(), jnp.asarray(0.5))
    assert float(state.phase) == pytest.approx(0.27, abs=1e-6)


def test_standing_still_stops_the_clock_and_wants_both_feet():
    state = at_phase(0.25, make_command(moving=False))
    assert state.clock.tolist() == [0.0, 0.0]
    assert state.stance.tolist() == [True, True]


def test_start_of_an_episode():
    feet = jnp.array([0.05, 0.06])
    state = gait.init(PAPER, KEY, make_command(), feet)
    assert float(state.phase) == 0.0
    np.testing.assert_allclose(state.clock, [0.0, 1.0])
    assert state.stance.tolist() == [True, True] and state.contact.tolist() == [False, False]
    np.testing.assert_array_equal(state.lift_z, feet)
    for name in ("air_time", "landed_air_time", "swing_height"):
        assert getattr(state, name).tolist() == [0.0, 0.0]


def test_random_phase_fills_the_cycle():
    config = dataclasses.replace(PAPER, random_phase=True)
    start = jax.vmap(lambda key: gait.init(config, key, make_command(), jnp.zeros(2)))
    state = start(jax.random.split(KEY, 1000))
    assert 0.0 <= float(state.phase.min()) < 0.01 and 0.99 < float(state.phase.max()) < 1.0
    np.testing.assert_allclose(state.clock[:, 0], np.sin(2 * np.pi * state.phase), atol=1e-5)


@pytest.mark.parametrize(
    ("follows", "vx", "expected"),
    [
        (False, 3.5, 0.48),
        (False, 0.0, 0.48),
        (True, 3.5, 0.48),
        (True, 0.0, 0.64),
        (True, 1.75, 0.56),
    ],
)
def test_cycle_time(follows, vx, expected):
    """If the cycle follows the speed: 0.64 + g (0.48 - 0.64), with g = 0.5 at 1.75 of 3.5 m/s."""
    config = with_gait(cycle_follows_speed=follows)
    command = make_command(velocity=[vx, 0.0, 0.0])
    got = gait.cycle_time(config, command, jnp.asarray(0.48), jnp.asarray(3.5))
    assert float(got) == pytest.approx(expected, rel=1e-6)


def with_gait(**changes):
    config = preset("paper")
    return dataclasses.replace(config, gait=dataclasses.replace(config.gait, **changes))


@pytest.mark.parametrize("vx", [0.0, 0.3, 0.5, -0.3, 0.75, 1.0, 2.0, 3.3])
def test_the_cycle_of_a_command_is_the_same_for_every_range(vx):
    """It is 0.64 x 0.94^((v - 0.5) / 0.5): the curriculum's cycle when v was its top speed."""
    config, command = preset("laptop"), make_command(velocity=[vx, 0.0, 0.0])
    state, found = curriculum.init(config), []
    open_ = dataclasses.replace(config.curriculum, cycle_min=0.38)
    for _ in range(8):
        if abs(vx) <= float(state.v_max):
            cycle = gait.cycle_time(config, command, state.cycle_time, state.v_max)
            found.append(float(cycle))
        state = state.replace(
            v_max=state.v_max + open_.v_step, cycle_time=state.cycle_time * open_.cycle_factor
        )
    expected = 0.64 * 0.94 ** (max(abs(vx) - 0.5, 0.0) / 0.5)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_cycle_is_never_below_the_curriculums():
    """Without the cycle curriculum (an ablation) the cycle stays 0.64 s. Where the curriculum's is
    0.42 s, so is that of the fastest command; alone it would be 0.39 s."""
    config, command = preset("laptop"), make_command(velocity=[4.5, 0.0, 0.0])
    assert float(gait.cycle_time(config, command, 0.64, 4.5)) == pytest.approx(0.64)
    assert float(gait.cycle_time(config, command, 0.42, 4.5)) == pytest.approx(0.42)
    assert float(gait.cycle_time(config, command, 0.38, 4.5)) == pytest.approx(0.3901, abs=1e-4)


# ---------------------------------------------------------------------------------- reference pose


def pose(phase: float, vx: float = 0.0, config: GaitConfig = PAPER, moving: bool = True):
    command = make_command(velocity=[vx, 0.0, 0.0], moving=moving)
    return gait.reference_pose(config, robot.load(), at_phase(phase, command), command)


LEFT_SWINGS = joints(left_leg_pitch=-0.17, left_knee=-0.34, left_ankle_pitch=-0.17)
RIGHT_SWINGS = joints(right_leg_pitch=0.17, right_knee=0.34, right_ankle_pitch=0.17)


@pytest.mark.parametrize(
    ("phase", "expected"),
    [
        (0.0, 0 * LEFT_SWINGS),
        (0.0159, 0 * LEFT_SWINGS),  # double support
        (0.25, RIGHT_SWINGS),
        (0.125, 0.70710678 * RIGHT_SWINGS),
        (0.5, 0 * LEFT_SWINGS),
        (0.75, LEFT_SWINGS),
        (0.625, 0.70710678 * LEFT_SWINGS),
    ],
)
def test_reference_pose_is_humanoid_gyms(phase, expected):
    """Left leg min(s, 0) (a, 2a, a), right leg max(s, 0) (a, 2a, a), with a = 0.17."""
    for vx in (0.0, 3.5):
        np.testing.assert_allclose(pose(phase, vx), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("vx", "factor"), [(0.0, 1.0), (1.75, 1.5), (-1.75, 1.5), (3.5, 2.0), (9.0, 2.0)]
)
def test_leg_reference_grows_with_the_commanded_speed(vx, factor):
    legs = pose(0.75, vx, GROWING)[:12]
    np.testing.assert_allclose(legs, factor * LEFT_SWINGS[:12], atol=1e-6)


@pytest.mark.parametrize(
    ("phase", "vx", "swing", "bend"),
    [
        (0.0, 3.5, 0.5, 1.0),  # cos = 1: left arm back, right arm forward
        (0.5, 3.5, -0.5, 1.0),
        (0.25, 3.5, 0.0, 1.0),
        (0.0, 1.75, 0.25, 0.5),
        (0.0, 0.0, 0.0, 0.0),
    ],
)
def test_arm_reference(phase, vx, swing, bend):
    expected = joints(
        left_shoulder_pitch=swing,
        right_shoulder_pitch=swing,
        left_elbow_pitch=bend,
        right_elbow_pitch=-bend,
    )
    np.testing.assert_allclose(pose(phase, vx, GROWING)[12:], expected[12:], atol=1e-6)


@pytest.mark.parametrize(
    ("phase", "vx", "sweep"),
    [(0.0, 3.5, 0.4), (0.5, 3.5, -0.4), (0.25, 3.5, 0.0), (0.0, 1.75, 0.2)],
)
def test_hips_sweep(phase, vx, sweep):
    """At the left foot's touchdown cos = 1. The left leg is in front, which is negative. The right
    leg is behind; its axis is mirrored, so this is negative too."""
    config = dataclasses.replace(PAPER, stride_sweep=0.4)
    expected = pose(phase, vx) + joints(left_leg_pitch=-sweep, right_leg_pitch=-sweep)
    np.testing.assert_allclose(pose(phase, vx, config), expected, atol=1e-6)


def test_reference_pose_of_standing_still_is_zero():
    for phase in (0.25, 0.75):
        np.testing.assert_array_equal(pose(phase, 0.0, SWEEPING, moving=False), np.zeros(16))


@pytest.mark.parametrize("phase", [0.05, 0.2, 0.3, 0.45])
def test_half_a_cycle_later_the_reference_is_mirrored(phase):
    permutation, sign = MIRROR
    np.testing.assert_allclose(
        pose(phase + 0.5, 3.0, SWEEPING), pose(phase, 3.0, SWEEPING)[permutation] * sign, atol=1e-6
    )


def body_positions(q: np.ndarray) -> dict[str, np.ndarray]:
    model = robot.load().mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.load().default_qpos
    data.qpos[7:] = q
    mujoco.mj_kinematics(model, data)
    return {model.body(i).name: data.xpos[i].copy() for i in range(model.nbody)}


def test_reference_moves_the_body_as_it_should():
    """In the robot model the swing leg comes up with its knee forward, and arms move opposite to
    the legs."""
    rest, left = body_positions(np.zeros(16)), body_positions(np.asarray(pose(0.75)))
    assert left["left_ankle_roll_link"][2] - rest["left_ankle_roll_link"][2] > 0.02
    assert left["left_knee_link"][0] - rest["left_knee_link"][0] > 0.04
    np.testing.assert_allclose(left["right_ankle_roll_link"], rest["right_ankle_roll_link"])
    swung = body_positions(np.asarray(pose(0.0, 3.5, GROWING)))  # left foot lands: left arm is back
    shoulder_only = body_positions(joints(left_shoulder_pitch=0.5, right_shoulder_pitch=0.5))
    elbow = "elbow_pitch_link"
    assert shoulder_only[f"left_{elbow}"][0] < rest[f"left_{elbow}"][0] - 0.05
    assert shoulder_only[f"right_{elbow}"][0] > rest[f"right_{elbow}"][0] + 0.05
    np.testing.assert_allclose(swung[f"left_{elbow}"], shoulder_only[f"left_{elbow}"], atol=1e-6)


def test_elbow_reference_bends_the_forearm_forward():
    """The centre of mass of the forearm hangs below the elbow. A bend of 1.5 rad puts it in front
    of the elbow."""
    model = robot.load().mj_model
    data = mujoco.MjData(model)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        data.qpos[:] = robot.load().default_qpos
        data.qpos[7:] = joints(**{f"{side}_elbow_pitch": sign * 1.5})
        mujoco.mj_kinematics(model, data)
        forearm = model.body(f"{side}_elbow_pitch_link").id
        assert data.xipos[forearm][0] - data.xpos[forearm][0] > 0.05


# --------------------------------------------------------------------------- contacts and air time


def play(contacts, feet_z, phase=0.25, cycle_time=1e9, state=None):
    """The states of successive steps with the given contacts and foot heights [m].

    By default the clock stays at `phase`, where the left foot is in stance and the right in swing.
    """
    state = make_gait(contact=[False, False], phase=phase) if state is None else state
    out = []
    for contact, z in zip(contacts, feet_z, strict=True):
        signals = make_signals(
            foot_contact=list(contact), foot_pos=[[0, 0.15, z[0]], [0, -0.15, z[1]]]
        )
        state = update(PAPER, state, signals, make_command(), jnp.asarray(cycle_time))
        out.append(state)
    return out


def test_air_time_and_landing():
    """A foot is in the air from the second step without contact on. The landing step counts too."""
    right = [True, False, False, False, True, True, False, False]
    states = play([(False, c) for c in right], [(0.05, 0.05)] * 8)
    air = [round(float(s.air_time[1]), 4) for s in states]
    landing = [round(float(s.landed_air_time[1]), 4) for s in states]
    assert air == [0.0, 0.0, 0.01, 0.02, 0.0, 0.0, 0.0, 0.01]
    assert landing == [0.0, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0]
    # The clock has the left foot in stance all the time, so contact does not matter.
    assert all(float(s.air_time[0]) == float(s.landed_air_time[0]) == 0.0 for s in states)
    assert [s.contact.tolist() for s in states] == [[False, c] for c in right]


def test_the_clock_alone_ends_the_air_time():
    """The right foot is in the air while the phase goes 0.46, 0.47, 0.48, 0.49 (double support)."""
    states = play([(True, False)] * 4, [(0.05, 0.2)] * 4, phase=0.45, cycle_time=1.0)
    assert [round(float(s.phase), 4) for s in states] == [0.46, 0.47, 0.48, 0.49]
    assert [round(float(s.air_time[1]), 4) for s in states] == [0.01, 0.02, 0.03, 0.0]
    assert [round(float(s.landed_air_time[1]), 4) for s in states] == [0.0, 0.0, 0.0, 0.04]


def test_swing_height_is_above_the_last_contact():
    z = [0.05, 0.08, 0.12, 0.07, 0.07, 0.10]
    contact = [True, False, False, True, True, False]
    states = play([(True, c) for c in contact], [(0.05, h) for h in z])
    heights = [round(float(s.swing_height[1]), 5) for s in states]
    # The foot lands 2 cm higher. In that step the height is relative to the old contact, then to
    # the new one.
    assert heights == [0.0, 0.03, 0.07, 0.02, 0.0, 0.03]
    np.testing.assert_allclose([s.lift_z[1] for s in states], [0.05] * 3 + [0.07] * 3)


def test_bookkeeping_is_humanoid_gyms_over_random_contacts():
    """Humanoid-Gym's running sums, written out. Its reward methods change state, in this order."""
    rng = np.random.default_rng(0)
    steps = 150
    contacts = rng.random((steps, 2)) < 0.3
    feet = 0.05 + 0.1 * rng.random((steps, 2))
    start = make_gait(contact=[False, False], lift_z=[0.05, 0.05])
    states = play(contacts.tolist(), feet.tolist(), phase=0.0, cycle_time=0.64, state=start)
    air, last_contact, height, last_z = (
        np.zeros(2),
        np.zeros(2, bool),
        np.zeros(2),
        np.full(2, 0.05),
    )
    landings = 0
    for i, state in enumerate(states):
        s = np.sin(2 * np.pi * (i + 1) * DT / 0.64)
        stance = np.array([s >= 0, s < 0]) | (abs(s) < 0.1)
        filtered = contacts[i] | stance | last_contact
        last_contact = contacts[i]
        first = (air > 0) & filtered
        air = air + DT
        landing = air * first
        air = air * ~filtered
        height = height + feet[i] - last_z
        last_z = feet[i]
        np.testing.assert_allclose(state.landed_air_time, landing, atol=1e-5)
        np.testing.assert_allclose(state.air_time, air, atol=1e-5)
        np.testing.assert_allclose(state.swing_height, height, atol=1e-5)
        height = height * ~contacts[i]
        landings += int(first.sum())
    assert landings > 5
