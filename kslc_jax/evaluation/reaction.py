"""How robots react to commands that change: numbers from a `Trace` of a schedule, in numpy.

A change is the start of a leg of the schedule. Speeds are smoothed over `WINDOW`, about a gait
cycle. Legs count up to a fall; the leg in which a robot falls counts in survival alone.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np

from kslc_jax.evaluation.trials import Trace

WINDOW = 0.5
"""Seconds over which velocities are averaged."""

AFTER = 2.0
"""Seconds after a change over which the tracking error is averaged."""

SETTLED = 0.15, 0.1
"""A robot has settled once its velocity error stays below the larger of these: m/s, and share of
the change."""

AT_REST = 0.15
"""Speed over ground [m/s] below which a robot has stopped."""

FROM = 0.5
"""Commanded speed before a stop [m/s] from which stops count."""

SHOWN, SHOWN_EVERY = 3, 0.1
"""Robots whose speed is kept for the figure, and the time between its samples [s]."""


@dataclasses.dataclass(frozen=True)
class Change:
    """A command that came after another one, of one robot."""

    error: float  # m/s, mean over the first `AFTER` seconds
    settle: float | None  # s; None if the leg ended before
    stop: tuple[float, float] | None  # s and m until at rest; None if it was no stop, or none yet
    drift: float | None  # m/s over ground once at rest
    stops: bool  # whether it was a stop from a run


def summary(trace: Trace, dt: float) -> dict[str, float]:
    """Survival, and the reaction to changes, as means over all of them.

    Keys: survival, seconds_to_fall, changes (per robot), change_error [m/s], settle_seconds,
    settled (share of the changes), stop_seconds, stop_metres, stop_metres_most, stopped (share of
    the stops), drift [m/s], forward_mean [m/s], yaw_rate_std [rad/s].
    """
    alive = np.asarray(trace.alive)
    count, found = alive.shape[1], []
    for i in range(count):
        found += _changes(trace, i, dt)
    upright = alive[-1]
    out = {
        "survival": float(upright.mean()),
        "changes": len(found) / count,
        "forward_mean": float(np.asarray(trace.linvel)[..., 0][alive].mean()),
        "yaw_rate_std": float(np.asarray(trace.angvel)[..., 2][alive].std()),
    }
    if not upright.all():
        out["seconds_to_fall"] = float(alive[:, ~upright].sum(0).mean() * dt)
    stops = [c for c in found if c.stops]
    done = [c.stop for c in stops if c.stop is not None]
    settle = [c.settle for c in found if c.settle is not None]
    drift = [c.drift for c in stops if c.drift is not None]
    return (
        out
        | _mean("change_error", [c.error for c in found])
        | _mean("settle_seconds", settle)
        | _mean("settled", [c.settle is not None for c in found])
        | _mean("stop_seconds", [seconds for seconds, _ in done])
        | _mean("stop_metres", [metres for _, metres in done])
        | ({"stop_metres_most": float(max(m for _, m in done))} if done else {})
        | _mean("stopped", [c.stop is not None for c in stops])
        | _mean("drift", drift)
    )


def _mean(name: str, values: list) -> dict[str, float]:
    return {name: float(np.mean(values))} if values else {}


def falls(trace: Trace, dt: float) -> list[dict]:
    """Each fall: robot, time [s], seconds since the last change, and the commanded vx and vy [m/s]
    before and after that change."""
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
    """Commanded and actual forward speed of the first robots for the figure; None from a fall."""
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
    """All changes that one robot lived through, without the start from rest."""
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
    """One leg: velocity [T, 2], position [T, 2], and the command [1 + T, 2] from the step before
    it on."""
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
    """Seconds from which on it is near to the end; None if it is not near at the end."""
    if not near[-1]:
        return None
    away = np.flatnonzero(~near)
    return float((away[-1] + 1) * dt) if len(away) else 0.0


def _smooth(values: np.ndarray, dt: float) -> np.ndarray:
    """Moving average of [T, 2] over `WINDOW`, centred; shorter at the ends."""
    half = round(WINDOW / dt) // 2
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), values]), axis=0)
    at = np.arange(len(values))
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    return (total[high] - total[low]) / (high - low)[:, None]
