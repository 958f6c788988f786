"""Rollout -> GAE -> PPO update -> curriculum: ONE pure function of ONE state.

`TrainState` is the whole state of a training. On a CPU a training that resumes from a saved
`TrainState` is equal, bit for bit, to one that never stopped.
"""

import dataclasses
import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import curriculum as curriculum_lib
from kslc_jax import env, networks, observations, physics, ppo
from kslc_jax.config import Config, RunConfig
from kslc_jax.curriculum import Curriculum, Progress
from kslc_jax.env import EnvState, Outcome
from kslc_jax.networks import Gaussian, Params
from kslc_jax.ppo import Learner, RolloutConstants, Samples
from kslc_jax.rollout import Trajectory, collect, finite, or_new_episode, windows

Metrics = dict[str, jax.Array]
ShardIndex = Callable[[jax.Array], jax.Array]
"""Places the indices [B] of a minibatch on the devices; without effect on their values."""


@flax.struct.dataclass
class TrainState:
    """Whole state of a training between two train steps."""

    learner: Learner
    env: EnvState  # [N, ...]
    curriculum: Curriculum
    key: jax.Array  # [] typed PRNG key, constant: each train step folds in its number
    step: jax.Array  # [] int, train steps done


def make(
    config: Config,
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """(init, train_step), both jitted. train_step donates its argument.

    A process compiles each config once. `config.seed` and `config.run` cause no new compilation.
    """
    init_jit, step_jit = _jitted(dataclasses.replace(config, seed=0, run=RunConfig()))
    return lambda: init_jit(config.seed), step_jit


@functools.lru_cache(maxsize=8)
def _jitted(config: Config):
    """(init of a seed, train_step), jitted and cached."""

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        return step(config, state)

    return jax.jit(functools.partial(init, config)), jax.jit(train_step, donate_argnums=0)


def init(config: Config, seed: int | jax.Array) -> TrainState:
    """State before the first train step."""
    key, key_params, key_env, key_time = jax.random.split(jax.random.key(seed), 4)
    curriculum = curriculum_lib.init(config)
    envs = _episodes(config, key_env, key_time, curriculum)
    return TrainState(
        learner=ppo.init(config.ppo, networks.init(config, key_params)),
        env=envs,
        curriculum=curriculum,
        key=key,
        step=jnp.zeros((), jnp.int32),
    )


def _episodes(
    config: Config, key_env: jax.Array, key_time: jax.Array, curriculum: Curriculum
) -> EnvState:
    """New episodes [N]. Each starts at a random age, so that time limits are spread evenly.

    `Outcome.episode_steps` includes this age.
    """
    env_keys = jax.random.split(key_env, config.env.num_envs)
    envs = jax.vmap(env.reset, (None, 0, None))(config, env_keys, curriculum)
    times = jax.random.randint(key_time, (config.env.num_envs,), 0, config.episode_steps)
    return envs.replace(time=times, command_since=times, command_until=times + envs.command_until)


_jitted_episodes = jax.jit(_episodes, static_argnums=0)


def new_episodes(
    config: Config, key: jax.Array, step: jax.Array, curriculum: Curriculum
) -> EnvState:
    """New episodes [N] as in `init`, for a training that goes on without its environments.

    Args:
      config: as in `make`; `config.seed` and `config.run` cause no new compilation.
      key, step, curriculum: of the training's state.
    """
    # `step_keys` are the keys 0 and 1 of this train step.
    keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, step), 2))
    return _jitted_episodes(dataclasses.replace(config, seed=0, run=RunConfig()), *keys, curriculum)


def start_from(
    config: Config, state: TrainState, params: Params, curriculum: Curriculum
) -> TrainState:
    """Replaces networks and curriculum of an initial `state` by those of another training.

    The curriculum is clipped to the config's limits, see `curriculum.inherit`. ValueError if the
    networks have other shapes.
    """
    if jax.tree.map(jnp.shape, params) != jax.tree.map(jnp.shape, state.learner.params):
        raise ValueError("networks of other shapes")
    # Copies: a train step donates its state, and another training may start from these arrays.
    params = jax.tree.map(jnp.copy, params)
    average = jax.tree.map(jnp.copy, ppo.acting(params))
    learner = state.learner.replace(params=params, average=average)
    curriculum = curriculum_lib.inherit(config, curriculum)
    curriculum = jax.tree.map(lambda x, like: x.astype(like.dtype), curriculum, state.curriculum)
    return state.replace(learner=learner, curriculum=curriculum)


def step(
    config: Config, state: TrainState, shard_index: ShardIndex = lambda index: index
) -> tuple[TrainState, Metrics]:
    """One rollout and one update, see the module docstring.

    `shard_index` places the indices of a minibatch on several devices.
    """
    key_roll, key_update = step_keys(state)
    params = state.learner.params
    start = jax.vmap(or_new_episode)(state.env)
    envs, traj = collect(config, params, start, state.curriculum, key_roll)
    last_value = networks.value(config, params, envs.privileged_history)
    samples = samples_of(config, traj, last_value)
    apply = observer(config, start, traj, shard_index)
    learner, losses = ppo.update(
        config.ppo, apply, rollout_constants(config, state), state.learner, samples, key_update
    )
    progress = progress_of(config, traj.outcome)
    curriculum = curriculum_lib.update(config.curriculum, state.curriculum, progress)
    new = TrainState(learner, envs, curriculum, state.key, state.step + 1)
    return new, metrics_of(config, new, traj.outcome, progress, losses)


def rollout_constants(config: Config, state: TrainState) -> RolloutConstants:
    """Values that are constant during the next rollout.

    With `ppo.entropy_fades` the entropy bonus is proportional to the remaining share of the
    curriculum. A policy that is paid for noise until the end learns to rely on it; without noise it
    is then biased.
    """
    coef = jnp.asarray(config.ppo.entropy_coef, jnp.float32)
    if config.ppo.entropy_fades:
        coef *= curriculum_lib.remaining_share(config.curriculum, state.curriculum)
    return RolloutConstants(networks.log_std(config, state.learner.params), coef)


def step_keys(state: TrainState) -> jax.Array:
    """[2] keys of one train step: for the rollout and for the update."""
    return jax.random.split(jax.random.fold_in(state.key, state.step))


def samples_of(config: Config, traj: Trajectory, last_value: jax.Array) -> Samples:
    """PPO samples [T * N, ...] of a trajectory, with advantages; `last_value` is [N]."""
    out = traj.outcome
    cut = out.truncated
    if config.ppo.value_per_command:
        cut = cut | (out.ends_command & ~out.terminated)
    done = out.terminated | cut
    advantage, target = jax.vmap(ppo.gae, (1, 1, 0, 1, 1, None, None), 1)(
        out.reward, traj.value, last_value, done, cut, config.ppo.gamma, config.ppo.lam
    )
    samples = Samples(
        index=jnp.arange(config.batch_size).reshape(traj.value.shape),
        action=traj.action,
        mean=traj.mean,
        log_prob=traj.log_prob,
        value=traj.value,
        advantage=advantage,
        target=target,
        valid=~out.broken,
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


def observer(
    config: Config, start: EnvState, traj: Trajectory, shard_index: ShardIndex = lambda index: index
) -> ppo.PolicyAtIndex:
    """Function that evaluates the networks at observations of `traj`, given by index t * N + n.

    `start` holds the environments before the rollout. The estimated velocity is an input of the
    actor, so the update uses the estimates of the rollout. New ones would move the actions with
    every gradient step of the estimator. The KL divergence would count that, and the learning rate
    would fall to a third.
    """
    actor = windows(start.history, traj.frame, traj.age)
    critic = windows(start.privileged_history, traj.privileged, traj.age)
    return policy_at(config, lambda i: (actor(i), critic(i)), traj.velocity, shard_index)


def policy_at(
    config: Config,
    histories: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    velocity: jax.Array | None,
    shard_index: ShardIndex = lambda index: index,
) -> ppo.PolicyAtIndex:
    """Function that evaluates the networks at the `histories` (actor's, critic's) of an index [B].

    `velocity` [T, N, 3] are the rollout's estimates, None without an estimator.
    """
    table = observations.critic_table(physics.robot_for(config.physics))
    at = observations.slices(table)["base_linvel"]
    read = None if velocity is None else velocity.reshape(-1, networks.ESTIMATED)

    def apply(params: Params, index: jax.Array) -> tuple[Gaussian, jax.Array, jax.Array]:
        index = shard_index(index)
        history, seen = histories(index)
        dist = networks.policy(config, params, history, None if read is None else read[index])
        estimate, error = networks.estimate(config, params, history), jnp.zeros(index.shape)
        if estimate is not None:
            error = jnp.sum(jnp.square(estimate - seen[:, -1, at]), axis=-1)
        return dist, networks.value(config, params, seen), error

    return apply


def progress_of(config: Config, out: Outcome) -> Progress:
    """Statistics of the rollout for the curriculum. Broken steps do not count."""
    done = out.terminated | out.truncated

    def mean_over(value: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        mask = mask & ~out.broken
        count = jnp.sum(mask)
        return jnp.sum(value * mask) / jnp.maximum(count, 1), count

    reached = out.terms["tracking_lin_vel"]  # 1 at its maximum
    tracking, tracking_count = mean_over(reached, out.settled)
    fast_tracking, fast_count = mean_over(reached, out.fast)
    episode_steps, episode_count = mean_over(out.episode_steps, done)
    gait, _ = mean_over(out.terms["feet_contact_number"], out.fast)
    settled_top = out.top & out.settled & ~out.broken
    exposed = (out.top | out.braking) & ~out.broken
    floor = config.curriculum.top_error_floor
    return Progress(
        tracking=tracking,
        tracking_count=tracking_count,
        fast_tracking=fast_tracking,
        fast_count=fast_count,
        episode_steps=episode_steps,
        episode_count=episode_count,
        gait=gait,
        top_deviation=jnp.sum((out.speed - out.commanded) * settled_top),
        top_scale=jnp.sum(jnp.maximum(out.commanded, floor) * settled_top),
        top_falls=jnp.sum(out.terminated & exposed),
        top_minutes=jnp.sum(exposed) * (config.control_dt / 60.0),
    )


def metrics_of(
    config: Config, state: TrainState, out: Outcome, progress: Progress, losses: Metrics
) -> Metrics:
    """Scalars of one train step.

    `reward/...` are unweighted terms. These are shares of the samples: `broken`, masked because of
    bad physics; `no_reward`, of the others those with a reward of 0 or less; `falls`, an episode
    ends by a fall or by bad physics; `speeding`, a joint is at or above its speed limit. `finite`
    is 1 if all numbers of the learner and the curriculum are finite, else 0.
    """
    terms = {f"reward/{name}": jnp.mean(value) for name, value in out.terms.items()}
    return {
        "step": state.step,
        "reward": jnp.mean(out.reward),
        "tracking": progress.tracking,
        "fast_tracking": progress.fast_tracking,
        "episode_steps": state.curriculum.episode_steps,
        "falls": jnp.mean(out.terminated),
        "broken": jnp.mean(out.broken),
        "finite": finite((state.learner, state.curriculum)).astype(jnp.float32),
        "no_reward": jnp.mean((out.reward <= 0.0) & ~out.broken),
        "speeding": jnp.mean(out.speeding),
        "curriculum/v_max": state.curriculum.v_max,
        "curriculum/cycle_time": state.curriculum.cycle_time,
        "curriculum/tracking": state.curriculum.tracking,
        "curriculum/fast_tracking": state.curriculum.fast_tracking,
        "curriculum/gait": state.curriculum.gait,
        "curriculum/top_error": curriculum_lib.top_error(state.curriculum),
        "curriculum/top_falls": curriculum_lib.top_falls(state.curriculum),
        "ppo/learning_rate": state.learner.learning_rate,
        "ppo/std": jnp.mean(jnp.exp(networks.log_std(config, state.learner.params))),
        **{f"ppo/{name}": value for name, value in losses.items()},
        **terms,
    }
