"""For all commands that try a policy: the engines to choose from, and checks of options.

Imports no JAX, so that a command checks its arguments quickly.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from kslc_jax.config import XBOT_L, ConfigError
from kslc_jax.errors import MissingPackage

if TYPE_CHECKING:
    from kslc_jax.robot import Robot

Engine = Literal["mujoco", "drake"]
"""Simulators of a trial at high fidelity."""

SPEEDS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
"""Commanded speeds [m/s] of XBot-L, if none are given."""

SHORTEST = 3.0
"""Shortest trial [s]. Some time must remain after the robot has gathered speed."""

LONGEST = 86_400.0
"""Longest trial [s]: a day."""


def simulator(engine: Engine) -> Callable[..., Any] | None:
    """The value of `trials.Setting.simulate` for an engine: None for MuJoCo.

    Raises:
      MissingPackage: the engine is not installed.
    """
    if engine == "mujoco":
        return None
    try:
        from kslc_jax.evaluation import drake
    except ImportError as error:
        raise MissingPackage(f"{error}; try: pip install 'kslc_jax[drake]'") from error
    return drake.step


def require_engine(engine: Engine, robot: "Robot") -> None:
    """ConfigError if the engine cannot take over the robot."""
    if engine == "drake":
        from kslc_jax.evaluation import drake

        drake.require_hinged(robot)


def speeds_for(
    robot: str, wanted: tuple[float, ...] | None, xbot: tuple[float, ...]
) -> tuple[float, ...]:
    """Commanded speeds [m/s]: `wanted`, or if this is None XBot-L's, scaled to the robot's size.

    `robot` is a shipped robot, or the path of a description.
    """
    if wanted is not None or robot == XBOT_L:
        return xbot if wanted is None else wanted
    from kslc_jax import robot as robot_lib
    from kslc_jax import similar
    from kslc_jax.evaluation.bars import scaled

    factor = similar.factors(robot_lib.load(name=robot))[similar.SPEED]
    return tuple(scaled(speed, factor) for speed in xbot)


def check_speeds(speeds: Sequence[float] | None) -> None:
    """ConfigError if there are no speeds, or one that is not finite."""
    if speeds is not None and not (speeds and all(map(math.isfinite, speeds))):
        raise ConfigError("speeds: name at least one, finite")


def check_trials(speeds: Sequence[float] | None, seeds: int, seconds: float) -> None:
    """ConfigError if the speeds [m/s], number or length [s] of the trials are out of range."""
    check_speeds(speeds)
    if seeds <= 0:
        raise ConfigError("seeds must be positive")
    if not (SHORTEST <= seconds <= LONGEST and seconds == round(seconds)):
        raise ConfigError(f"seconds must be a whole number from {SHORTEST:g} to {LONGEST:g}")


def check_disturbances(punch: float, top: float | None, scheduled: bool) -> None:
    """ConfigError if the force of punches [N] or the top speed of schedules [m/s] is wrong.

    `scheduled` is True if there is a schedule. Without one there is no top speed.
    """
    if not (math.isfinite(punch) and punch >= 0):
        raise ConfigError("punch must be a force in newtons, not negative")
    if top is not None and not (math.isfinite(top) and top > 0):
        raise ConfigError("top must be a positive speed")
    if top is not None and not scheduled:
        raise ConfigError("top is the fastest command of a schedule: give --schedule too")
