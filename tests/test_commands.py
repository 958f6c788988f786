"""Commands: dead zone, heading, narrowing, standing still, and shares of slow commands."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from states import make_command

from kslc_jax import commands
from kslc_jax.config import CommandConfig, preset

PAPER = preset("paper").command
KEY = jax.random.key(0)
DT = 0.01


def draw(vx=0.0, vy=0.0, heading=0.0, yaw=0.0, **changes):
    """A command drawn from ranges with one value each."""
    config = dataclasses.replace(PAPER, vy=(vy, vy), heading=(heading, heading), **changes)
    return commands.sample(config, KEY, (jnp.asarray(vx), jnp.asarray(vx)), jnp.asarray(yaw), 0.5)


def draw_many(config: CommandConfig, n=4000, vx=(-0.3, 3.5), yaw=0.0, before=None):
    bounds, yaw = (jnp.asarray(vx[0]), jnp.asarray(vx[1])), jnp.asarray(yaw)
    sample = jax.vmap(lambda key: commands.sample(config, key, bounds, yaw, 0.5, before))
    return sample(jax.random.split(KEY, n))


@pytest.mark.parametrize(
    ("vx", "vy", "expected"),
    [
        (1.0, -0.3, [1.0, -0.3]),
        (0.1, 0.1, [0.0, 0.0]),  # norm 0.141
        (0.2, 0.0, [0.0, 0.0]),  # exactly on the edge
        (0.0, -0.21, [0.0, -0.21]),
        (-0.15, 0.15, [-0.15, 0.15]),  # norm 0.212, though both are small
    ],
)
def test_dead_zone(vx, vy, expected):
    np.testing.assert_allclose(draw(vx, vy).velocity[:2], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("heading", "yaw", "rate"),
    [
        (1.0, 0.2, 0.4),  # 0.5 * 0.8
        (0.2, 1.0, -0.4),
        (3.0, 0.0, 1.0),  # 1.5, clipped
        (-3.0, 0.0, -1.0),
        (3.0, -3.0, -0.1415927),  # the short way round: 6 - 2 pi = -0.2831853
        (-3.0, 3.0, 0.1415927),
    ],
)
def test_heading_error_becomes_a_yaw_rate(heading, yaw, rate):
    command = draw(1.0, 0.0, heading, yaw)
    np.testing.assert_allclose(command.velocity, [1.0, 0.0, rate], atol=1e-6)
    assert float(command.heading) == pytest.approx(heading)
    # Again from the next yaw: nothing accumulates.
    turned = jax.jit(lambda c, y: commands.steer(PAPER, c, y, DT))(command, jnp.asarray(heading))
    np.testing.assert_allclose(turned.velocity, [1.0, 0.0, 0.0], atol=1e-6)


def test_gain_and_limit_of_the_yaw_rate_are_the_configs():
    config = dataclasses.replace(PAPER, heading_gain=2.0, max_yaw_rate=0.7)
    command = make_command(velocity=[1.0, 0.0, 0.0], heading=0.3)
    for yaw, rate in ((0.0, 0.6), (-0.1, 0.7), (0.4, -0.2)):
        got = commands.steer(config, command, jnp.asarray(yaw), DT).velocity[2]
        assert float(got) == pytest.approx(rate, abs=1e-6)


@pytest.mark.parametrize(
    ("vx", "vy", "heading"),
    [
        (0.0, 0.3, 2.0),  # the full range
        (2.0, 0.15, 1.5),  # half: 1 + (2 - 1) / 2
        (-1.0, 0.225, 1.75),  # three quarters
        (4.0, 0.0, 1.0),  # no range
        (6.0, 0.0, 1.0),
    ],
)
def test_fast_commands_are_narrow(vx, vy, heading):
    """vy and heading - yaw keep the share 1 - |vx| / 4. Here narrow_speed is 4 m/s, yaw 1 rad, vy
    0.3 m/s and heading 2 rad."""
    command = draw(vx, 0.3, 2.0, 1.0, narrow_speed=4.0)
    np.testing.assert_allclose(command.velocity[:2], [vx, vy], atol=1e-6)
    assert float(command.heading) == pytest.approx(heading, abs=1e-6)


@pytest.mark.parametrize("vx", [0.0, -1.0, 2.0, 3.5, 5.0])
@pytest.mark.parametrize("narrow", [0.0, 4.0])
def test_no_command_is_wider_than_the_widest(vx, narrow):
    """Commands of the largest vy and with headings all around come as close to it as drawn."""
    config = dataclasses.replace(PAPER, vy=(0.3, 0.3), heading_gain=0.2, narrow_speed=narrow)
    velocity = np.abs(draw_many(config, vx=(vx, vx)).velocity)
    _, left, turn = commands.widest(config, vx)
    np.testing.assert_allclose(velocity[:, 1], left, atol=1e-6)
    assert 0.98 * turn <= velocity[:, 2].max() <= turn + 1e-6

    """The short way from yaw 3 to heading -3 is 0.2831853 rad; half of it is added to 3."""
    command = draw(2.0, 0.0, -3.0, 3.0, narrow_speed=4.0)
    assert float(command.heading) == pytest.approx(3.1415927, abs=1e-6)
    assert float(command.velocity[2]) == pytest.approx(0.5 * 0.1415927, abs=1e-6)


def test_no_narrowing_by_default():
    command = draw(3.5, 0.3, 2.0, 1.0)
    np.testing.assert_allclose(command.velocity, [3.5, 0.3, 0.5], atol=1e-6)


def test_stand_commands():
    """Zero velocity and the present heading. The clock stops only with `stand_still`."""
    command = draw(3.0, 0.0, 2.0, 1.0, stand_fraction=1.0, stand_still=True)
    assert command.velocity.tolist() == [0.0, 0.0, 0.0]
    assert float(command.heading) == 1.0 and not bool(command.moving)
    marching = draw(3.0, 0.0, 2.0, 1.0, stand_fraction=1.0)
    assert marching.velocity.tolist() == [0.0, 0.0, 0.0] and bool(marching.moving)


def test_forward_commands_have_no_side_speed():
    command = draw(1.0, 0.3, 0.0, 0.0, forward_fraction=1.0)
    np.testing.assert_allclose(command.velocity, [1.0, 0.0, 0.0], atol=1e-6)


def test_forward_commands_keep_the_heading():
    """CommandConfig.forward_fraction: straight ahead, with the present heading."""
    command = draw(1.0, 0.3, 2.0, 1.0, forward_fraction=1.0)
    assert float(command.heading) == pytest.approx(1.0)
    np.testing.assert_allclose(command.velocity, [1.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("vx", "mean", "most"),
    [
        ((-0.3, 3.5), 0.35, 1.0),
        ((-0.3, 0.5), 0.1, 0.5),  # the whole range is slow
        ((1.5, 3.5), 1.5, 1.5),  # no part of the range is slow
    ],
)
def test_slow_commands(vx, mean, most):
    """Slow commands are uniform from the range's lower end to `slow_speed`, within the range."""
    config = dataclasses.replace(PAPER, dead_zone=0.0, slow_fraction=1.0, slow_speed=1.0)
    speeds = np.asarray(draw_many(config, vx=vx).velocity[:, 0])
    assert speeds.mean() == pytest.approx(mean, abs=0.02)
    assert speeds.min() == pytest.approx(vx[0], abs=0.01)
    assert speeds.max() == pytest.approx(most, abs=0.01)


def test_a_share_of_the_commands_is_slow():
    """A quarter is drawn slow. Of the rest, 1.3 / 3.8 is slow by chance: 0.507 in all."""
    config = dataclasses.replace(PAPER, dead_zone=0.0, slow_fraction=0.25, slow_speed=1.0)
    speeds = np.asarray(draw_many(config).velocity[:, 0])
    assert (speeds < 1.0).mean() == pytest.approx(0.25 + 0.75 * 1.3 / 3.8, abs=0.03)


@pytest.mark.parametrize(("before", "share"), [(3.0, 0.4), (1.5, 0.0)])
def test_fast_commands_are_followed_by_stops_and_reversals(before, share):
    """The range ends at 3.5 m/s. After a command above half of it, two fifths of the next commands
    brake: one half of these means "stand", the other half goes back at -0.3 m/s, straight."""
    config = dataclasses.replace(PAPER, dead_zone=0.0, brake_fraction=0.4)
    drawn = draw_many(config, before=make_command(velocity=[before, 0.0, 0.0]))
    vx, vy, _ = np.asarray(drawn.velocity).T
    stops, reversals = vx == 0.0, vx == np.float32(-0.3)
    assert stops.mean() == pytest.approx(share / 2, abs=0.03)
    assert reversals.mean() == pytest.approx(share / 2, abs=0.03)
    assert not vy[stops | reversals].any()


def test_the_command_approaches_the_wanted_one():
    """At 4 m/s^2 for 0.01 s a step: 0.04 m/s, straight towards (3, 4) / 10, which takes 12.5."""
    config = dataclasses.replace(PAPER, acceleration=4.0, stand_still=True)
    steer = jax.jit(lambda c: commands.steer(config, c, jnp.zeros(()), DT))
    start = commands.standing(jnp.zeros(()))
    command = commands.with_velocity(config, start, jnp.array([0.3, 0.4, 0.0]))
    assert command.velocity.tolist() == [0.0, 0.0, 0.0] and bool(command.moving)
    for step in range(1, 16):
        command = steer(command)
        part = min(0.04 * step, 0.5)
        np.testing.assert_allclose(command.velocity, [0.6 * part, 0.8 * part, 0.0], atol=1e-6)
    np.testing.assert_array_equal(command.velocity[:2], command.wanted)
    # The robot stands when the command is zero, not when zero is wanted.
    command = commands.with_velocity(config, command, jnp.zeros(3))
    for step in range(13):
        assert bool(command.moving), step
        command = steer(command)
    assert not bool(command.moving) and not command.velocity.any()


def test_a_new_command_starts_from_the_one_before():
    config = dataclasses.replace(PAPER, acceleration=4.0, vy=(0.2, 0.2))
    before = make_command(velocity=[3.0, 0.0, 0.0])
    vx = jnp.asarray(1.0)
    command = commands.sample(config, KEY, (vx, vx), jnp.zeros(()), 0.5, before)
    assert command.velocity[:2].tolist() == [3.0, 0.0]
    np.testing.assert_allclose(command.wanted, [1.0, 0.2])


@pytest.mark.parametrize(
    ("velocity", "moving", "left"),
    [
        ([1.0, 0.0, 0.0], True, [1.0, 0.0, 0.0]),
        ([0.0, -0.3, 0.05], True, [0.0, -0.3, 0.05]),
        ([0.0, 0.0, 0.11], True, [0.0, 0.0, 0.11]),  # turns on the spot
        ([0.0, 0.0, -0.11], True, [0.0, 0.0, -0.11]),
        ([0.0, 0.0, 0.09], False, [0.0, 0.0, 0.0]),  # turns too slowly to need a step
        ([0.0, 0.0, 0.0], False, [0.0, 0.0, 0.0]),
        ([0.15, -0.13, 0.0], False, [0.0, 0.0, 0.0]),  # within the dead zone
        ([0.15, -0.13, 0.2], True, [0.0, 0.0, 0.2]),
        ([0.15, -0.14, 0.0], True, [0.15, -0.14, 0.0]),
    ],
)
@pytest.mark.parametrize("jit", [False, True])
def test_when_a_command_means_standing_still(velocity, moving, left, jit):
    config = dataclasses.replace(PAPER, stand_still=True)
    f = jax.jit(commands.with_velocity, static_argnums=0) if jit else commands.with_velocity
    command = f(config, make_command(), jnp.asarray(velocity))
    assert bool(command.moving) == moving
    np.testing.assert_allclose(command.velocity, left)
    always = commands.with_velocity(PAPER, make_command(moving=False), jnp.asarray(velocity))
    assert bool(always.moving)
    np.testing.assert_allclose(always.velocity, [*left[:2], velocity[2]])


def test_a_turn_on_the_spot_ends_and_does_not_begin_again():
    """A heading error of 0.3 rad commands 0.5 * 0.3 rad/s, which is more than 0.1 rad/s."""
    config = dataclasses.replace(PAPER, stand_still=True)
    turning = commands.steer(config, make_command(heading=0.0), jnp.asarray(0.3), DT)
    assert bool(turning.moving)
    np.testing.assert_allclose(turning.velocity, [0.0, 0.0, -0.15], atol=1e-6)
    there = commands.steer(config, turning, jnp.asarray(0.19), DT)
    assert not bool(there.moving) and not there.velocity.any()
    away = commands.steer(config, there, jnp.asarray(0.3), DT)
    assert not bool(away.moving) and not away.velocity.any()
    again = commands.with_velocity(config, away, jnp.zeros(3))  # as a user's command, or a trial's
    assert bool(commands.steer(config, again, jnp.asarray(0.3), DT).moving)


def test_no_robot_can_choose_whether_its_command_is_to_stand():
    """4000 drawn commands of the recipe, the same for robots that turn wildly and for robots that
    go straight: who is to step, and when, is the same. Only turns on the spot end with the turn.
    """
    config, steps = preset("laptop").command, 200
    assert steps * DT * config.acceleration > 3.5  # enough for a stop from the running speed
    at = jax.jit(jax.vmap(lambda c, yaw: commands.steer(config, c, yaw, DT), (0, None)))
    running = make_command(velocity=[3.5, 0.0, 0.0])
    for before in (commands.standing(jnp.zeros(())), running):
        straight = wild = drawn = draw_many(config, before=before)
        walks = jnp.any(drawn.wanted != 0.0, axis=1)
        stands = ~walks & ~drawn.turns
        assert float(stands.mean()) > 0.1 and float(jnp.mean(~walks & ~stands)) > 0.01
        for yaw in 0.04 * np.arange(1, steps + 1):
            straight, wild = at(straight, jnp.zeros(())), at(wild, jnp.asarray(yaw))
            decided = walks | stands
            np.testing.assert_array_equal(straight.moving[decided], wild.moving[decided])
            assert bool(straight.moving[walks].all())
        assert not bool(wild.moving[stands].any())


def test_fractions_and_ranges():
    """30 % stand, 20 % of all go straight, the rest fill their ranges. 4000 draws allow +-0.03."""
    config = dataclasses.replace(
        PAPER, stand_fraction=0.3, forward_fraction=0.2, stand_still=True, dead_zone=0.0
    )
    command = draw_many(config)
    vx, vy = command.velocity[:, 0], command.velocity[:, 1]
    assert float(jnp.mean(vx == 0.0)) == pytest.approx(0.3, abs=0.03)
    assert float(jnp.mean((vx != 0.0) & (vy == 0.0))) == pytest.approx(0.2, abs=0.03)
    free = vy != 0.0
    assert float(vx.min()) == pytest.approx(-0.3, abs=0.01)
    assert float(vx.max()) == pytest.approx(3.5, abs=0.01)
    assert float(vy.min()) == pytest.approx(-0.3, abs=0.01)
    assert float(vy.max()) == pytest.approx(0.3, abs=0.01)
    assert float(jnp.mean(vx, where=free)) == pytest.approx(1.6, abs=0.1)
    heading = command.heading[free]
    assert float(heading.min()) == pytest.approx(-3.14, abs=0.02)
    assert float(heading.max()) == pytest.approx(3.14, abs=0.02)
    assert abs(float(jnp.corrcoef(vx[free], vy[free])[0, 1])) < 0.06  # separate keys


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(st.floats(-5, 5), st.floats(0.1, 5))
def test_speed_share(vx, v_max):
    share = commands.speed_share(make_command(velocity=[vx, 9.0, 9.0]), jnp.asarray(v_max))
    assert float(share) == pytest.approx(min(abs(vx) / v_max, 1.0), rel=1e-5)
