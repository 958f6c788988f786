"""Checks of config values. Each error names the field and says what is allowed."""

from __future__ import annotations

import dataclasses

from kslc_jax.errors import UserError

Range = tuple[float, float]


class ConfigError(UserError):
    """A config value cannot work. The message names the field and says what is allowed."""


def require(ok: bool, message: str) -> None:
    """Raises ConfigError with `message` if not `ok`."""
    if not ok:
        raise ConfigError(message)


COUNTER = 2**31
"""Upper limit of steps, samples and seeds: the train step counts in 32-bit integers."""


def require_seed(seed: int, name: str = "seed") -> None:
    """Raises ConfigError if `seed` does not lie in [0, 2^31)."""
    require(0 <= seed < COUNTER, f"{name} must lie in [0, 2^31), not {seed}")


LARGEST = 2**44
"""Numbers of a config lie below this one. The frames of a window become one axis of a network's
input, and the size of an axis must be below 2^63: there is room for frames of 2^19 numbers."""


def check_numbers(name: str, value: object) -> None:
    """Raises ConfigError for numbers that are not finite, or too large for an array shape."""
    if dataclasses.is_dataclass(value):
        for f in dataclasses.fields(value):
            check_numbers(f"{name}.{f.name}".lstrip("."), getattr(value, f.name))
    elif isinstance(value, tuple):
        for part in value:
            check_numbers(name, part)
    elif isinstance(value, int | float):
        require(abs(value) < LARGEST, f"{name}: {value} is too large or not finite")


def check_range(name: str, value: Range) -> None:
    """Raises ConfigError if the lower bound is above the upper one."""
    require(value[0] <= value[1], f"{name}: lower bound {value[0]} is above upper bound {value[1]}")
