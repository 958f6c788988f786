"""The whole train step: windows, one trace, determinism, masks, entropy, curriculum input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kslc_jax import checkpoint_format, env, networks, rollout, train_step
from kslc_jax.config import preset


@pytest.fixture(scope="module")
def made():
    """Debug preset: (config, init, jitted step)."""
    config = preset("debug")
    init, step = train_step.make(config)
    return config, init, step


def leaves(state):
    """All leaves as numpy arrays; a random key as its data."""
    return [checkpoint_format.host_array(x) for x in jax.tree.leaves(state)]


def assert_same(a, b):
    for x, y in zip(leaves(a), leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_same_seed_same_bits_and_one_trace(made):
    """Two runs of three train steps from one seed are bit-identical. Only the first step is
    traced."""
    config, init, step = made
    finals = []
    for _ in range(2):
        state, metrics = step(init())
        with jax.no_tracing():
            for _ in range(2):
                state, metrics = step(state)
        finals.append((state, metrics))
    assert_same(finals[0], finals[1])
    other = train_step.make(dataclasses.replace(config, seed=1))[0]()
    kernels = [x.learner.params["actor"]["Dense_0"]["kernel"] for x in (other, init())]
    assert not np.array_equal(*kernels)


def test_state_is_donated(made):
    _, init, step = made
    state = init()
    leaf = state.env.physics.qpos
    step(state)
    assert leaf.is_deleted()


@pytest.mark.parametrize(("fades", "v_max", "coef"), [(True, 3.5, 0.003 / 7), (False, 3.5, 0.003)])
def test_entropy_bonus_fades_with_the_way_that_is_left(made, fades, v_max, coef):
    """0.003 at v_max 0.5 m/s and 0 at 4.0 m/s: a seventh of it at 3.5 m/s."""
    config, init, _ = made
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, entropy_fades=fades))
    state = init()
    curriculum = state.curriculum.replace(v_max=jnp.asarray(v_max))
    constants = train_step.rollout_constants(config, state.replace(curriculum=curriculum))
    assert float(constants.entropy_coef) == pytest.approx(coef)
    np.testing.assert_allclose(jnp.exp(constants.log_std), config.network.init_std, rtol=1e-6)


def test_metrics_are_finite_and_named(made):
    config, init, step = made
    _, metrics = step(init())
    assert all(np.isfinite(v) for v in metrics.values())
    terms = {n.removeprefix("reward/") for n in metrics if n.startswith("reward/")}
    assert terms == {f.name for f in dataclasses.fields(config.rewards.weights)}


@pytest.mark.slow(reason="compiles a rollout; below, windows give the means of the samples")
def test_gathered_windows_equal_stacked_histories(made):
    """Histories rebuilt from single frames equal those that the actor saw, also across resets."""
    config, init, _ = made
    envs = init().env
    # Random ages and full histories, as in the middle of a training.
    key = jax.random.key(3)
    envs = envs.replace(
        history=jax.random.normal(key, envs.history.shape),
        privileged_history=jax.random.normal(key, envs.privileged_history.shape),
        time=jnp.full_like(envs.time, config.episode_steps - 4),
    )
    params = networks.init(config, jax.random.key(0))
    curriculum = train_step.curriculum_lib.init(config)
    seen, state, frames, ages = [], envs, [], []
    step = jax.jit(
        lambda e, k: rollout.collect(
            dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, rollout_steps=1)),
            params,
            e,
            curriculum,
            k,
        )[0]
    )
    for i in range(8):  # the time limit ends all episodes after four steps
        seen.append(state.history)
        frames.append(state.history[:, -1])
        ages.append(state.time)
        state = step(state, jax.random.key(i))
    assert any(bool(jnp.any(a == 0)) for a in ages), "some episode should have restarted"
    gather = rollout.windows(envs.history, jnp.stack(frames), jnp.stack(ages))
    windows = gather(jnp.arange(8 * config.env.num_envs))
    stacked = jnp.stack(seen).reshape(windows.shape)
    np.testing.assert_array_equal(windows, stacked)


def test_broken_samples_are_masked(made):
    config, init, _ = made
    state = init()
    env = state.env
    qvel = env.physics.qvel.at[0, 8].set(jnp.nan)
    state = state.replace(env=env.replace(physics=env.physics.replace(qvel=qvel)))
    new, metrics = train_step.make(config)[1](state)
    assert metrics["broken"] == pytest.approx(1 / config.batch_size)
    assert all(np.all(np.isfinite(x)) for x in leaves(new) if x.dtype.kind == "f")
    assert metrics["ppo/skipped"] == 0


def test_paper_preset_traces():
    """The train step of the paper's size has consistent shapes. It is traced, not run."""
    config = preset("paper")
    state = jax.eval_shape(lambda: train_step.init(config, 0))
    new, _ = jax.eval_shape(lambda s: train_step.step(config, s), state)
    assert jax.tree.map(lambda x: x.shape, new) == jax.tree.map(lambda x: x.shape, state)
    assert state.env.history.shape == (4096, 15, 59)


@pytest.mark.slow(reason="trains for about three minutes")
def test_small_training_earns_more_and_more():
    """With 256 environments and 60 updates, the reward grows by at least a tenth."""
    base = preset("laptop")
    config = dataclasses.replace(base, env=dataclasses.replace(base.env, num_envs=256))
    init, step = train_step.make(config)
    state, rewards = init(), []
    for _ in range(60):
        state, metrics = step(state)
        rewards.append(float(metrics["reward"]))
    assert np.mean(rewards[-10:]) > 1.1 * np.mean(rewards[5:15])


def test_what_update_and_curriculum_are_given(made, monkeypatch):
    """The update sees the samples as the rollout saw them. Advantages and the averages of the
    curriculum equal those by hand. Half of the episodes reach the time limit in the rollout; one
    robot is broken from the start."""
    config, init, _ = made

    def update(ppo_config, apply, constants, learner, samples, key):
        params, seen = learner.params, apply(learner.params, samples.index)
        other = params | {"estimator": jax.tree.map(lambda x: x + 0.1, params["estimator"])}
        later = apply(other, samples.index)  # as after a gradient step
        return learner, {"samples": samples, "seen": seen, "later": later}

    monkeypatch.setattr(train_step.ppo, "update", update)
    monkeypatch.setattr(
        train_step, "metrics_of", lambda c, new, out, p, losses: losses | {"outcome": out}
    )
    state, n = init(), config.env.num_envs
    half, old = jnp.arange(n) < n // 2, state.env
    time = jnp.where(half, config.episode_steps - 4, 296).at[0].set(196)  # settled from 200 on
    vx = old.command.velocity.at[:, 0].set(0.2 + 0.3 * half)
    old = old.replace(
        time=time,
        history=jax.random.normal(jax.random.key(1), old.history.shape),
        privileged_history=jax.random.normal(jax.random.key(2), old.privileged_history.shape),
        command=old.command.replace(velocity=vx, wanted=vx[:, :2]),
        physics=old.physics.replace(qvel=old.physics.qvel.at[-1, 8].set(jnp.nan)),
    )
    new, got = jax.jit(lambda s: train_step.step(config, s))(state.replace(env=old))
    dist, value, _ = got["seen"]
    np.testing.assert_allclose(dist.mean, got["samples"].mean, atol=1e-5)
    np.testing.assert_allclose(value, got["samples"].value, atol=1e-5)
    # The actor reads the estimates of the rollout: a better estimator moves no action.
    np.testing.assert_allclose(got["later"][0].mean, got["samples"].mean, atol=1e-5)
    assert np.abs(got["later"][2] - got["seen"][2]).max() > 0.01
    log_prob = dist.log_prob(got["samples"].action)
    np.testing.assert_allclose(log_prob, got["samples"].log_prob, atol=1e-3)
    samples, out = jax.tree.map(np.asarray, (got["samples"], got["outcome"]))
    value, advantage = samples.value.reshape(-1, n), samples.advantage.reshape(-1, n)
    last = np.asarray(networks.value(config, new.learner.params, new.env.privileged_history))
    assert out.broken.sum() == 1 and np.array_equal(samples.valid, ~out.broken.ravel())
    assert out.truncated.sum() == n // 2 - 1 and 0 < out.fast.sum() < out.settled.sum()
    cut = out.truncated | (out.ends_command & ~out.terminated)
    following, done = np.r_[value[1:], last[None]], out.terminated | cut
    delta = out.reward + 0.994 * np.where(cut, value, following * ~done) - value
    trace = np.zeros(n)
    for t in reversed(range(len(value))):
        trace = delta[t] + 0.994 * 0.9 * ~done[t] * trace
        np.testing.assert_allclose(advantage[t], trace, atol=1e-4)
    for name, x, mask in (
        ("tracking", out.terms["tracking_lin_vel"], out.settled),
        ("fast_tracking", out.terms["tracking_lin_vel"], out.fast),
        ("episode_steps", out.episode_steps, out.terminated | out.truncated),
        ("gait", out.terms["feet_contact_number"], out.fast),
    ):
        average = float(getattr(new.curriculum, name))
        gain = 1.0 if mask is out.fast else 0.05  # 0.95 * 0 + 0.05 * new; the others start anew
        assert average == pytest.approx(gain * x[mask & ~out.broken].mean(), rel=1e-4), name
    assert int(new.curriculum.updates) == 1
    keys = [jax.random.key_data(train_step.step_keys(x)[0]) for x in (state, new)]
    assert not np.array_equal(*keys)


@pytest.mark.parametrize("per_command", [True, False])
def test_a_new_command_ends_the_sum_of_rewards(made, per_command):
    """By hand, for rewards of 1, a value of 10, gamma 0.994 and lambda 0.9. The value after the new
    command is 99: a value per command does not see it. A fall in the same step earns nothing."""
    config, *_ = made
    ppo = dataclasses.replace(config.ppo, value_per_command=per_command, rollout_steps=2)
    config = dataclasses.replace(config, ppo=ppo, env=dataclasses.replace(config.env, num_envs=2))
    no, blank = jnp.zeros((2, 2), bool), jnp.zeros((2, 2))
    out = env.Outcome(**dict.fromkeys(env.Outcome.__dataclass_fields__, no)).replace(
        reward=blank + 1.0,
        ends_command=no.at[1].set(True),
        terminated=no.at[1, 1].set(True),
    )
    names = rollout.Trajectory.__dataclass_fields__
    traj = rollout.Trajectory(**dict.fromkeys(names, blank)).replace(
        value=blank + 10.0, outcome=out
    )
    samples = train_step.samples_of(config, traj, jnp.array([99.0, 99.0]))
    goes_on = 1.0 + 0.994 * (10.0 if per_command else 99.0) - 10.0
    falls = 1.0 - 10.0
    before = 1.0 + 0.994 * 10.0 - 10.0
    found = samples.advantage.reshape(2, 2)
    np.testing.assert_allclose(found[1], [goes_on, falls], rtol=1e-5)
    np.testing.assert_allclose(
        found[0], before + 0.994 * 0.9 * np.array([goes_on, falls]), rtol=1e-5
    )


def test_robots_start_unlike_each_other(made):
    env = made[1]().env
    assert len(np.unique(env.dynamics.friction)) == len(np.unique(env.time)) == 16
    assert len(np.unique(env.command.heading)) > 8


def test_samples_whose_costs_exceed_what_they_earn_are_counted(made):
    """Two of six; the last one is broken, which `broken` counts."""
    config, init, _ = made
    blank = jnp.zeros(6)
    out = env.Outcome(**dict.fromkeys(env.Outcome.__dataclass_fields__, blank)).replace(
        reward=jnp.array([0.0, 0.1, 0.0, 0.2, 0.3, 0.0]),
        broken=jnp.arange(6) == 5,
        terms={"tracking_lin_vel": blank, "feet_contact_number": blank},
        **dict.fromkeys(
            ("settled", "fast", "top", "braking", "ends_command", "terminated", "truncated"),
            blank > 0,
        ),
    )
    progress = train_step.progress_of(config, out)
    metrics = train_step.metrics_of(config, init(), out, progress, {})
    assert float(metrics["no_reward"]) == pytest.approx(2 / 6)
    assert float(metrics["broken"]) == pytest.approx(1 / 6)


def test_slow_commands_at_the_top_count_as_if_they_were_faster():
    """Commands of 0.5 and 4.0 m/s give speeds of 0.4 and 4.3 m/s: deviation -0.1 + 0.3, scale 3.0 +
    4.0. The third command has not settled, and the others are not at the top. Three robots fall at
    the top or soon after it; the fourth falls elsewhere, and the sixth is broken."""
    no = jnp.zeros(6, bool)
    out = env.Outcome(
        reward=jnp.zeros(6),
        terminated=jnp.array([False, True, True, True, True, True]),
        truncated=no,
        broken=no.at[5].set(True),
        terms={"tracking_lin_vel": jnp.zeros(6), "feet_contact_number": jnp.zeros(6)},
        settled=jnp.array([True, True, False, True, False, False]),
        fast=no,
        top=jnp.array([True, True, True, False, False, False]),
        braking=jnp.array([False, False, False, False, True, True]),
        ends_command=no,
        commanded=jnp.array([0.5, 4.0, 4.0, 1.0, 0.0, 0.0]),
        speed=jnp.array([0.4, 4.3, 0.0, 0.0, 0.0, 0.0]),
        episode_steps=jnp.zeros(6, int),
        speeding=no,
    )
    progress = train_step.progress_of(preset("laptop"), out)
    assert float(progress.top_deviation) == pytest.approx(0.2)
    assert float(progress.top_scale) == pytest.approx(7.0)
    assert float(progress.top_falls) == 3.0
    assert float(progress.top_minutes) == pytest.approx(4 * 0.01 / 60)
