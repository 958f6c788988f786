"""Our train step in the form of PureJaxRL's loop, built from the same functions.

Two things differ. Each step stores its whole observation histories. Each epoch flattens, shuffles
and splits the whole batch. The results are the same up to rounding.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from kslc_jax import curriculum as curriculum_lib
from kslc_jax import networks, ppo, rollout, train_step
from kslc_jax.config import Config
from kslc_jax.ppo import Learner, Samples
from kslc_jax.train_step import Metrics, TrainState

Stored = tuple[Samples, jax.Array, jax.Array, jax.Array | None]
"""Samples, the histories of actor and critic, and the velocities that the actor read: [B, ...],
[B, K, W], [B, Kp, W], [B, 3]; None without an estimator."""


def make(
    config: Config,
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """(init, step), like `train_step.make`."""
    return train_step.make(config)[0], jax.jit(lambda s: step(config, s), donate_argnums=0)


def step(config: Config, state: TrainState) -> tuple[TrainState, Metrics]:
    """One rollout and one update."""
    key_roll, key_update = train_step.step_keys(state)
    params = state.learner.params

    def one(envs, key):
        new, traj = rollout.control_step(config, params, envs, state.curriculum, key)
        new, outcome = jax.vmap(rollout.mask_broken)(new, traj.outcome)
        return new, (traj.replace(outcome=outcome), envs.history, envs.privileged_history)

    start = jax.vmap(rollout.or_new_episode)(state.env)
    keys = jax.random.split(key_roll, config.ppo.rollout_steps)
    envs, (traj, *seen) = jax.lax.scan(one, start, keys)
    last_value = networks.value(config, params, envs.privileged_history)
    samples = train_step.samples_of(config, traj, last_value)
    advantage = ppo.normalised(samples.advantage, samples.valid)
    history, privileged = (x.reshape(-1, *x.shape[2:]) for x in seen)
    velocity = jax.tree.map(lambda x: x.reshape(-1, networks.ESTIMATED), traj.velocity)
    stored = (samples.replace(advantage=advantage), history, privileged, velocity)
    learner, losses = _update(config, state, stored, key_update)
    progress = train_step.progress_of(config, traj.outcome)
    curriculum = curriculum_lib.update(config.curriculum, state.curriculum, progress)
    new = TrainState(learner, envs, curriculum, state.key, state.step + 1)
    return new, train_step.metrics_of(config, new, traj.outcome, progress, losses)


def _update(
    config: Config, state: TrainState, stored: Stored, key: jax.Array
) -> tuple[Learner, Metrics]:
    """All epochs: shuffle the batch, split it, and do one gradient step on each minibatch."""
    constants = train_step.rollout_constants(config, state)

    def minibatch(learner: Learner, batch: Stored) -> tuple[Learner, Metrics]:
        samples, history, privileged, velocity = batch
        apply = train_step.policy_at(config, lambda _: (history, privileged), velocity)
        samples = samples.replace(index=jnp.arange(config.minibatch_size))
        return ppo.gradient_step(config.ppo, apply, constants, learner, samples)

    def epoch(learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
        order = jax.random.permutation(key, config.batch_size)
        shuffled = jax.tree.map(lambda x: jnp.take(x, order, axis=0), stored)
        pieces = jax.tree.map(
            lambda x: x.reshape(config.ppo.minibatches, -1, *x.shape[1:]), shuffled
        )
        return jax.lax.scan(minibatch, learner, pieces)

    learner, info = jax.lax.scan(epoch, state.learner, jax.random.split(key, config.ppo.epochs))
    return learner, jax.tree.map(jnp.mean, info)
