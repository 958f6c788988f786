"""The bars that a policy must meet, applied to the results of `kslc_jax.judge`. Pure Python.

Speeds below are those of XBot-L. For another robot they are scaled.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]

TOP = 4.0
"""Fastest command [m/s] at which no robot may fall."""

GAIT_TOP = 3.5
"""Fastest command [m/s] at which joints must keep their speed limits and the base must be calm."""

PERTURBED_TOP = 3.0
"""Fastest command [m/s] at which no perturbed robot may fall."""

SLOWEST = 0.5
"""Slowest command [m/s] at which the gait is judged."""


REPORTED = "reported"
"""Requirement of a number that is measured only to be known."""

HARSH: dict[str, tuple[float, tuple[float, ...]]] = {
    "punch=300": (0.95, (0.0, 1.0, 2.0, 3.0)),
    "punch=500": (0.0, (0.0, 1.0, 2.0, 3.0)),  # only reported
    "arms=1": (1.0, (0.0, 1.0, 2.0)),
    "rough:0.05": (1.0, (0.0, 1.0, 2.0)),
    "rough:0.03": (1.0, (3.0,)),
    "slope:10": (1.0, (0.0, 1.0, 2.0)),
}
"""Harsh conditions: share of the robots that must not fall, and commanded speeds [m/s]. With a
share of 0 the result is only reported."""


@dataclass(frozen=True)
class Bar:
    """One requirement and its result."""

    name: str
    wanted: str
    value: float | None  # the worst value; None if nothing was measured, or all robots fell
    where: str  # speed, schedule or condition of the worst value; *: beyond the training
    met: bool

    @property
    def requires(self) -> bool:
        """False if the value is only reported."""
        return self.wanted != REPORTED

    def shown(self) -> str:
        """The value as text."""
        return "-" if self.value is None else f"{self.value:.3g}"


def bars(results: dict[str, Any], scale: float = 1.0, arms: bool = True) -> list[Bar]:
    """Compares the results with all bars.

    Args:
      results: of `judging.measure`. "speeds": rows by commanded speed; "schedules" and "perturbed":
        rows by condition; "harsh", only with --harsh: the wanted share and the rows by condition;
        "drake": rows by commanded speed, only with --drake.
      scale: factor on the commanded speeds, see `scaled`.
      arms: True if the robot has arms. Without arms there is no bar on them.
    """
    slowest, gait_top, perturbed_top, top = (
        scaled(speed, scale) for speed in (SLOWEST, GAIT_TOP, PERTURBED_TOP, TOP)
    )
    speeds: list[Row] = results["speeds"]
    gait, calm = _between(speeds, slowest, top), _between(speeds, slowest, gait_top)
    flight = [row for row in speeds if row["command"] == gait_top]
    rest = [row for row in speeds if row["command"] == 0.0]
    found = [
        _at_least(f"nobody falls, 0 to {top:g} m/s", 1.0, _upright(_between(speeds, 0.0, top))),
        _at_most(
            f"speed error, {slowest:g} to {top:g} m/s, share", 0.03, _each(gait, _speed_error)
        ),
        _at_most("speed at command 0 [m/s]", 0.03, _each(rest, _creep)),
        _at_most("drift at command 0 [m/s]", 0.005, _of(rest, "drift")),
        _at_most("strides a second at command 0", 0.05, _of(rest, "stride_frequency")),
        _at_least("nobody falls, random schedule", 1.0, _by_condition(results["schedules"])),
        _at_least(
            f"joints within speed limits, to {gait_top:g} m/s",
            0.99,
            _of(calm, "within_speed_limits"),
        ),
        *[_at_most("arm-leg correlation", -0.5, _of(gait, "shoulder_hip_correlation"))] * arms,
        _at_most("left-right difference", 0.05, _each(gait, _asymmetry)),
        _at_most(f"lateral std, to {gait_top:g} m/s [m/s]", 0.1, _of(calm, "lateral_std")),
        _at_most(f"yaw-rate std, to {gait_top:g} m/s [rad/s]", 0.25, _of(calm, "yaw_rate_std")),
        _at_least(f"flight at {gait_top:g} m/s", 0.1, _of(flight, "flight_share")),
        _at_least(
            f"nobody falls, perturbed, to {perturbed_top:g} m/s",
            1.0,
            _by_condition(results["perturbed"]),
        ),
    ]
    found += [
        _at_least(f"share that does not fall, {condition}", part["wanted"], _upright(part["rows"]))
        for condition, part in results.get("harsh", {}).items()
    ]
    if "drake" in results:
        found.append(
            _at_least(f"nobody falls, Drake, to {top:g} m/s", 1.0, _upright(results["drake"]))
        )
    return found


def ranked(judged: dict[str, list[Bar]]) -> list[str]:
    """Names of judged policies, the best first.

    The number of missed bars decides, then the sum of what the policy misses them by, each as a
    share of its bound. A bar without a measured value counts as missed by 1.
    """

    def miss(bar: Bar) -> float:
        if bar.met:
            return 0.0
        if bar.value is None:
            return 1.0
        bound = float(bar.wanted.split()[1])
        return abs(bar.value - bound) / abs(bound)

    def place(name: str) -> tuple[int, float]:
        return sum(not bar.met for bar in judged[name]), sum(map(miss, judged[name]))

    return sorted(judged, key=place)


def scaled(speed: float, scale: float) -> float:
    """A commanded speed [m/s] for a robot that moves `scale` times as fast as XBot-L."""
    return round(speed * scale, 2)


Measured = list[tuple[float | None, str]]
"""(value, its speed, schedule or condition) of each measurement. None: all robots fell there."""


def _at_least(name: str, bound: float, measured: Measured) -> Bar:
    value, where = _worst(min, measured)
    if bound == 0.0:
        return Bar(name, REPORTED, value, where, True)
    return Bar(name, f">= {bound:g}", value, where, value is not None and value >= bound)


def _at_most(name: str, bound: float, measured: Measured) -> Bar:
    value, where = _worst(max, measured)
    return Bar(name, f"<= {bound:g}", value, where, value is not None and value <= bound)


def _worst(pick: Callable, measured: Measured) -> tuple[float | None, str]:
    """The worst value and its place. A place where all robots fell is worse than any value."""
    fallen = [where for value, where in measured if value is None]
    if fallen:
        return None, f"{fallen[0]}: all fell"
    return pick(measured, default=(None, "not measured"))


def _between(rows: Iterable[Row], low: float, high: float) -> list[Row]:
    return [row for row in rows if low <= row["command"] <= high]


def _place(row: Row) -> str:
    name = f"{row['command']:g} m/s" if "command" in row else row["schedule"]
    return name + "*" * ("beyond" in row)


def _of(rows: Iterable[Row], name: str) -> Measured:
    """The metric `name` of each row that has it, and None where all robots fell."""
    return _each(rows, lambda row: row.get(name))


def _upright(rows: Iterable[Row]) -> Measured:
    return _of(rows, "survival")


def _each(rows: Iterable[Row], number: Callable[[Row], float | None]) -> Measured:
    values = [(number(row), _place(row), row["survival"] > 0.0) for row in rows]
    return [(value, where) for value, where, stands in values if value is not None or not stands]


def _by_condition(conditions: dict[str, list[Row]]) -> Measured:
    return [
        (value, f"{condition}, {where}")
        for condition, rows in conditions.items()
        for value, where in _upright(rows)
    ]


def _speed_error(row: Row) -> float:
    """|mean vx - command| / command, where a fallen robot counts as 0 m/s."""
    return abs(row["forward_mean"] - row["command"]) / row["command"]


def _creep(row: Row) -> float:
    return max(abs(row["forward_mean"]), abs(row.get("lateral_mean", 0.0)))


def _asymmetry(row: Row) -> float | None:
    return max((value for name, value in row.items() if name.endswith("_difference")), default=None)
