"""Metrics of the reaction to changing commands, from a `Trace` of a schedule, in numpy.

A schedule is a sequence of legs, see `schedules`. A change is the start of a leg. Speeds are
averaged over `WINDOW`, about one gait cycle. The leg in which a robot falls counts only in the
survival. A tour has way-points in place of changes.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np

from kslc_jax.evaluation.schedules import PATIENCE
from kslc_jax.evaluation.trials import Trace

WINDOW = 0.5
"""Time [s] over which velocities are averaged."""

AFTER = 2.0
"""Time [s] after a change over which the tracking error is averaged."""

SETTLED = 0.15, 0.1
"""Limits of the velocity error: in m/s, and as a share of the change of the command. A robot has
settled when its error stays below the larger one."""

AT_REST = 0.15
"""Speed over ground [m/s]. A robot that is slower has stopped."""

FROM = 0.5
"""Least commanded speed [m/s] before a stop, for the stop to count."""

SHOWN, SHOWN_EVERY = 3, 0.1
"""Number of robots whose speed the figure shows, and time between two samples [s]."""


@dataclasses.dataclass(frozen=True)
class Change:
    """Reaction of one robot to one change of its command."""

    error: float  # m/s, mean velocity error over the first `AFTER` seconds
    settle: float | None  # s until settled; None if the leg ended before
    stop: tuple[float, float] | None  # s and m until at rest; None if not a stop, or not at rest
    drift: float | None  # m/s, distance between rest and the end of the leg, over the time
    stops: bool  # True if the command is to stop, from at least `FROM`


def summary(trace: Trace, dt: float) -> dict[str, float]:
    """Survival, and metrics of the reaction, each a mean over all changes.

    Keys: survival, seconds_to_fall, changes (per robot), change_error [m/s], settle_seconds,
    settled (share of the changes), stop_seconds, stop_metres, stop_metres_most, stopped (share of
    the stops), drift [m/s], forward_mean [m/s], yaw_rate_std [rad/s].
    """
    count, found = np.asarray(trace.alive).shape[1], []
    for i in range(count):
        found += _changes(trace, i, dt)
    stops = [c for c in found if c.stops]
    done = [c.stop for c in stops if c.stop is not None]
    settle = [c.settle for c in found if c.settle is not None]
    drift = [c.drift for c in stops if c.drift is not None]
    return (
        _motion(trace, dt)
        | {"changes": len(found) / count}
        | _mean("change_error", [c.error for c in found])
        | _mean("settle_seconds", settle)
        | _mean("settled", [c.settle is not None for c in found])
        | _mean("stop_seconds", [seconds for seconds, _ in done])
        | _mean("stop_metres", [metres for _, metres in done])
        | ({"stop_metres_most": float(max(m for _, m in done))} if done else {})
        | _mean("stopped", [c.stop is not None for c in stops])
        | _mean("drift", drift)
    )


def tour(trace: Trace, dt: float) -> dict[str, float]:
    """Survival, and how quickly the robots reach way-points, from a trace of a tour.

    Keys: survival, seconds_to_fall, way_points (reached per minute of a robot that is upright),
    given_up (way-points per robot, see `schedules.PATIENCE`), forward_mean, yaw_rate_std.
    """
    alive, leg = np.asarray(trace.alive), np.asarray(trace.leg)
    steps = [
        length
        for numbers, upright in zip(leg.T, alive.T, strict=True)
        for length in np.bincount(numbers[upright])[:-1]  # the last leg has not ended
    ]
    reached = np.array(steps) * dt < PATIENCE - 0.5 * dt
    minutes = alive.sum() * dt / 60.0
    return _motion(trace, dt) | {
        "way_points": float(reached.sum() / minutes),
        "given_up": float((~reached).sum() / alive.shape[1]),
    }


def _motion(trace: Trace, dt: float) -> dict[str, float]:
    """Survival and mean motion, whatever the commands."""
    alive = np.asarray(trace.alive)
    upright = alive[-1]
    out = {
        "survival": float(upright.mean()),
        "forward_mean": float(np.asarray(trace.linvel)[..., 0][alive].mean()),
        "yaw_rate_std": float(np.asarray(trace.angvel)[..., 2][alive].std()),
    }
    if not upright.all():
        out["seconds_to_fall"] = float(alive[:, ~upright].sum(0).mean() * dt)
    return out


def _mean(name: str, values: list) -> dict[str, float]:
    return {name: float(np.mean(values))} if values else {}


def falls(trace: Trace, dt: float) -> list[dict]:
    """One entry per fall.

    Keys: robot (index), seconds (time of the fall), after (seconds since the last change), from
    and to (commanded vx, vy [m/s] before and after that change).
    """
    alive, command, leg = (np.asarray(x) for x in (trace.alive, trace.command, trace.leg))
    out = []
    for i in np.flatnonzero(~alive[-1]):
        end = int(alive[:, i].sum())  # the step of the fall
        last = min(end, len(leg) - 1)
        start = int(np.flatnonzero(leg[: last + 1, i] == leg[last, i])[0])
        before = command[start - 1, i] if start else np.zeros(3)
        out.append(
            {
                "robot": int(i),
                "seconds": end * dt,
                "after": (end - start) * dt,
                "from": [round(float(x), 2) for x in before[:2]],
                "to": [round(float(x), 2) for x in command[last, i][:2]],
            }
        )
    return out


def series(trace: Trace, dt: float) -> dict[str, Any]:
    """Commanded and actual forward speed [m/s] of the first robots; None from a fall on."""
    every = round(SHOWN_EVERY / dt)
    alive = np.asarray(trace.alive)[::every, :SHOWN].T
    actual = np.asarray(trace.linvel)[::every, :SHOWN, 0].T
    commanded = np.asarray(trace.command)[::every, :SHOWN, 0].T

    def rows(values: np.ndarray) -> list:
        return [
            [round(float(x), 3) if up else None for x, up in zip(row, ups, strict=True)]
            for row, ups in zip(values, alive, strict=True)
        ]

    return {"every": SHOWN_EVERY, "commanded": rows(commanded), "forward": rows(actual)}


def _changes(trace: Trace, robot: int, dt: float) -> list[Change]:
    """All changes that one robot survived, without the start from rest."""
    end = int(np.asarray(trace.alive)[:, robot].sum())
    fell = end < len(trace.alive)
    leg = np.asarray(trace.leg)[:end, robot]
    velocity = np.asarray(trace.linvel)[:end, robot, :2]
    command = np.asarray(trace.command)[:end, robot, :2]
    position = np.asarray(trace.qpos)[:end, robot, :2]
    marks = [*(np.flatnonzero(np.diff(leg)) + 1), end]  # starts of the legs, and the end
    if fell:
        marks = marks[:-1]
    return [
        _change(velocity[a:b], command[a - 1 : b], position[a:b], dt)
        for a, b in itertools.pairwise(marks)
    ]


def _change(velocity: np.ndarray, command: np.ndarray, position: np.ndarray, dt: float) -> Change:
    """The reaction within one leg of T steps.

    Args:
      velocity: [T, 2] m/s.
      command: [1 + T, 2] m/s; the first row is the command of the leg before.
      position: [T, 2] m, world frame.
      dt: control step [s].
    """
    size = float(np.linalg.norm(command[1] - command[0]))
    error = np.linalg.norm(_smooth(velocity - command[1:], dt), axis=-1)
    least, share = SETTLED
    rest = np.linalg.norm(_smooth(velocity, dt), axis=-1) < AT_REST
    stops = bool(np.linalg.norm(command[0]) >= FROM and not command[1:].any())
    at = int(np.argmax(rest)) if stops and rest.any() else None
    path = np.linalg.norm(np.diff(position, axis=0), axis=-1)
    still = None
    if at is not None and len(rest) - at > round(WINDOW / dt):
        moved = np.linalg.norm(position[-1] - position[at])
        still = float(moved / ((len(rest) - 1 - at) * dt))
    return Change(
        error=float(error[: round(AFTER / dt)].mean()),
        settle=_settle(error < max(least, share * size), dt),
        stop=None if at is None else (at * dt, float(path[:at].sum())),
        drift=still,
        stops=stops,
    )


def _settle(near: np.ndarray, dt: float) -> float | None:
    """Time [s] from which on `near` [T] is True to the end; None if its last value is False."""
    if not near[-1]:
        return None
    away = np.flatnonzero(~near)
    return float((away[-1] + 1) * dt) if len(away) else 0.0


def _smooth(values: np.ndarray, dt: float) -> np.ndarray:
    """Centred moving average of values [T, 2] over `WINDOW`. At the ends the window is shorter."""
    half = round(WINDOW / dt) // 2
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), values]), axis=0)
    at = np.arange(len(values))
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    return (total[high] - total[low]) / (high - low)[:, None]
