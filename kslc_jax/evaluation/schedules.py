"""Commands that change during a trial.

A schedule is a sequence of legs, one command each. The next leg of a robot is a pure function of
(schedule, leg number, key, yaw, position); `trials` steps it inside its scan.
"""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import commands, maths
from kslc_jax.config import CommandConfig, Config, ConfigError

NAMES = ("stop", "reverse", "box", "random", "jitter", "turns", "tour")
"""The built-in schedules, see `named`."""

RUN, REST = 5.0, 4.0
"""Seconds at the top speed, and seconds at rest or in reverse, of `stop` and `reverse`."""

BLOCK = 5
"""Legs in a block of `random` and `jitter`: the last but one runs at the top speed, the last stops
or reverses, the others are drawn as training draws commands."""

REVERSALS = 1 / 3
"""Share of the blocks that end with a reversal; the others end with a stop."""

TURNS = (0.25, 0.5, 0.75)
"""Speeds of `turns`, as shares of the top speed."""

NEAR, FAR = 4.0, 15.0
"""Least and largest distance [m] to the next way-point of `tour`."""

REACHED = 0.7
"""Distance [m] at which a way-point counts as reached."""

APPROACH, CRAWL = 0.6, 0.5
"""Near a way-point: speed per distance [1/s], and least speed [m/s]."""

PATIENCE = 60.0
"""Seconds after which `tour` gives a way-point up."""


@dataclass(frozen=True)
class Step:
    """One command of a list."""

    seconds: float
    vx: float  # m/s
    vy: float = 0.0  # m/s, to the left
    yaw_rate: float = 0.0  # rad/s, to the left; 0 keeps a heading
    heading: float | None = None  # rad, world; None keeps the heading of the leg before


@dataclass(frozen=True)
class Schedule:
    """Commands over time: a list that starts over at its end, drawn ones, or a tour."""

    name: str
    top: float  # m/s, the fastest command
    low: float = 0.0  # m/s, the slowest one
    top_width: float = 0.0  # m/s, of the range from which training draws its top commands
    steps: tuple[Step, ...] = ()  # the list; empty if the commands are drawn
    seconds: tuple[float, float] = (PATIENCE, PATIENCE)  # shortest and longest drawn leg
    brakes: bool = False  # some of the drawn legs run at the top speed, then stop or reverse
    tour: bool = False


@flax.struct.dataclass
class Leg:
    """The command in force, of one robot."""

    number: jax.Array  # [] int, from 0
    left: jax.Array  # [] s until the leg ends
    velocity: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s]
    heading: jax.Array  # [] rad, world, wanted while no yaw rate is
    point: jax.Array  # [2] m, world, the next way-point; NaN without one


# -------------------------------------------------------------------------------------- schedules


def named(name: str, config: Config, v_max: float, top: float | None = None) -> Schedule:
    """The schedule NAME, or that of a JSON file of this path.

    Args:
      name: one of `NAMES`, or the path of a list of {seconds, vx, vy, yaw_rate or heading}.
      config: of the policy; commands are drawn as its training draws them.
      v_max: fastest command that the policy was trained for [m/s].
      top: fastest command of the schedule [m/s]; None takes `v_max`.

    Raises:
      ConfigError: no such name, or no such file, or a file that is no schedule.
    """
    fastest, low = (v_max if top is None else top), config.curriculum.v_min
    blank = Schedule(name, top=fastest, low=low, top_width=config.curriculum.v_step)
    match name:
        case "stop":
            steps = Step(RUN, fastest), Step(REST, 0.0)
        case "reverse":
            steps = Step(RUN, fastest), Step(REST, low)
        case "turns":
            steps = _turns(config.command, fastest)
        case "box":
            return dataclasses.replace(blank, seconds=(4.0, 4.0))
        case "random":
            return dataclasses.replace(blank, seconds=(1.0, 4.0), brakes=True)
        case "jitter":
            return dataclasses.replace(blank, seconds=(0.3, 4.0), brakes=True)
        case "tour":
            return dataclasses.replace(blank, tour=True)
        case _:
            return _read(Path(name), top)
    return dataclasses.replace(blank, steps=steps)


def _turns(config: CommandConfig, top: float) -> tuple[Step, ...]:
    """At each of three speeds straight on, to the left and to the right, as fast as training asks
    a robot at that speed to turn."""
    steps = []
    for share in TURNS:
        vx = share * top
        widest = math.pi * (max(0.0, 1.0 - vx / config.narrow_speed) if config.narrow_speed else 1)
        rate = min(config.max_yaw_rate, config.heading_gain * widest)
        steps += [Step(3.0, vx), Step(3.0, vx, yaw_rate=rate), Step(3.0, vx, yaw_rate=-rate)]
    return tuple(steps)


def _read(path: Path, top: float | None) -> Schedule:
    """A user's schedule, its speeds limited to `top`."""
    try:
        content = json.loads(path.read_text())
    except OSError:
        known = ", ".join(NAMES)
        raise ConfigError(f"schedule: no file {str(path)!r} (known names: {known})") from None
    except (ValueError, RecursionError):
        raise ConfigError(f"schedule: {path} is not JSON") from None
    if not isinstance(content, list) or not content:
        raise ConfigError(f"schedule: {path} is no list of steps such as {{seconds, vx}}")
    steps = tuple(_step(path, i, entry) for i, entry in enumerate(content))
    if top is not None:
        steps = tuple(dataclasses.replace(s, vx=min(s.vx, top)) for s in steps)
    speeds = [step.vx for step in steps]
    return Schedule(path.stem, top=max(speeds), low=min(speeds), steps=steps)


def _step(path: Path, index: int, entry: Any) -> Step:
    try:
        step = Step(**{name: float(value) for name, value in entry.items()})
        numbers = [x for x in dataclasses.astuple(step) if x is not None]
    except (TypeError, ValueError, AttributeError):
        names = ", ".join(f.name for f in dataclasses.fields(Step))
        raise ConfigError(
            f"schedule: step {index} of {path} needs numbers for seconds and vx (known: {names})"
        ) from None
    if not all(map(math.isfinite, numbers)) or step.seconds <= 0:
        raise ConfigError(f"schedule: step {index} of {path}: finite numbers, seconds above 0")
    if step.yaw_rate and step.heading is not None:
        raise ConfigError(f"schedule: step {index} of {path} has both yaw_rate and heading")
    return step


# ------------------------------------------------------------------------------------------- legs


def constant(velocity: jax.Array, heading: jax.Array | float) -> Leg:
    """The one leg [3] of a trial without a schedule."""
    return Leg(
        number=jnp.zeros((), jnp.int32),
        left=jnp.zeros(()),
        velocity=velocity,
        heading=jnp.asarray(heading, jnp.float32),
        point=jnp.full(2, jnp.nan),
    )


def before_start(heading: jax.Array | float) -> Leg:
    """What a robot of this starting heading [rad] has before its first leg."""
    return constant(jnp.zeros(3), heading).replace(number=jnp.full((), -1, jnp.int32))


def update(
    schedule: Schedule,
    config: CommandConfig,
    leg: Leg,
    key: jax.Array,
    yaw: jax.Array,
    position: jax.Array,
    dt: float,
) -> Leg:
    """The leg in force for the next `dt` [s].

    Args:
      schedule: static.
      config: how training draws commands.
      leg: of the last step.
      key: the robot's own, the same in every step.
      yaw: where the robot heads now [rad].
      position: [2] where it is [m], world.
      dt: time between calls [s].
    """
    reached = jnp.hypot(*(leg.point - position)) < REACHED  # False for NaN
    over = (leg.left < 0.5 * dt) | reached
    fresh = _next(schedule, config, leg, key, yaw, position)
    now: Leg = maths.tree_where(over, fresh, leg)
    if schedule.tour:
        now = _towards(schedule, now, yaw, position)
    return now.replace(left=now.left - dt)


def _next(schedule: Schedule, config: CommandConfig, leg: Leg, key, yaw, position) -> Leg:
    number = leg.number + 1
    key = jax.random.fold_in(key, number)
    leg = leg.replace(number=number)
    if schedule.tour:
        return _next_point(leg, key, yaw, position)
    if schedule.steps:
        return _next_step(schedule.steps, leg, yaw)
    return _drawn(schedule, config, leg, key, yaw)


def _next_step(steps: tuple[Step, ...], leg: Leg, yaw: jax.Array) -> Leg:
    at = leg.number % len(steps)
    wanted = np.array([np.nan if s.heading is None else s.heading for s in steps], np.float32)
    heading = jnp.asarray(wanted)[at]
    kept = jnp.where(leg.velocity[2] == 0.0, leg.heading, yaw)
    return leg.replace(
        left=jnp.asarray([s.seconds for s in steps], jnp.float32)[at],
        velocity=jnp.asarray([(s.vx, s.vy, s.yaw_rate) for s in steps], jnp.float32)[at],
        heading=jnp.where(jnp.isnan(heading), kept, heading),
    )


def _drawn(schedule: Schedule, config: CommandConfig, leg: Leg, key, yaw: jax.Array) -> Leg:
    keys = jax.random.split(key, 3)
    shortest, longest = schedule.seconds
    low, top = jnp.asarray(schedule.low), jnp.asarray(schedule.top)
    place = leg.number % BLOCK
    fast, brakes = (schedule.brakes & (place == BLOCK - back) for back in (2, 1))
    sampled = commands.sample(config, keys[0], (low, top), yaw, schedule.top_width)
    reverses = jax.random.bernoulli(keys[1], REVERSALS)
    straight = jnp.where(fast, top, jnp.where(reverses, low, 0.0)) * jnp.array([1.0, 0.0, 0.0])
    drawn = sampled.velocity.at[2].set(0.0)  # the heading says where to turn
    special = fast | brakes
    seconds = jax.random.uniform(keys[2], minval=shortest, maxval=longest)
    return leg.replace(
        left=jnp.where(fast, longest, seconds),
        velocity=jnp.where(special, straight, drawn),
        heading=jnp.where(special, yaw, sampled.heading),
    )


def _next_point(leg: Leg, key: jax.Array, yaw: jax.Array, position: jax.Array) -> Leg:
    """A way-point anywhere around the robot."""
    key_bearing, key_distance = jax.random.split(key)
    bearing = jax.random.uniform(key_bearing, minval=-jnp.pi, maxval=jnp.pi)
    distance = jax.random.uniform(key_distance, minval=NEAR, maxval=FAR)
    ahead = jnp.stack([jnp.cos(yaw + bearing), jnp.sin(yaw + bearing)])
    return leg.replace(left=jnp.full((), PATIENCE), point=position + distance * ahead)


def _towards(schedule: Schedule, leg: Leg, yaw: jax.Array, position: jax.Array) -> Leg:
    """Heads for the way-point; slow near it, and while it is not ahead."""
    way = leg.point - position
    heading = jnp.arctan2(way[1], way[0])
    ahead = jnp.clip(jnp.cos(maths.wrap_angle(heading - yaw)), 0.0, 1.0)
    fast = jnp.minimum(schedule.top, APPROACH * jnp.hypot(*way) + CRAWL)
    vx = jnp.clip(jnp.square(ahead) * fast, min(CRAWL, schedule.top), schedule.top)
    return leg.replace(velocity=vx * jnp.array([1.0, 0.0, 0.0]), heading=heading)
