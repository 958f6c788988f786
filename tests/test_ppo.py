"""PPO against numbers worked out by hand, and on a problem with a known optimum."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kslc_jax import ppo
from kslc_jax.config import PPOConfig
from kslc_jax.networks import Gaussian

CONFIG = PPOConfig()


class TestGAE:
    """gamma and lambda are 0.5, so that the arithmetic is easy to follow."""

    def gae(self, reward, value, last, done, truncated):
        to = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
        args = to(reward), to(value), to(last), jnp.asarray(done), jnp.asarray(truncated)
        return ppo.gae(*args, 0.5, 0.5)

    def test_by_hand(self):
        # delta_2 = 3 + 0.5*8 - 2 = 5; delta_1 = 2 + 0.5*2 - 4 = -1; delta_0 = 1 + 0.5*4 - 1 = 2
        # A_2 = 5; A_1 = -1 + 0.25*5 = 0.25; A_0 = 2 + 0.25*0.25 = 2.0625
        no = [False] * 3
        advantage, target = self.gae([1, 2, 3], [1, 4, 2], 8, no, no)
        np.testing.assert_allclose(advantage, [2.0625, 0.25, 5.0])
        np.testing.assert_allclose(target, [3.0625, 4.25, 7.0])

    def test_termination_cuts_value_and_trace(self):
        # delta_1 = 2 - 4 = -2 (no next value); delta_0 = 1 + 0.5*4 - 1 = 2
        # A_1 = -2; A_0 = 2 + 0.25*(-2) = 1.5
        advantage, _ = self.gae([1, 2, 3], [1, 4, 2], 8, [False, True, False], [False] * 3)
        np.testing.assert_allclose(advantage, [1.5, -2.0, 5.0])

    def test_time_out_is_worth_its_value(self):
        # r_1 gains 0.5*4: delta_1 = 4 - 4 = 0; A_0 = 2 + 0
        end = [False, True, False]
        advantage, _ = self.gae([1, 2, 3], [1, 4, 2], 8, end, end)
        np.testing.assert_allclose(advantage, [2.0, 0.0, 5.0])

    def test_against_the_definition(self):
        """A_t = sum_k (gamma lam)^k delta_{t+k} up to the end of the episode, by two loops."""
        rng = np.random.default_rng(0)
        t, gamma, lam = 50, 0.994, 0.9
        reward, value, last = rng.normal(size=t), rng.normal(size=t), rng.normal()
        done = rng.random(t) < 0.1
        following = np.append(value[1:], last)
        delta = reward + gamma * following * ~done - value
        slow = np.zeros(t)
        for i in range(t):
            for k in range(i, t):
                slow[i] += (gamma * lam) ** (k - i) * delta[k]
                if done[k]:
                    break
        none = jnp.zeros(t, bool)
        args = jnp.asarray(reward), jnp.asarray(value), jnp.asarray(last), jnp.asarray(done)
        advantage, target = jax.jit(ppo.gae)(*args, none, gamma, lam)
        np.testing.assert_allclose(advantage, slow, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(target, slow + value, rtol=1e-4, atol=1e-5)


class TestGaussian:
    OLD = Gaussian(jnp.array([0.0, 1.0]), jnp.log(jnp.array([1.0, 2.0])))

    def test_log_prob(self):
        # -z^2/2 - log s - log(2 pi)/2 with z = 1, 0.5 and s = 1, 2
        expected = -0.5 - 0.125 - np.log(2) - np.log(2 * np.pi)
        assert self.OLD.log_prob(jnp.array([1.0, 2.0])) == pytest.approx(expected)

    def test_entropy(self):
        assert self.OLD.entropy() == pytest.approx(np.log(2) + np.log(2 * np.pi) + 1)

    def test_kl_by_hand_and_by_sampling(self):
        new = Gaussian(jnp.array([1.0, 1.0]), jnp.zeros(2))
        # first: the mean moves by 1 with s = 1: 1/2; second, old s 2, new s 1: log(1/2) + 4/2 - 1/2
        expected = 0.5 + np.log(0.5) + 1.5
        assert new.kl_from(self.OLD) == pytest.approx(expected)
        keys = jax.random.split(jax.random.key(0), 100_000)
        x = jax.vmap(self.OLD.sample)(keys)
        sampled = jnp.mean(self.OLD.log_prob(x) - new.log_prob(x))
        assert sampled == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(
    ("kl", "factor"), [(0.03, 1 / 1.5), (0.015, 1.0), (0.004, 1.5), (0.0, 1.0)]
)
def test_learning_rate_follows_the_kl(kl, factor):
    rate = ppo.adapt_learning_rate(CONFIG, jnp.asarray(1e-4), jnp.asarray(kl))
    assert rate == pytest.approx(1e-4 * factor)


def test_learning_rate_stays_in_bounds():
    low, high = CONFIG.learning_rate_bounds
    assert ppo.adapt_learning_rate(CONFIG, jnp.asarray(low), jnp.asarray(1.0)) == pytest.approx(low)
    assert ppo.adapt_learning_rate(CONFIG, jnp.asarray(high), jnp.asarray(1e-5)) == pytest.approx(
        high
    )


def test_learning_rate_stays_below_its_ceiling():
    """The ceiling limits the rate, but never below the lower bound of the rate."""
    low, high = CONFIG.learning_rate_bounds
    slow = jnp.asarray(1e-9)
    assert ppo.adapt_learning_rate(CONFIG, jnp.asarray(high), slow, 1e-4) == pytest.approx(1e-4)
    assert ppo.adapt_learning_rate(CONFIG, jnp.asarray(high), slow, 0.1 * low) == pytest.approx(low)


CONSTANTS = ppo.RolloutConstants(log_std=jnp.zeros(1), entropy_coef=jnp.zeros(()))


def samples(**changes):
    base = ppo.Samples(
        index=jnp.arange(2),
        action=jnp.zeros((2, 1)),
        mean=jnp.zeros((2, 1)),
        log_prob=jnp.full(2, -0.9189385),  # log N(0; 0, 1)
        value=jnp.zeros(2),
        advantage=jnp.array([1.0, -1.0]),
        target=jnp.array([1.0, 2.0]),
        valid=jnp.ones(2, bool),
    )
    return base.replace(**changes)


def bandit_apply(params, index):
    """Policy and value that do not depend on the observation."""
    mean = jnp.broadcast_to(params["mean"], (index.shape[0], 1))
    value = jnp.broadcast_to(params["value"], index.shape)
    return Gaussian(mean, params["log_std"]), value, jnp.zeros(index.shape)


def params(mean=0.0, value=0.0):
    return {"mean": jnp.asarray(mean), "log_std": jnp.zeros(1), "value": jnp.asarray(value)}


class TestLoss:
    def loss(self, params, batch):
        return ppo.loss(CONFIG, bandit_apply, CONSTANTS, params, batch, jnp.sum(batch.valid))

    def test_total(self):
        total, info = self.loss(params(mean=0.3, value=1.0), samples())
        assert total == pytest.approx(info["policy_loss"] + CONFIG.value_coef * info["value_loss"])

    def test_ratio_one(self):
        info = self.loss(params(), samples())[1]
        assert info["policy_loss"] == pytest.approx(0.0, abs=1e-6)  # -(1 - 1) / 2
        assert info["kl"] == pytest.approx(0.0, abs=1e-6)

    def test_ratio_is_clipped(self):
        # mean 1: ratio = exp(-1/2) = 0.6065; min(0.6065 * 1, 0.8) and min(-0.6065, -0.8)
        info = self.loss(params(mean=1.0), samples())[1]
        assert info["policy_loss"] == pytest.approx(-(0.60653 - 0.8) / 2, abs=1e-4)
        assert info["clip_share"] == pytest.approx(1.0)
        assert info["kl"] == pytest.approx(0.5)

    def test_value_is_clipped(self):
        # value 1, old 0: clipped to 0.2; max((1-1)^2, 0.8^2) and max(1, 1.8^2), mean
        info = self.loss(params(value=1.0), samples())[1]
        assert info["value_loss"] == pytest.approx((0.64 + 3.24) / 2)

    def test_invalid_samples_do_not_count(self):
        one = samples(valid=jnp.array([True, False]), target=jnp.array([1.0, 1e6]))
        assert self.loss(params(), one)[1]["value_loss"] == pytest.approx(1.0)

    def test_entropy_bonus(self):
        """0.01 x the entropy of N(0, 1), 1.418939."""
        constants = CONSTANTS.replace(entropy_coef=0.01)
        paid = ppo.loss(CONFIG, bandit_apply, constants, params(), samples(), jnp.asarray(2))[0]
        assert self.loss(params(), samples())[0] - paid == pytest.approx(0.01418939, rel=1e-3)


@pytest.mark.parametrize(
    ("size", "number"), [(12_288, 8), (12_289, 1), (61_440, 40), (64, 1), (1536, 1), (3074, 2)]
)
def test_a_cpu_takes_a_minibatch_in_equal_pieces(size, number):
    """12,289 is prime."""
    assert ppo.pieces(size) == number


@pytest.mark.parametrize(("name", "value"), [("default_backend", "gpu"), ("device_count", 2)])
def test_accelerators_and_several_devices_take_a_minibatch_whole(name, value, monkeypatch):
    monkeypatch.setattr(jax, name, lambda: value)
    assert ppo.pieces(12_288) == 1


def test_the_pieces_of_a_minibatch_add_up(monkeypatch):
    """Gradient and metrics of four pieces are those of the whole, also if the pieces have unlike
    numbers of valid samples, and one has none."""
    key = jax.random.key(0)

    def apply(params, index):
        dist, value, error = bandit_apply(params, index)
        return dist, value + params["slope"] * index, error + params["slope"] * index

    values = jax.random.normal(key, (5, 64))
    batch = ppo.Samples(
        index=jnp.arange(64),
        action=values[0, :, None],
        mean=0.1 * values[1, :, None],
        log_prob=-1.0 + 0.1 * values[2],
        value=values[3],
        advantage=values[4],
        target=values[3] + 1.0,
        valid=(jnp.arange(64) >= 16) & (jnp.arange(64) % 7 > 0),
    )
    constants = CONSTANTS.replace(entropy_coef=0.01)
    at = {**params(mean=0.3, value=0.5), "slope": jnp.asarray(0.02)}
    found = []
    for number in (1, 4):
        monkeypatch.setattr(ppo, "pieces", lambda size, number=number: number)
        found.append(ppo.gradient(CONFIG, apply, constants, at, batch))
    chex.assert_trees_all_close(*found, rtol=1e-5, atol=1e-6)
    assert float(found[0][1]["entropy"]) == pytest.approx(1.418939, rel=1e-5)


def test_non_finite_gradient_changes_nothing_and_is_counted():
    learner = ppo.init(CONFIG, params())
    bad = samples(target=jnp.array([jnp.nan, 1.0]))
    step = jax.jit(functools.partial(ppo.gradient_step, CONFIG, bandit_apply, CONSTANTS))
    new, info = step(learner, bad)
    chex.assert_trees_all_equal(new, learner)
    assert info["skipped"] == 1.0


def test_update_finds_the_best_action_of_a_bandit():
    """With the reward -(a - 2)^2 the mean moves from 0 to 2, and the value to the mean reward."""
    config = PPOConfig(learning_rate=1e-2, minibatches=4, epochs=4)
    learner = ppo.init(config, params())

    @jax.jit
    def iterate(learner, key):
        key_act, key_update = jax.random.split(key)
        size = 512
        index = jnp.arange(size)
        dist, value, _ = bandit_apply(learner.params, index)
        action = dist.sample(key_act)
        reward = -jnp.square(action[:, 0] - 2.0)
        batch = ppo.Samples(
            index,
            action,
            dist.mean,
            dist.log_prob(action),
            value,
            reward - value,
            reward,
            index >= 0,
        )
        constants = CONSTANTS.replace(log_std=learner.params["log_std"])
        return ppo.update(config, bandit_apply, constants, learner, batch, key_update)[0]

    for key in jax.random.split(jax.random.key(0), 150):
        learner = iterate(learner, key)
    assert learner.params["mean"] == pytest.approx(2.0, abs=0.15)
    assert jnp.exp(learner.params["log_std"][0]) < 0.6
    assert learner.params["value"] == pytest.approx(0.0, abs=0.1)  # -(a - 2)^2 where a is 2


def test_each_epoch_shuffles_anew_and_takes_every_sample_once(monkeypatch):
    """2 epochs of 4 minibatches; a stand-in for the gradient step notes the samples of each."""
    config = PPOConfig(minibatches=4, epochs=2)

    def note(config, apply, constants, learner, batch):
        taken = learner.params["taken"].at[learner.params["count"]].set(batch.index)
        params = {"taken": taken, "count": learner.params["count"] + 1}
        return learner.replace(params=params), {}

    monkeypatch.setattr(ppo, "gradient_step", note)
    size = 64
    blank = jax.tree.map(lambda x: jnp.zeros((size, *x.shape[1:]), x.dtype), samples())
    batch = blank.replace(index=jnp.arange(size), valid=jnp.ones(size, bool))
    learner = ppo.init(config, params())
    empty = {"taken": jnp.zeros((8, 16), jnp.int32), "count": jnp.int32(0)}
    learner = learner.replace(params=empty, average={})
    new, _ = ppo.update(config, bandit_apply, CONSTANTS, learner, batch, jax.random.key(0))
    epochs = np.asarray(new.params["taken"]).reshape(2, -1)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), [np.arange(size)] * 2)
    assert np.mean(epochs[0] == epochs[1]) < 0.2 and np.mean(epochs[0] == np.arange(size)) < 0.2


def test_normalised_over_the_valid_samples():
    got = ppo.normalised(jnp.array([1.0, 3.0, 1e6]), jnp.array([True, True, False]))
    np.testing.assert_allclose(got[:2], [-1.0, 1.0], rtol=1e-5)


def test_a_lowered_ceiling_rises_by_two_percent_an_update():
    config = PPOConfig(minibatches=1)
    low = ppo.init(config, params()).replace(rate_ceiling=jnp.asarray(1e-3))
    new, _ = ppo.update(config, bandit_apply, CONSTANTS, low, samples(), jax.random.key(0))
    assert float(new.rate_ceiling) == pytest.approx(1.02e-3)


def test_the_average_of_the_acting_parameters_by_hand():
    """average 0.75: 0.75 old + 0.25 new. average 0: the newest. The critic is not averaged."""
    config = PPOConfig(average=0.75)
    old, new = {"log_std": jnp.asarray(1.0)}, {"log_std": jnp.asarray(2.0)}
    assert float(ppo.averaged(config, old, new)["log_std"]) == 1.25
    assert float(ppo.averaged(CONFIG, old, new)["log_std"]) == 2.0
    assert set(ppo.acting({"actor": 1, "critic": 2, "log_std": 3, "estimator": 4})) == {
        "actor",
        "estimator",
        "log_std",
    }


def test_the_estimates_error_counts_by_its_weight():
    def apply(params, index):
        return *bandit_apply(params, index)[:2], jnp.array([1.0, 3.0])

    config = PPOConfig(estimate_coef=0.5)
    without, _ = ppo.loss(config, bandit_apply, CONSTANTS, params(), samples(), jnp.asarray(2))
    total, info = ppo.loss(config, apply, CONSTANTS, params(), samples(), jnp.asarray(2))
    assert info["estimate_loss"] == 2.0 and total - without == pytest.approx(1.0)
