"""Punches and held arms: their times, sizes and directions, and how they reach the engine."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kslc_jax import curriculum, disturbances, env, robot
from kslc_jax.config import RandomizeConfig, preset

DT = 0.01
SEED = jnp.uint32(1)


def punches(steps: int, low: float, high: float) -> np.ndarray:
    """[steps, nbody, 6] forces of the first control steps."""
    config, xbot = RandomizeConfig(punch=(low, high)), robot.load("high")
    punch = jax.jit(jax.vmap(lambda i: disturbances.punch(config, xbot, SEED, i, DT)))
    return np.asarray(punch(jnp.arange(steps)))


def test_punches_come_every_four_seconds_for_eight_steps():
    """The first after 2 s; at other links and in other directions each time, never at the world."""
    forces = punches(4000, 300.0, 300.0)
    size = np.linalg.norm(forces, axis=(1, 2))
    hit = np.flatnonzero(size)
    np.testing.assert_array_equal(
        hit, np.add.outer(200 + 400 * np.arange(10), np.arange(8)).ravel()
    )
    np.testing.assert_allclose(size[hit], 300.0, rtol=1e-5)
    assert not forces[:, 0].any() and not forces[..., 3:].any()
    links = [int(np.flatnonzero(forces[i].any(-1))[0]) for i in hit[::8]]
    assert len(set(links)) > 3


def test_sizes_and_directions_are_uniform():
    """Over 500 punches: sizes from 100 to 200 N, and no direction is preferred."""
    forces = punches(200_000, 100.0, 200.0)[200::400, :, :3].sum(axis=1)
    size = np.linalg.norm(forces, axis=1)
    assert size.min() == pytest.approx(100.0, abs=3) and size.max() == pytest.approx(200.0, abs=3)
    ways = forces / size[:, None]
    assert np.abs(ways.mean(axis=0)).max() < 0.1
    np.testing.assert_allclose(np.square(ways).mean(axis=0), 1 / 3, atol=0.05)


def test_held_arms_walk_slowly_within_their_limits():
    xbot = robot.load("high")

    def walk(targets, i):
        new = disturbances.walk_arms(xbot, targets, SEED, i, DT)
        return new, new

    _, path = jax.lax.scan(jax.jit(walk), jnp.zeros(16), jnp.arange(6000))
    path = np.asarray(path)
    assert np.abs(np.diff(path, axis=0)).max() <= disturbances.ARM_RATE * DT + 1e-6
    assert (path >= xbot.joint_lower - 1e-6).all() and (path <= xbot.joint_upper + 1e-6).all()
    assert np.ptp(path[:, xbot.is_arm], axis=0).min() > 0.3


def given_to_the_engine(randomize: RandomizeConfig, time: int, key: int = 0):
    """(targets of the joints, force) that the engine gets at this time for an action of 1."""
    config = dataclasses.replace(preset("debug"), randomize=randomize)
    quiet = dataclasses.replace(config.env, noise_level=0.0, action_delay=0.0, action_noise=0.0)
    config, given = dataclasses.replace(config, env=quiet), []

    def simulate(physics_config, state, target, dynamics, ground_friction, force):
        given.append((np.asarray(target), force))
        return state

    cur = curriculum.init(config)
    state = env.reset(config, jax.random.key(key), cur).replace(time=jnp.int32(time))
    env.step(config, state, jnp.ones(16), jax.random.key(1), cur, simulate)
    return given[0]


def test_an_environment_is_punched_at_the_time_of_its_episode(xbot):
    plain = RandomizeConfig()
    assert given_to_the_engine(plain, 203)[1] is None
    punched = dataclasses.replace(plain, punch=(50.0, 50.0))
    _, force = given_to_the_engine(punched, 203)
    assert np.linalg.norm(force) == pytest.approx(50.0, rel=1e-5)
    assert not np.any(given_to_the_engine(punched, 210)[1])


def test_held_arms_follow_their_targets_and_legs_the_actions(xbot):
    """The first targets of held arms are the joint angles at the reset, moved on by one step."""
    held = dataclasses.replace(RandomizeConfig(), held_arms=1.0)
    target, force = given_to_the_engine(held, 0)
    assert not np.any(force)
    legs = ([0.25] * 4 + [0.85] * 2) * 2  # see test_soft_servos_have_larger_actions
    np.testing.assert_allclose(target[~xbot.is_arm], legs, atol=1e-6)
    arms = target[xbot.is_arm]
    assert np.abs(arms).max() <= 0.1 + disturbances.ARM_RATE * DT and np.ptp(arms) > 0.01


def test_the_share_of_held_arms():
    config, start = RandomizeConfig(held_arms=0.3), jnp.zeros(16)
    draw = jax.jit(jax.vmap(lambda key: disturbances.start(config, key, start).arms_held))
    held = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)))
    assert held.mean() == pytest.approx(0.3, abs=0.03)
