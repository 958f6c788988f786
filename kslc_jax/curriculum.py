"""Curriculum of commanded speed (paper, Eq. 9) and gait cycle (Eq. 10): part of the train state."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import maths
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
    top_deviation: jax.Array  # [] m/s, fading sum of vx - commanded vx, settled commands at the top
    top_scale: jax.Array  # [] m/s, the same of the commanded vx, or of `top_error_floor` if more
    top_falls: jax.Array  # [] fading sum of the falls under commands at the top
    top_minutes: jax.Array  # [] the same of the time that robots had such commands
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
    top_deviation: jax.Array  # [] m/s, sum of vx - commanded vx, settled commands at the top
    top_scale: jax.Array  # [] m/s, sum of their commanded vx, or of `top_error_floor` if more
    top_falls: jax.Array  # [] falls under commands at the top
    top_minutes: jax.Array  # [] minutes that robots had such commands, all robots together


def init(config: Config) -> Curriculum:
    """The curriculum's start."""
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
    """How far another training's curriculum had got, within the limits of this one's; what is left
    out here (an ablation) stays at its start."""
    own, limits = init(config), config.curriculum
    v_max = jnp.minimum(other.v_max, limits.v_limit) if limits.velocity else own.v_max
    cycle = jnp.maximum(other.cycle_time, limits.cycle_min) if limits.cycle else own.cycle_time
    return other.replace(v_max=v_max, cycle_time=cycle)


def is_fast(config: CurriculumConfig, state: Curriculum, vx: jax.Array) -> jax.Array:
    """Whether the commanded vx [m/s] is in the top part of the range."""
    return vx > config.fast_share * state.v_max


def is_top(config: CurriculumConfig, state: Curriculum, vx: jax.Array) -> jax.Array:
    """True where the commanded vx [m/s] lies within one `v_step` of the range's end."""
    return vx > state.v_max - config.v_step


def top_error(state: Curriculum) -> jax.Array:
    """Relative error [] of the mean speed under commands at the top of the range; 1 before any."""
    known = state.top_scale > 0.0
    error = jnp.abs(state.top_deviation) / jnp.where(known, state.top_scale, 1.0)
    return jnp.where(known, error, 1.0)


def top_falls(state: Curriculum) -> jax.Array:
    """Falls per minute [] under commands at the top of the range."""
    return state.top_falls / jnp.maximum(state.top_minutes, 1e-6)


def remaining_share(config: CurriculumConfig, state: Curriculum) -> jax.Array:
    """Share [] of the way from `v_start` to `v_limit` that is still ahead; 1 if there is none."""
    way = config.v_limit - config.v_start
    return (config.v_limit - state.v_max) / way if way > 0.0 else jnp.ones(())


def update(config: CurriculumConfig, state: Curriculum, progress: Progress) -> Curriculum:
    """Averages `progress` in and, where the gate opens, widens the range and shortens the cycle.

    The gate asks for enough of each: tracking under all and under fast commands, length of the
    episodes, feet that follow the clock, updates since the last change; and for a mean speed and
    few falls under the commands at the top of the range, which a mean over all commands hides.
    A widened range starts with empty averages of the fast commands.
    """
    state = _averaged(config, state, progress)
    v_max = jnp.minimum(state.v_max + config.v_step, config.v_limit)
    cycle = jnp.maximum(state.cycle_time * config.cycle_factor, config.cycle_min)
    v_max = v_max if config.velocity else state.v_max
    cycle = cycle if config.cycle else state.cycle_time
    gate = (
        (state.tracking >= config.threshold)
        & (state.fast_tracking >= config.fast_threshold)
        & (state.episode_steps >= config.min_episode_steps)
        & (state.gait >= config.gait_threshold)
        & (top_error(state) <= config.top_error)
        & (top_falls(state) <= config.top_falls)
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
    """The curriculum one update later, with the moving averages and fading sums of `progress`."""

    def average(old: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
        mixed = config.smoothing * old + (1.0 - config.smoothing) * new
        return jnp.where(count > 0, mixed, old)

    fast_count = progress.fast_count
    return state.replace(
        tracking=average(state.tracking, progress.tracking, progress.tracking_count),
        fast_tracking=average(state.fast_tracking, progress.fast_tracking, fast_count),
        episode_steps=average(state.episode_steps, progress.episode_steps, progress.episode_count),
        gait=average(state.gait, progress.gait, fast_count),
        top_deviation=config.smoothing * state.top_deviation + progress.top_deviation,
        top_scale=config.smoothing * state.top_scale + progress.top_scale,
        top_falls=config.smoothing * state.top_falls + progress.top_falls,
        top_minutes=config.smoothing * state.top_minutes + progress.top_minutes,
        updates=state.updates + 1,
    )
