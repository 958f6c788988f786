"""One environment: resets, the ends of episodes, actions, pushes, commands and observations."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from states import ACTOR, CRITIC

from kslc_jax import commands, curriculum, env, observations, physics, signals
from kslc_jax.config import preset


@pytest.fixture(scope="module")
def setting():
    """Debug preset, without noise, delay and pushes; jitted reset and step."""
    base = preset("debug")
    config = dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, noise_level=0.0, action_delay=0.0, action_noise=0.0),
        randomize=dataclasses.replace(base.randomize, push_seconds=0.0),
    )
    cur = curriculum.init(config)
    reset = jax.jit(lambda key: env.reset(config, key, cur))
    step = jax.jit(lambda state, action, key: env.step(config, state, action, key, cur))
    return config, reset, step


def test_reset_is_all_that_a_new_episode_is_made_of(setting):
    """A step that ends an episode returns a new one from its own keys. No field of the old episode
    is left."""
    config, reset, step = setting
    state = reset(jax.random.key(0))
    for i in range(5):
        state, _ = step(state, jnp.ones(16), jax.random.key(i))
    fallen = state.replace(physics=state.physics.replace(qpos=state.physics.qpos.at[2].set(0.05)))
    key = jax.random.key(7)
    new, outcome = step(fallen, jnp.ones(16), key)
    assert bool(outcome.terminated) and not bool(outcome.truncated)
    *_, key_start, key_noise = jax.random.split(key, 5)
    cur = curriculum.init(config)
    fresh = env.observe(config, env.begin(config, key_start, cur), key_noise)
    for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_history_is_zero_after_a_reset_but_for_the_newest_frame(setting):
    _, reset, _ = setting
    state = reset(jax.random.key(0))
    assert not np.any(state.history[:-1]) and np.any(state.history[-1])
    assert not np.any(state.privileged_history[:-1]) and np.any(state.privileged_history[-1])


def test_time_limit_truncates(setting):
    config, reset, step = setting
    state = reset(jax.random.key(0))
    late = state.replace(time=jnp.int32(config.episode_steps - 1))
    new, outcome = step(late, jnp.zeros(16), jax.random.key(1))
    assert bool(outcome.truncated) and not bool(outcome.terminated)
    assert int(new.time) == 0 and int(outcome.episode_steps) == config.episode_steps
    new, outcome = step(state, jnp.zeros(16), jax.random.key(1))
    assert not bool(outcome.truncated) and int(new.time) == 1


def test_a_fall_in_the_last_step_is_a_fall(setting):
    """Its value is not added, as it would be at a time-out."""
    config, reset, step = setting
    state = reset(jax.random.key(0))
    low = state.physics.replace(qpos=state.physics.qpos.at[2].set(0.05))
    last = state.replace(physics=low, time=jnp.int32(config.episode_steps - 1))
    _, outcome = step(last, jnp.zeros(16), jax.random.key(1))
    assert bool(outcome.terminated) and not bool(outcome.truncated)


def test_a_push_comes_after_the_reward_and_before_the_frame(debug, monkeypatch):
    order = []
    for name in ("_outcome", "_push", "observe"):
        real = getattr(env, name)
        note = lambda *args, name=name, real=real: (order.append(name), real(*args))[1]  # noqa: E731
        monkeypatch.setattr(env, name, note)
    cur = curriculum.init(debug)
    state = jax.eval_shape(lambda: env.reset(debug, jax.random.key(0), cur))
    order.clear()
    jax.eval_shape(lambda s: env.step(debug, s, jnp.zeros(16), jax.random.key(1), cur), state)
    assert order == ["_outcome", "_push", "observe"]


def test_broken_physics_is_masked_and_reset(setting):
    _, reset, step = setting
    state = reset(jax.random.key(0))
    bad = state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[8].set(jnp.nan)))
    new, outcome = step(bad, jnp.zeros(16), jax.random.key(1))
    assert bool(outcome.broken) and bool(outcome.terminated)
    assert float(outcome.reward) == 0.0 and int(new.time) == 0
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(new))


def test_action_becomes_the_joint_target(setting):
    """Without delay and noise, the joint moves to 0.25 rad x action."""
    _, reset, step = setting
    state = reset(jax.random.key(0))
    action = jnp.zeros(16).at[12].set(2.0)
    for i in range(60):
        state, _ = step(state, action, jax.random.key(i))
    assert float(state.physics.qpos[7 + 12]) == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(state.last_action, action)


def test_delay_and_noise(debug):
    """The applied action is ((1 - d) a + d a_prev) (1 + 0.02 n) with d <= 0.5; a is clipped at 18
    before."""
    keys = jax.random.split(jax.random.key(0), 4000)

    def apply(noise):
        one = lambda k: env._applied_action(debug, jnp.full(16, 30.0), jnp.zeros(16), noise, k)  # noqa: E731
        return jax.vmap(one)(keys)

    np.testing.assert_array_equal(apply(0.0), 18.0)
    applied = apply(1.0)
    assert 18.0 < float(applied.max()) < 18.0 * 1.1  # noise comes after the clip
    per_env = applied.mean(axis=1)  # noise averages out over joints; the delay is per environment
    assert per_env.min() == pytest.approx(9.0, abs=0.4)
    assert per_env.max() == pytest.approx(18.0, abs=0.4)
    assert float(jnp.mean(jnp.std(applied, axis=1) / per_env)) == pytest.approx(0.02, abs=0.002)


def test_held_arms_ignore_actions():
    held = preset("debug", ("arms",))
    applied = env._applied_action(held, jnp.ones(16), jnp.ones(16), 1.0, jax.random.key(0))
    assert not np.any(applied[12:]) and np.all(applied[:12])


@pytest.mark.parametrize("adds", [True, False])
def test_pushes(debug, adds):
    """Pushes come every 4 s, from U(-0.2, 0.2) m/s and U(-0.4, 0.4) rad/s. They are added to the
    velocity, or replace it as in Humanoid-Gym."""
    config = dataclasses.replace(
        debug, randomize=dataclasses.replace(debug.randomize, push_adds=adds)
    )
    state = env.reset(config, jax.random.key(0), curriculum.init(config))
    velocity = jnp.full(22, 3.0)
    state = state.replace(physics=state.physics.replace(qvel=velocity))
    off = env._push(config, state.replace(time=jnp.int32(399)), jax.random.key(1))
    np.testing.assert_array_equal(off.physics.qvel, velocity)
    on = env._push(config, state.replace(time=jnp.int32(400)), jax.random.key(1))
    pushed = on.physics.qvel - (velocity if adds else 0.0)
    assert np.all(np.abs(pushed[:2]) <= 0.2) and np.all(np.abs(pushed[3:6]) <= 0.4)
    assert np.any(pushed[:2]) and np.any(pushed[3:6])
    np.testing.assert_allclose(on.push[:2], pushed[:2], atol=1e-6)
    np.testing.assert_array_equal(on.physics.qvel[6:], velocity[6:])
    assert float(on.physics.qvel[2]) == 3.0


def test_a_command_holds_until_its_time_is_over(setting):
    """The reward of the step uses the command that the policy saw, not the new one."""
    config, reset, step = setting
    robot = physics.robot_for(config.physics)
    state = reset(jax.random.key(3)).replace(command_until=jnp.int32(800))
    wanted = state.command.wanted
    for time, changes in ((798, False), (799, True)):
        new, outcome = step(state.replace(time=jnp.int32(time)), jnp.zeros(16), jax.random.key(4))
        assert bool(jnp.any(new.command.wanted != wanted)) == changes
        # 0.01 s at 2 m/s^2 towards the old command, in either case
        command = 0.02 * wanted / jnp.linalg.norm(wanted)
        np.testing.assert_allclose(new.command.velocity[:2], command, rtol=1e-5)
        error = signals.read(robot, new.physics).base_linvel[:2] - command
        expected = jnp.exp(-config.rewards.tracking_sigma * jnp.sum(error**2))
        assert float(outcome.terms["tracking_lin_vel"]) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize(("preset_name", "shortest"), [("paper", 8.0), ("laptop", 1.0)])
def test_commands_hold_for_8_seconds_or_for_1_to_8(preset_name, shortest):
    config = preset(preset_name)
    keys = jax.random.split(jax.random.key(0), 2000)
    steps = jax.vmap(lambda k: commands.holding_steps(config.command, k, config.control_dt))(keys)
    assert abs(int(steps.min()) - 100 * shortest) <= 2 and abs(int(steps.max()) - 800) <= 2


def test_tracking_settles_two_seconds_after_a_new_command(setting):
    """With the laptop's settle time: 200 steps after the reset and after a new command at 800."""
    _, reset, step = setting
    state = reset(jax.random.key(3)).replace(command_until=jnp.int32(2000))
    for time, since, settled in (
        *((0, 0, False), (199, 0, False), (200, 0, True)),
        *((800, 800, False), (999, 800, False), (1000, 800, True)),
    ):
        now = state.replace(time=jnp.int32(time), command_since=jnp.int32(since))
        _, outcome = step(now, jnp.zeros(16), jax.random.key(4))
        assert bool(outcome.settled) == settled, time


def test_a_command_ends_where_the_next_state_has_a_new_one(setting):
    """The outcome says so before the new command is drawn: its reward is still the old one's."""
    _, reset, step = setting
    state = reset(jax.random.key(3)).replace(command_until=jnp.int32(7), time=jnp.int32(5))
    now, outcome = step(state, jnp.zeros(16), jax.random.key(4))
    assert not outcome.ends_command and int(now.command_until) == 7
    then, outcome = step(now, jnp.zeros(16), jax.random.key(5))
    assert outcome.ends_command and int(then.command_until) > 7 == int(then.command_since)
    assert not np.array_equal(then.command.heading, now.command.heading)


def test_a_robot_brakes_for_four_seconds_after_its_last_command_at_the_top(setting):
    """The range ends at 0.5 m/s: a command of 0.3 m/s is at its top, and one of -0.2 is not."""
    config, reset, step = setting
    after = config.curriculum.falls_after
    state = reset(jax.random.key(3)).replace(command_until=jnp.int32(2000))
    assert int(state.top_until) == env.NEVER

    def stepped(state, vx, time):
        velocity = jnp.array([vx, 0.0, 0.0])
        command = state.command.replace(velocity=velocity, wanted=velocity[:2])
        now = state.replace(command=command, time=jnp.int32(time))
        return step(now, jnp.zeros(16), jax.random.key(4))

    _, outcome = stepped(state, -0.2, 100)
    assert not outcome.top and not outcome.braking
    fast, outcome = stepped(state, 0.3, 100)
    assert outcome.top and int(fast.top_until) == 101
    for time, braking in ((101, True), (500, after > 3.99), (501, after > 4.0)):
        slow, outcome = stepped(fast, -0.2, time)
        assert not outcome.top and int(slow.top_until) == 101
        assert bool(outcome.braking) == (braking and after > 0), time


def test_jit_equals_no_jit_and_batch_of_one(setting):
    """The tolerance is 1e-4, because fused float32 programs add in another order."""
    config, reset, step = setting
    args = reset(jax.random.key(0)), 0.1 * jnp.ones(16), jax.random.key(1)
    one = functools.partial(env.step, config, curriculum=curriculum.init(config))
    alone = jax.jit(jax.vmap(one))(*jax.tree.map(lambda x: x[None], args))
    for a, b, c in zip(*map(jax.tree.leaves, (one(*args), step(*args), alone)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(b, c[0], rtol=1e-4, atol=1e-4)


@pytest.mark.slow(reason="compiles MJX; test_physics.py compares the engines in the quick suite")
def test_engines_give_the_same_environment():
    """After the same 10 steps in mjx and mujoco, the frames agree to 1e-3."""
    frames = []
    for engine in ("mjx", "mujoco"):
        base = preset("debug")
        config = dataclasses.replace(base, physics=dataclasses.replace(base.physics, engine=engine))
        cur = curriculum.init(config)
        state = env.reset(config, jax.random.key(0), cur)
        step = jax.jit(lambda s, a, k, c=config, u=cur: env.step(c, s, a, k, u))
        for i in range(10):
            state, outcome = step(state, jnp.sin(jnp.arange(16.0) + i), jax.random.key(i))
        frames.append((state.privileged_history[-1], outcome.reward))
    np.testing.assert_allclose(frames[0][0], frames[1][0], atol=1e-3)
    assert float(frames[0][1]) == pytest.approx(float(frames[1][1]), abs=1e-4)


def test_torso_contact_ends_the_episode(xbot):
    """The torso box is 0.4 m wide, and its centre is 0.1 m above the base origin. Upright, it
    touches the ground if the base is below 0.1 m."""
    config = preset("debug").physics
    from kslc_jax import signals

    def contact(height, quat=(1.0, 0.0, 0.0, 0.0)):
        qpos = jnp.asarray(xbot.default_qpos).at[2].set(height).at[3:7].set(jnp.array(quat))
        state = physics.initial_state(config, qpos, jnp.zeros(22))
        return bool(signals.read(xbot, state).torso_contact)

    assert not contact(0.11) and contact(0.09)
    lying = (0.70710678, 0.70710678, 0.0, 0.0)  # rolled by 90 degrees: half width 0.2
    assert not contact(0.21, lying) and contact(0.19, lying)


def test_frames_hold_what_the_state_holds(setting):
    """Some components of the actor and critic frames after a reset equal the state."""
    _config, reset, _ = setting
    state = reset(jax.random.key(5))
    actor = {n: state.history[-1][s] for n, s in observations.slices(ACTOR).items()}
    np.testing.assert_allclose(actor["joint_pos"], state.physics.qpos[7:], atol=1e-6)
    np.testing.assert_allclose(
        actor["command"], state.command.velocity * jnp.array([2.0, 2.0, 1.0]), atol=1e-6
    )
    at = observations.slices(CRITIC)
    critic = {n: state.privileged_history[-1][s] for n, s in at.items()}
    np.testing.assert_allclose(critic["friction"][0], state.dynamics.friction, rtol=1e-6)
    mass = 21.081917 + state.dynamics.base_mass
    np.testing.assert_allclose(critic["base_mass"][0], mass / 30.0, rtol=1e-5)


def test_the_engine_steps_the_robot_of_the_episode(setting):
    """The engine gets the episode's dynamics, not the nominal ones, and the ground friction."""
    config, reset, _ = setting
    state, given = reset(jax.random.key(0)), []

    def simulate(physics_config, state, target, dynamics, ground_friction, force):
        given.append((dynamics, ground_friction))
        return state

    cur = curriculum.init(config)
    env.step(config, state, jnp.zeros(16), jax.random.key(1), cur, simulate)
    ((dynamics, ground),) = given
    assert dynamics is state.dynamics and ground == config.randomize.ground_friction == 0.6
    assert float(dynamics.base_mass) != 0.0


def test_commands_come_from_the_curriculums_range(setting):
    config, _, _ = setting
    cur = curriculum.init(config).replace(v_max=jnp.asarray(1.5))
    draw = jax.jit(jax.vmap(lambda key: env.reset(config, key, cur).command.wanted[0]))
    vx = np.asarray(draw(jax.random.split(jax.random.key(0), 2000)))
    assert vx.min() < -0.28 and 1.45 < vx.max() <= 1.5


def test_rewards_compare_with_the_steps_before(setting):
    """The terms use the velocities of the step before and the actions of the two steps before."""
    config, reset, step = setting
    robot = physics.robot_for(config.physics)
    a = np.asarray(0.3 * jax.random.normal(jax.random.key(2), (3, 16)))
    states = [reset(jax.random.key(0))]
    for action in a:
        state, out = step(states[-1], jnp.asarray(action), jax.random.key(1))
        states.append(state)
    before, now = states[-2:]
    was, base = (np.asarray(signals.read(robot, s.physics).base_velocity) for s in (before, now))
    expected = {
        "dof_acc": np.sum(((now.physics.qvel[6:] - before.physics.qvel[6:]) / 0.01) ** 2),
        "base_acc": np.exp(-3.0 * np.linalg.norm(base - was)),
        "action_smoothness": np.sum((a[2] - a[1]) ** 2)
        + np.sum((a[2] + a[0] - 2 * a[1]) ** 2)
        + 0.05 * np.sum(np.abs(a[2])),
    }
    for name, value in expected.items():
        assert float(out.terms[name]) == pytest.approx(float(value), rel=1e-3), name


def test_a_step_pushes_and_the_critic_sees_it(debug):
    """Pushes have both signs, up to 0.2 m/s and 0.4 rad/s. The frames show the state after the
    push."""
    cur = curriculum.init(debug)
    state = env.reset(debug, jax.random.key(0), cur).replace(time=jnp.int32(399))
    step = jax.jit(jax.vmap(lambda key: env.step(debug, state, jnp.zeros(16), key, cur)[0]))
    new = step(jax.random.split(jax.random.key(1), 300))
    push, seen = np.asarray(new.push), np.asarray(new.privileged_history[:, -1])
    np.testing.assert_allclose(np.abs(push).max(0), [0.2, 0.2, 0.4, 0.4, 0.4], rtol=0.05)
    assert np.all(np.abs(push.mean(0)) < 0.06)
    at = observations.slices(CRITIC)
    np.testing.assert_allclose(seen[:, at["push_linear"]], push[:, :2], atol=1e-6)
    np.testing.assert_allclose(seen[:, at["base_angvel"]], new.physics.qvel[:, 3:6], atol=1e-6)


@pytest.mark.parametrize(
    ("vx", "time", "fast"), [(0.4, 300, True), (0.25, 300, False), (0.4, 100, False)]
)
def test_fast_is_settled_and_in_the_top_of_the_range(setting, vx, time, fast):
    _, reset, step = setting
    state = reset(jax.random.key(3))
    asked = state.command.replace(velocity=jnp.array([vx, 0.0, 0.0]))
    state = state.replace(command=asked, time=jnp.int32(time))
    assert bool(step(state, jnp.zeros(16), jax.random.key(4))[1].fast) == fast
