"""Curriculum of commanded speed (paper, Eq. 9) and gait cycle (Eq. 10).

Its state is part of the train state. Commands "at the top" are those of `is_top`.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import maths
from kslc_jax.config import Config, CurriculumConfig


@flax.struct.dataclass
class Curriculum:
    """Present ranges, and the averages that decide when they change.

    A fading sum is multiplied by `smoothing` before each update's part is added.
    """

    v_max: jax.Array  # [] m/s, upper end of the commanded vx
    cycle_time: jax.Array  # [] s
    tracking: jax.Array  # [] moving average of tracking / its maximum, settled commands
    fast_tracking: jax.Array  # [] the same, fast commands only (`Outcome.fast`)
    episode_steps: jax.Array  # [] moving average of the length of finished episodes
    gait: jax.Array  # [] moving average of feet_contact_number, fast commands, -0.3 to 1
    # Fading sums over the samples with a settled command at the top:
    top_deviation: jax.Array  # [] m/s, of vx minus commanded vx
    top_scale: jax.Array  # [] m/s, of max(commanded vx, `top_error_floor`)
    top_falls: jax.Array  # [] fading sum of falls under and soon after commands at the top
    top_minutes: jax.Array  # [] fading sum of the minutes in which such falls count
    updates: jax.Array  # [] int, updates since the last change


@flax.struct.dataclass
class Progress:
    """Statistics of one rollout. Tracking is the tracking reward over its maximum."""

    tracking: jax.Array  # [] mean over the samples with a settled command
    tracking_count: jax.Array  # [] number of these samples
    fast_tracking: jax.Array  # [] mean over the samples with a fast command
    fast_count: jax.Array  # [] number of these samples
    episode_steps: jax.Array  # [] mean length of the episodes that ended; see train_step.init
    episode_count: jax.Array  # [] number of these episodes
    gait: jax.Array  # [] mean of feet_contact_number over the samples with a fast command
    # Sums over the samples with a settled command at the top:
    top_deviation: jax.Array  # [] m/s, of vx minus commanded vx
    top_scale: jax.Array  # [] m/s, of max(commanded vx, `top_error_floor`)
    top_falls: jax.Array  # [] falls under commands at the top, and up to `falls_after` later
    top_minutes: jax.Array  # [] minutes in which such falls count, sum over the robots


def init(config: Config) -> Curriculum:
    """Curriculum before the first update."""
    return Curriculum(
        v_max=jnp.asarray(config.curriculum.v_start, jnp.float32),
        cycle_time=jnp.asarray(config.gait.cycle_time, jnp.float32),
        tracking=jnp.zeros(()),
        fast_tracking=jnp.zeros(()),
        episode_steps=jnp.zeros(()),
        gait=jnp.zeros(()),
        top_deviation=jnp.zeros(()),
        top_scale=jnp.zeros(()),
        top_falls=jnp.zeros(()),
        top_minutes=jnp.zeros(()),
        updates=jnp.zeros((), jnp.int32),
    )


def inherit(config: Config, other: Curriculum) -> Curriculum:
    """Copies another run's progress, clipped to this config's limits.

    Disabled parts (`velocity` or `cycle` False) keep their start values.
    """
    own, limits = init(config), config.curriculum
    v_max = jnp.minimum(other.v_max, limits.v_limit) if limits.velocity else own.v_max
    cycle = jnp.maximum(other.cycle_time, limits.cycle_min) if limits.cycle else own.cycle_time
    return other.replace(v_max=v_max, cycle_time=cycle)


def is_fast(config: CurriculumConfig, state: Curriculum, vx: jax.Array) -> jax.Array:
    """True if the commanded vx [m/s] is above `fast_share` of v_max."""
    return vx > config.fast_share * state.v_max


def is_top(config: CurriculumConfig, state: Curriculum, vx: jax.Array) -> jax.Array:
    """True if the commanded vx [m/s] is less than one `v_step` below v_max."""
    return vx > state.v_max - config.v_step


def top_error(state: Curriculum) -> jax.Array:
    """Relative error [] of the mean speed under commands at the top; 1 if there were none."""
    known = state.top_scale > 0.0
    error = jnp.abs(state.top_deviation) / jnp.where(known, state.top_scale, 1.0)
    return jnp.where(known, error, 1.0)


def top_falls(state: Curriculum) -> jax.Array:
    """Falls per minute [] under and soon after commands at the top, see `falls_after`."""
    return state.top_falls / jnp.maximum(state.top_minutes, 1e-6)


def remaining_share(config: CurriculumConfig, state: Curriculum) -> jax.Array:
    """Remaining share [] of the way from `v_start` to `v_limit`; 1 if both are equal."""
    way = config.v_limit - config.v_start
    return (config.v_limit - state.v_max) / way if way > 0.0 else jnp.ones(())


def conditions(config: CurriculumConfig, state: Curriculum) -> dict[str, jax.Array]:
    """The conditions for the range to grow: name -> [] bool, True if the condition is met.

    The last two are about commands at the top. A mean over all commands would hide failures there.
    """
    return {
        "tracking under all commands": state.tracking >= config.threshold,
        "tracking under fast commands": state.fast_tracking >= config.fast_threshold,
        "length of the episodes": state.episode_steps >= config.min_episode_steps,
        "feet that follow the clock": (state.gait >= config.gait_threshold)
        | (state.v_max < config.gait_from),
        "mean speed under the fastest commands": (top_error(state) <= config.top_error)
        | (state.v_max < config.top_error_from),
        "falls under the fastest commands": top_falls(state) <= config.top_falls,
    }


def update(config: CurriculumConfig, state: Curriculum, progress: Progress) -> Curriculum:
    """Adds `progress` to the averages. If the gate opens, widens the range and shortens the cycle.

    The gate opens if all `conditions` are met. At least `min_updates` updates lie between two
    changes. After a change the averages of fast commands and the sums at the top start anew.
    """
    state = _averaged(config, state, progress)
    v_max = jnp.minimum(state.v_max + config.v_step, config.v_limit)
    cycle = jnp.maximum(state.cycle_time * config.cycle_factor, config.cycle_min)
    v_max = v_max if config.velocity else state.v_max
    cycle = cycle if config.cycle else state.cycle_time
    gate = (
        functools.reduce(jnp.logical_and, conditions(config, state).values())
        & (state.updates >= config.min_updates)
        & ((v_max > state.v_max) | (cycle < state.cycle_time))
    )
    zero = jnp.zeros(())
    wider = state.replace(
        v_max=v_max,
        cycle_time=cycle,
        fast_tracking=zero,
        gait=zero,
        top_deviation=zero,
        top_scale=zero,
        top_falls=zero,
        top_minutes=zero,
        updates=jnp.zeros((), jnp.int32),
    )
    return maths.tree_where(gate, wider, state)


def _averaged(config: CurriculumConfig, state: Curriculum, progress: Progress) -> Curriculum:
    """Adds `progress` to the moving averages and fading sums, and counts the update."""

    def average(old: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
        mixed = config.smoothing * old + (1.0 - config.smoothing) * new
        return jnp.where(count > 0, mixed, old)

    def restarted(old: jax.Array, new: jax.Array) -> jax.Array:
        # A plain mean at first: an average that starts at 0 would stay below the true value for
        # some fifty updates, and keep the gate shut.
        gain = jnp.maximum(1.0 - config.smoothing, 1.0 / (state.updates + 1))
        return jnp.where(progress.fast_count > 0, old + gain * (new - old), old)

    return state.replace(
        tracking=average(state.tracking, progress.tracking, progress.tracking_count),
        fast_tracking=restarted(state.fast_tracking, progress.fast_tracking),
        episode_steps=average(state.episode_steps, progress.episode_steps, progress.episode_count),
        gait=restarted(state.gait, progress.gait),
        top_deviation=config.smoothing * state.top_deviation + progress.top_deviation,
        top_scale=config.smoothing * state.top_scale + progress.top_scale,
        top_falls=config.smoothing * state.top_falls + progress.top_falls,
        top_minutes=config.smoothing * state.top_minutes + progress.top_minutes,
        updates=state.updates + 1,
    )
