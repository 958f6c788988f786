"""Rollout -> GAE -> PPO update -> curriculum: ONE pure function of ONE state.

`TrainState` is all a training is: saving it and going on from it is the same as not having
stopped, bit for bit.
"""

import dataclasses
import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import curriculum as curriculum_lib
from kslc_jax import env, networks, observations, ppo
from kslc_jax.config import Config, RunConfig
from kslc_jax.curriculum import Curriculum, Progress
from kslc_jax.env import EnvState, Outcome
from kslc_jax.networks import Gaussian, Params
from kslc_jax.ppo import Learner, RolloutConstants, Samples
from kslc_jax.rollout import Trajectory, collect, finite, or_new_episode, windows

_VELOCITY = observations.slices(observations.CRITIC)["base_linvel"]
"""Where the critic's frame has what an estimator learns."""

Metrics = dict[str, jax.Array]
ShardIndex = Callable[[jax.Array], jax.Array]


@flax.struct.dataclass
class TrainState:
    """Everything a training depends on."""

    learner: Learner
    env: EnvState  # [N, ...]
    curriculum: Curriculum
    key: jax.Array  # [] typed PRNG key, never advanced: steps fold their number in
    step: jax.Array  # [] int, train steps done


def make(
    config: Config,
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """(init, train_step), both jitted; train_step donates its argument.

    A process compiles a config once: its seed and how long it runs change nothing."""
    init_jit, step_jit = _jitted(dataclasses.replace(config, seed=0, run=RunConfig()))
    return lambda: init_jit(config.seed), step_jit


@functools.lru_cache(maxsize=8)
def _jitted(config: Config):
    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        return step(config, state)

    return jax.jit(functools.partial(init, config)), jax.jit(train_step, donate_argnums=0)


def init(config: Config, seed: int | jax.Array) -> TrainState:
    """The state before the first train step. Its episodes have random ages, so that their ends are
    spread evenly from the start; the lengths that they are said to have had include those."""
    key, key_params, key_env, key_time = jax.random.split(jax.random.key(seed), 4)
    curriculum = curriculum_lib.init(config)
    env_keys = jax.random.split(key_env, config.env.num_envs)
    envs = jax.vmap(env.reset, (None, 0, None))(config, env_keys, curriculum)
    times = jax.random.randint(key_time, (config.env.num_envs,), 0, config.episode_steps)
    return TrainState(
        learner=ppo.init(config.ppo, networks.init(config, key_params)),
        env=envs.replace(time=times, command_since=times, command_until=times + envs.command_until),
        curriculum=curriculum,
        key=key,
        step=jnp.zeros((), jnp.int32),
    )


def start_from(
    config: Config, state: TrainState, params: Params, curriculum: Curriculum
) -> TrainState:
    """An initial state with the networks of another training, and as far as its curriculum had
    got; ValueError where the networks have other shapes."""
    if jax.tree.map(jnp.shape, params) != jax.tree.map(jnp.shape, state.learner.params):
        raise ValueError("networks of other shapes")
    # Copies, for a train step donates its state and another training may start from the same.
    params = jax.tree.map(jnp.copy, params)
    average = jax.tree.map(jnp.copy, ppo.acting(params))
    learner = state.learner.replace(params=params, average=average)
    curriculum = curriculum_lib.inherit(config, curriculum)
    curriculum = jax.tree.map(lambda x, like: x.astype(like.dtype), curriculum, state.curriculum)
    return state.replace(learner=learner, curriculum=curriculum)


def step(
    config: Config, state: TrainState, shard_index: ShardIndex = lambda index: index
) -> tuple[TrainState, Metrics]:
    """One rollout and one update; see the module's first line. `shard_index` places the indices of
    a minibatch's samples where there are several devices."""
    key_roll, key_update = step_keys(state)
    params = state.learner.params
    start = jax.vmap(or_new_episode)(state.env)
    envs, traj = collect(config, params, start, state.curriculum, key_roll)
    last_value = networks.value(config, params, envs.privileged_history)
    samples = samples_of(config, traj, last_value)
    apply = _observer(config, start, traj, shard_index)
    learner, losses = ppo.update(
        config.ppo, apply, rollout_constants(config, state), state.learner, samples, key_update
    )
    progress = _progress(config, traj.outcome)
    curriculum = curriculum_lib.update(config.curriculum, state.curriculum, progress)
    new = TrainState(learner, envs, curriculum, state.key, state.step + 1)
    return new, _metrics(config, new, traj.outcome, progress, losses)


def rollout_constants(config: Config, state: TrainState) -> RolloutConstants:
    """What the samples of the coming rollout share.

    With `ppo.entropy_fades` the entropy bonus falls with what is left to climb: a policy that is
    paid for its noise until the end has learnt to act with it, and is biased without.
    """
    coef = jnp.asarray(config.ppo.entropy_coef, jnp.float32)
    if config.ppo.entropy_fades:
        coef *= curriculum_lib.remaining_share(config.curriculum, state.curriculum)
    return RolloutConstants(networks.log_std(config, state.learner.params), coef)


def step_keys(state: TrainState) -> jax.Array:
    """[2] keys of one train step: of the rollout and of the update."""
    return jax.random.split(jax.random.fold_in(state.key, state.step))


def samples_of(config: Config, traj: Trajectory, last_value: jax.Array) -> Samples:
    """Flattened PPO samples [T * N, ...] with advantages."""
    out = traj.outcome
    done = out.terminated | out.truncated
    advantage, target = jax.vmap(ppo.gae, (1, 1, 0, 1, 1, None, None), 1)(
        out.reward, traj.value, last_value, done, out.truncated, config.ppo.gamma, config.ppo.lam
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


def _observer(
    config: Config, start: EnvState, traj: Trajectory, shard_index: ShardIndex = lambda index: index
) -> ppo.PolicyAtIndex:
    """The networks at the observations of `traj`, named by their flat index t * N + n."""
    actor = windows(start.history, traj.frame, traj.age)
    critic = windows(start.privileged_history, traj.privileged, traj.age)

    def apply(params: Params, index: jax.Array) -> tuple[Gaussian, jax.Array, jax.Array]:
        index = shard_index(index)
        dist, estimate = networks.policy_and_estimate(config, params, actor(index))
        seen = critic(index)
        error = jnp.zeros(index.shape)
        if estimate is not None:
            error = jnp.sum(jnp.square(estimate - seen[:, -1, _VELOCITY]), axis=-1)
        return dist, networks.value(config, params, seen), error

    return apply


def _progress(config: Config, out: Outcome) -> Progress:
    """What the rollout says about the policy, for the curriculum; broken steps say nothing."""
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
    top = out.top & ~out.broken
    settled_top, floor = top & out.settled, config.curriculum.top_error_floor
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
        top_falls=jnp.sum(out.terminated & top),
        top_minutes=jnp.sum(top) * (config.control_dt / 60.0),
    )


def _metrics(
    config: Config, state: TrainState, out: Outcome, progress: Progress, losses: Metrics
) -> Metrics:
    """Scalars of one train step. `reward/...` are raw terms, before weights; `broken` is the share
    of samples that were masked, `finite` is 1 while networks, optimiser and curriculum are."""
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
