"""Curriculum of commanded speed (paper, Eq. 9) and gait cycle (Eq. 10): part of the train state."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax.config import Config, CurriculumConfig


@flax.struct.dataclass
class Curriculum:
    """Ranges in force and the moving averages that gate them."""

    v_max: jax.Array  # [] m/s, upper end of the commanded vx
    cycle_time: jax.Array  # [] s
    tracking: jax.Array  # [] moving average of the tracking reward over its maximum
    fast_tracking: jax.Array  # [] the same over the commands in the top part of the range
    episode_steps: jax.Array  # [] moving average length of finished episodes
    gait: jax.Array  # [] moving average of how well feet follow the clock at speed, -0.3 to 1
    updates: jax.Array  # [] int, updates since the last change


@flax.struct.dataclass
class Progress:
    """What one rollout says about the policy; shares are of the maximal tracking reward."""

    tracking: jax.Array  # [] mean over the samples whose command has settled
    tracking_count: jax.Array  # [] number of those
    fast_tracking: jax.Array  # [] mean over the fast commands' samples
    fast_count: jax.Array  # [] number of those samples
    episode_steps: jax.Array  # [] mean length of the episodes that ended; see train_step.init
    episode_count: jax.Array  # [] number of those
    gait: jax.Array  # [] mean of the feet_contact_number term over the fast commands' samples


def init(config: Config) -> Curriculum:
    """The curriculum's start."""
    return Curriculum(
        v_max=jnp.asarray(config.curriculum.v_start, jnp.float32),
        cycle_time=jnp.asarray(config.gait.cycle_time, jnp.float32),
        tracking=jnp.zeros(()),
        fast_tracking=jnp.zeros(()),
        episode_steps=jnp.zeros(()),
        gait=jnp.zeros(()),
        updates=jnp.zeros((), jnp.int32),
    )


def inherit(config: Config, other: Curriculum) -> Curriculum:
    """How far another training's curriculum had got, within the limits of this one's; what is left
    out here (an ablation) stays at its start."""
    own, limits = init(config), config.curriculum
    v_max = jnp.minimum(other.v_max, limits.v_limit) if limits.velocity else own.v_max
    cycle = jnp.maximum(other.cycle_time, limits.cycle_min) if limits.cycle else own.cycle_time
    return other.replace(v_max=v_max, cycle_time=cycle)


def is_fast(config: CurriculumConfig, state: Curriculum, vx: jax.Array) -> jax.Array:
    """Whether the commanded vx [m/s] is in the top part of the range."""
    return vx > config.fast_share * state.v_max


def remaining_share(config: CurriculumConfig, state: Curriculum) -> jax.Array:
    """Share [] of the way from `v_start` to `v_limit` that is still ahead; 1 if there is none."""
    way = config.v_limit - config.v_start
    return (config.v_limit - state.v_max) / way if way > 0.0 else jnp.ones(())


def update(config: CurriculumConfig, state: Curriculum, progress: Progress) -> Curriculum:
    """Averages `progress` in and, where the gate opens, widens the range and shortens the cycle.

    The gate: all and fast tracking above their thresholds, long episodes, feet that follow the
    clock, some updates since the last change. A widened range starts with empty averages of the
    fast commands.
    """

    def average(old: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
        mixed = config.smoothing * old + (1.0 - config.smoothing) * new
        return jnp.where(count > 0, mixed, old)

    tracking = average(state.tracking, progress.tracking, progress.tracking_count)
    fast = average(state.fast_tracking, progress.fast_tracking, progress.fast_count)
    steps = average(state.episode_steps, progress.episode_steps, progress.episode_count)
    gait = average(state.gait, progress.gait, progress.fast_count)
    updates = state.updates + 1
    v_max = jnp.minimum(state.v_max + config.v_step, config.v_limit)
    cycle = jnp.maximum(state.cycle_time * config.cycle_factor, config.cycle_min)
    v_max = v_max if config.velocity else state.v_max
    cycle = cycle if config.cycle else state.cycle_time
    gate = (
        (tracking >= config.threshold)
        & (fast >= config.fast_threshold)
        & (steps >= config.min_episode_steps)
        & (gait >= config.gait_threshold)
        & (updates >= config.min_updates)
        & ((v_max > state.v_max) | (cycle < state.cycle_time))
    )
    return Curriculum(
        v_max=jnp.where(gate, v_max, state.v_max),
        cycle_time=jnp.where(gate, cycle, state.cycle_time),
        tracking=tracking,
        fast_tracking=jnp.where(gate, 0.0, fast),
        episode_steps=steps,
        gait=jnp.where(gate, 0.0, gait),
        updates=jnp.where(gate, 0, updates),
    )
