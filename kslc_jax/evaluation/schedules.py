"""Commands that change during a trial.

A schedule is a sequence of legs. Each leg has one command. The next leg of a robot is a pure
function of (schedule, leg number, key, yaw, position). `trials` calls it inside its scan.
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
"""Durations [s] of the legs of `stop` and `reverse`: at the top speed; at rest or in reverse."""

BLOCK = 5
"""Legs in a block of `random` and `jitter`. The last but one runs at the top speed. The last one
stops or reverses. The others have random commands, drawn as in training."""

REVERSALS = 1 / 3
"""Share of the blocks that end with a reversal. The others end with a stop."""

TURNS = (0.25, 0.5, 0.75)
"""Speeds of `turns`, as shares of the top speed."""

NEAR, FAR = 4.0, 15.0
"""Least and largest distance [m] to the next way-point of `tour`."""

REACHED = 0.7
"""Distance [m] at which a way-point counts as reached."""

APPROACH, CRAWL = 0.6, 0.5
"""Near a way-point: speed per distance [1/s], and least speed [m/s]."""

PATIENCE = 60.0
"""Time [s] after which `tour` gives up a way-point and draws another one."""


@dataclass(frozen=True)
class Step:
    """One command in a list of commands."""

    seconds: float
    vx: float  # m/s
    vy: float = 0.0  # m/s, to the left
    yaw_rate: float = 0.0  # rad/s, to the left; 0 keeps a heading
    heading: float | None = None  # rad, world; None keeps the heading of the leg before


@dataclass(frozen=True)
class Schedule:
    """Commands over time: a list that repeats, random commands, or a tour of way-points."""

    name: str
    top: float  # m/s, the fastest command
    low: float = 0.0  # m/s, the slowest command; negative: backwards
    top_width: float = 0.0  # m/s, width of the range from which training draws its top commands
    steps: tuple[Step, ...] = ()  # the list; empty for random commands and for a tour
    seconds: tuple[float, float] = (PATIENCE, PATIENCE)  # shortest and longest random leg
    brakes: bool = False  # True: random legs come in blocks with a brake at the end, see `BLOCK`
    tour: bool = False  # True: the robot heads for random way-points


@flax.struct.dataclass
class Leg:
    """The present leg of one robot."""

    number: jax.Array  # [] int, from 0
    left: jax.Array  # [] s, time until the leg ends
    velocity: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s]
    heading: jax.Array  # [] rad, world, commanded while the commanded yaw rate is 0
    point: jax.Array  # [2] m, world, the next way-point; NaN if there is none


# -------------------------------------------------------------------------------------- schedules


def named(name: str, config: Config, v_max: float, top: float | None = None) -> Schedule:
    """The built-in schedule of this name, or the schedule in a JSON file.

    Args:
      name: one of `NAMES`, or the path of a list of {seconds, vx, vy, yaw_rate or heading}.
      config: the policy's config; random commands are drawn as in its training.
      v_max: fastest command of the policy's training [m/s].
      top: fastest command of the schedule [m/s]. None: `v_max`; a file keeps its own speeds.

    Raises:
      ConfigError: there is no such name or file, or the file holds no schedule.
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
    """Steps of `turns`: at each speed straight on, then to the left, then to the right.

    The yaw rate is the largest one that training commands at that speed.
    """
    steps = []
    for share in TURNS:
        vx = share * top
        *_, rate = commands.widest(config, vx)
        steps += [Step(3.0, vx), Step(3.0, vx, yaw_rate=rate), Step(3.0, vx, yaw_rate=-rate)]
    return tuple(steps)


def _read(path: Path, top: float | None) -> Schedule:
    """Reads a user's schedule. `top` [m/s], if given, limits its forward speeds."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        known = ", ".join(NAMES)
        raise ConfigError(f"schedule: no file {str(path)!r} (known names: {known})") from None
    except OSError as error:
        raise ConfigError(f"schedule: cannot read {path}: {error.strerror}") from None
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
    where = f"schedule: step {index} of {path}"
    if not (isinstance(entry, dict) and {"seconds", "vx"} <= entry.keys()):
        raise ConfigError(f"{where} needs seconds and vx")
    names = [field.name for field in dataclasses.fields(Step)]
    for name, value in entry.items():
        if name not in names:
            raise ConfigError(f"{where} has the unknown name {name!r} (known: {', '.join(names)})")
        if not _is_number(value):
            raise ConfigError(f"{where}: {name} must be a finite number")
    step = Step(**{name: float(value) for name, value in entry.items()})
    if step.seconds <= 0:
        raise ConfigError(f"{where}: seconds must be above 0")
    if step.yaw_rate and step.heading is not None:
        raise ConfigError(f"{where} has both yaw_rate and heading")
    return step


def _is_number(value: Any) -> bool:
    """True for a number that a float holds: JSON also has NaN, infinity and endless integers."""
    try:
        return isinstance(value, (int, float)) and math.isfinite(value)
    except OverflowError:
        return False


# ------------------------------------------------------------------------------------------- legs


def constant(velocity: jax.Array, heading: jax.Array | float) -> Leg:
    """The only leg of a trial without a schedule: `velocity` [3], `heading` [rad]."""
    return Leg(
        number=jnp.zeros((), jnp.int32),
        left=jnp.zeros(()),
        velocity=velocity,
        heading=jnp.asarray(heading, jnp.float32),
        point=jnp.full(2, jnp.nan),
    )


def before_start(heading: jax.Array | float) -> Leg:
    """A finished leg that stands before the first leg of a schedule; `heading` [rad]."""
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
    """The leg for the next `dt` seconds: the present one, or the next one if it has ended.

    Args:
      schedule: the schedule (static under jit).
      config: distribution of the commands in training.
      leg: the leg of the last step.
      key: random key of this robot, the same in every step.
      yaw: present heading of the robot [rad].
      position: [2] present position of the robot in the world [m].
      dt: time between two calls [s].
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
    drawn = jnp.append(sampled.wanted, 0.0)  # the heading alone decides the turn
    special = fast | brakes
    seconds = jax.random.uniform(keys[2], minval=shortest, maxval=longest)
    return leg.replace(
        left=jnp.where(fast, longest, seconds),
        velocity=jnp.where(special, straight, drawn),
        heading=jnp.where(special, yaw, sampled.heading),
    )


def _next_point(leg: Leg, key: jax.Array, yaw: jax.Array, position: jax.Array) -> Leg:
    """A leg to a random way-point around the robot, at a distance from `NEAR` to `FAR`."""
    key_bearing, key_distance = jax.random.split(key)
    bearing = jax.random.uniform(key_bearing, minval=-jnp.pi, maxval=jnp.pi)
    distance = jax.random.uniform(key_distance, minval=NEAR, maxval=FAR)
    ahead = jnp.stack([jnp.cos(yaw + bearing), jnp.sin(yaw + bearing)])
    return leg.replace(left=jnp.full((), PATIENCE), point=position + distance * ahead)


def _towards(schedule: Schedule, leg: Leg, yaw: jax.Array, position: jax.Array) -> Leg:
    """Commands the robot towards its way-point: slowly near it, and while it is not ahead."""
    way = leg.point - position
    heading = jnp.arctan2(way[1], way[0])
    ahead = jnp.clip(jnp.cos(maths.wrap_angle(heading - yaw)), 0.0, 1.0)
    fast = jnp.minimum(schedule.top, APPROACH * jnp.hypot(*way) + CRAWL)
    vx = jnp.clip(jnp.square(ahead) * fast, min(CRAWL, schedule.top), schedule.top)
    return leg.replace(velocity=vx * jnp.array([1.0, 0.0, 0.0]), heading=heading)
