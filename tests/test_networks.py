"""Actor and critic: mirror symmetry, sizes, initial output, and the velocity estimate."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from states import ACTOR, CRITIC, MIRROR, XBOT, random_params

from kslc_jax import networks, observations
from kslc_jax.config import ConfigError, NetworkConfig, preset

CONFIG = preset("debug")
KEY = jax.random.key(3)


def mirrored(table, frames):
    permutation, sign = observations.mirror_map(table, XBOT)
    return frames[..., permutation] * sign


@pytest.mark.parametrize(
    "mirror",
    [
        observations.mirror_map(ACTOR, XBOT),
        observations.mirror_map(CRITIC, XBOT),
        MIRROR,
        (np.array([2, 1, 0, 3]), np.array([1.0, 1.0, 1.0, -1.0])),
    ],
)
def test_parity_splits_every_vector(mirror):
    permutation, sign = mirror
    p = networks.parity(permutation, sign)
    basis = np.concatenate([p.even, p.odd], axis=1)
    np.testing.assert_allclose(basis.T @ basis, np.eye(len(sign)), atol=1e-6)
    np.testing.assert_allclose(p.even[permutation] * sign[:, None], p.even, atol=1e-6)
    np.testing.assert_allclose(p.odd[permutation] * sign[:, None], -p.odd, atol=1e-6)


def test_value_of_a_mirrored_robot_is_the_same():
    params = random_params(CONFIG)
    table = observations.critic_table(XBOT, CONFIG.env.critic_memory)
    shape = 5, CONFIG.env.privileged_frames, observations.width(table)
    frames = jax.random.normal(KEY, shape)
    here = networks.value(CONFIG, params, frames)
    there = networks.value(CONFIG, params, mirrored(table, frames))
    np.testing.assert_allclose(here, there, rtol=1e-4, atol=1e-5)
    assert np.std(here) > 0.1


def test_action_of_a_mirrored_robot_is_mirrored_for_any_weights():
    params = random_params(CONFIG)
    history = jax.random.normal(KEY, (5, CONFIG.env.frames, observations.actor_width(XBOT)))
    here = networks.policy(CONFIG, params, history).mean
    there = networks.policy(CONFIG, params, mirrored(ACTOR, history)).mean
    joints, sign = MIRROR
    np.testing.assert_allclose(there, here[:, joints] * sign, rtol=1e-4, atol=1e-5)
    assert np.std(here) > 0.1


def test_symmetric_networks_have_half_the_weights():
    def size(config):
        actor = jax.eval_shape(lambda: networks.init(config, KEY))["actor"]
        return sum(x.size for x in jax.tree.leaves(actor) if x.ndim == 2)

    free = dataclasses.replace(CONFIG.network, symmetric=False)
    assert size(CONFIG) / size(dataclasses.replace(CONFIG, network=free)) == pytest.approx(0.5)


@pytest.mark.parametrize("symmetric", [False, True])
def test_init_mean_scales_the_first_actions(symmetric):
    history = jax.random.normal(KEY, (64, CONFIG.env.frames, observations.actor_width(XBOT)))

    def size(init_mean):
        network = dataclasses.replace(CONFIG.network, symmetric=symmetric, init_mean=init_mean)
        config = dataclasses.replace(CONFIG, network=network)
        mean = networks.policy(config, networks.init(config, KEY), history).mean
        return float(np.std(np.asarray(mean)))

    assert size(0.01) == pytest.approx(0.01 * size(1.0), rel=1e-3)
    assert 0.1 < size(1.0) < 2.0


def test_pairs_need_even_sizes():
    with pytest.raises(ConfigError, match=r"must be even with network\.symmetric"):
        NetworkConfig(actor=(32, 15), symmetric=True)


def test_networks_have_the_papers_sizes():
    config = preset("paper")
    params = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
    shapes = lambda net: [params[net][f"Dense_{i}"]["kernel"].shape for i in range(4)]  # noqa: E731
    assert shapes("actor") == [(15 * 59, 512), (512, 256), (256, 128), (128, 16)]
    assert shapes("critic") == [(3 * 89, 768), (768, 256), (256, 128), (128, 1)]


def test_the_estimate_mirrors_and_only_its_own_error_trains_it():
    """In the mirror vy changes its sign. The actor reads the estimate, but the actor's gradient
    does not reach the estimator."""
    params = random_params(CONFIG)
    history = jax.random.normal(KEY, (CONFIG.env.frames, observations.actor_width(XBOT)))
    here = networks.estimate(CONFIG, params, history)
    there = networks.estimate(CONFIG, params, mirrored(ACTOR, history))
    np.testing.assert_allclose(there, here * np.array([1.0, -1.0, 1.0]), atol=1e-6)
    assert np.abs(here).min() > 1e-3

    def act(params):
        return jnp.sum(networks.policy(CONFIG, params, history).mean)

    grads = jax.grad(act)(params)
    assert all(not x.any() for x in jax.tree.leaves(grads["estimator"]))
    other = {**params, "estimator": jax.tree.map(lambda x: x + 0.1, params["estimator"])}
    assert abs(act(other) - act(params)) > 1e-4
    given = networks.policy(CONFIG, other, history, here).mean
    np.testing.assert_allclose(given, networks.policy(CONFIG, params, history).mean, atol=1e-6)


def test_without_an_estimator_nothing_is_estimated():
    config = preset("paper")
    params = jax.eval_shape(lambda: networks.init(config, KEY))
    assert "estimator" not in params


def test_even_inputs_multiply_roll_pitch_and_joint_speeds():
    """By 8, 8 and 4, before the first layer of all three networks."""
    params = random_params(CONFIG)
    plain = dataclasses.replace(
        CONFIG, network=dataclasses.replace(CONFIG.network, even_inputs=False)
    )

    def by_hand(table, frames):
        at = observations.slices(table)
        frames = frames.at[..., at["joint_vel"]].multiply(4.0)
        tilt = slice(at["base_euler"].start, at["base_euler"].start + 2)
        return frames.at[..., tilt].multiply(8.0)

    history = jax.random.normal(KEY, (CONFIG.env.frames, observations.actor_width(XBOT)))
    seen = by_hand(ACTOR, history)
    velocity = networks.estimate(CONFIG, params, history)
    np.testing.assert_allclose(velocity, networks.estimate(plain, params, seen), rtol=1e-5)
    action = networks.policy(CONFIG, params, history).mean
    np.testing.assert_allclose(action, networks.policy(plain, params, seen).mean, rtol=1e-5)
    assert np.abs(action - networks.policy(plain, params, history).mean).max() > 1e-2

    table = observations.critic_table(XBOT, CONFIG.env.critic_memory)
    privileged = jax.random.normal(KEY, (CONFIG.env.privileged_frames, observations.width(table)))
    value = networks.value(CONFIG, params, privileged)
    expected = networks.value(plain, params, by_hand(table, privileged))
    np.testing.assert_allclose(value, expected, rtol=1e-5)
