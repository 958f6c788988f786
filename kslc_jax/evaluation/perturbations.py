"""Perturbations by name (friction=0.3, payload=5, links=0.1, ...) and the settings they change.

Also uneven ground by name (rough:0.05, slope:10, ...). Imports no JAX, so that a command checks its
arguments quickly.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from kslc_jax.config import GROUNDS, MOST_INSET, ConfigError, RandomizeConfig, TerrainConfig


@dataclass(frozen=True)
class Variation:
    """Sizes of the differences between a robot and its description; 0: no difference."""

    hands: float = 0.0
    """Mass added at each hand [kg]."""
    sole: float = 0.0
    """Largest distance [m] of each side of a sole from the foot's outline, inwards. It is drawn
    anew at every control step."""
    joints: float = 0.0
    """Largest Coulomb friction [N m] and largest damping [N m s/rad] added to each joint."""

    def __post_init__(self):
        for name in ("hands", "joints"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must not be negative")
        if not 0 <= self.sole <= MOST_INSET:
            raise ConfigError(f"sole must lie in [0, {MOST_INSET}] m")


PUSH_SECONDS = 4.0
"""Time between two pushes [s]."""

PERTURBATIONS: dict[str, Callable[[float], dict[str, Any]]] = {
    "friction": lambda mu: {"friction": (mu, mu), "ground_friction": mu},
    "payload": lambda kg: {"base_mass": (kg, kg)},
    "com": lambda metres: {"base_com": (metres, metres)},
    "push": lambda speed: {
        "push_seconds": PUSH_SECONDS,
        "push_velocity": speed,
        "push_angular": 0.0,
    },
    "punch": lambda newtons: {"punch": (newtons, newtons)},
    "arms": lambda share: {"held_arms": share},
    "gains": lambda factor: {"kp": (factor, factor), "kd": (factor, factor)},
    "strength": lambda factor: {"motor_strength": (factor, factor)},
    "imu": lambda angle: {"imu_offset": (angle, angle)},
    "links": lambda share: {"link_mass": (1.0 - share, 1.0 + share)},
    "hands": lambda kg: {"variation": Variation(hands=kg)},
    "sole": lambda metres: {"variation": Variation(sole=metres)},
    "joints": lambda most: {"variation": Variation(joints=most)},
    "heading": lambda yaw: {"heading": yaw},
}
"""Name -> (value -> changed fields of `RandomizeConfig` or of `trials.Setting`)."""

ALL = (
    *("friction=0.3", "friction=0.6", "friction=1.5"),
    *("payload=-5", "payload=5", "com=-0.02", "com=0.02", "push=0.5"),
    *("gains=0.85", "gains=1.15", "strength=0.9", "imu=0.03"),
    *("links=0.1", "hands=0.5", "sole=0.02", "joints=1"),
)
"""The conditions of `--perturb all`."""

SCALED_AS = {
    "rough": "physics.terrain.rough",
    "stairs": "physics.terrain.stairs",
    "punch": "randomize.punch",
    "payload": "randomize.base_mass",
    "com": "randomize.base_com",
    "push": "randomize.push_velocity",
    "hands": "randomize.hand_mass",
    "sole": "randomize.sole",
    "joints": "randomize.joint_friction",
}
"""Name -> the config field that depends on a robot's size in the same way. Values of other names
are the same for all robots."""

ROBOT = {f.name for f in dataclasses.fields(RandomizeConfig)}
"""Names of the changes that belong in `trials.Setting.randomize`."""


def scaled(condition: str, factors: dict[str, float]) -> str:
    """The condition with its value for a robot of another size; `factors`: `similar.factors`."""
    between = ":" if ":" in condition else "="
    name, _, value = condition.partition(between)
    factor = factors[SCALED_AS[name]] if name in SCALED_AS else 1.0
    if factor == 1.0:
        return condition
    return f"{name}{between}{float(f'{float(value) * factor:.2g}'):g}"  # 150, not 1.5e+02


def left_out(wanted: Sequence[str], tried: Sequence[str]) -> str:
    """A message that names the conditions that are wanted but not tried; empty without any."""
    there = {re.split("[=:]", condition)[0] for condition in tried}
    names = dict.fromkeys(re.split("[=:]", condition)[0] for condition in wanted)
    missing = ", ".join(name for name in names if name not in there)
    return f"left out, because robot or engine lacks it: {missing}" if missing else ""


def disturbed(randomize: RandomizeConfig, punch: float, hold_arms: bool) -> RandomizeConfig:
    """`randomize` with punches of `punch` [N], and with arms that follow random targets."""
    return dataclasses.replace(randomize, punch=(punch, punch), held_arms=float(hold_arms))


def terrain(text: str) -> TerrainConfig:
    """Ground of one kind and size, from a text such as 'rough:0.05'. ConfigError if it is wrong."""
    kind, _, size = text.partition(":")
    try:
        if kind not in GROUNDS or not 0 < float(size) < math.inf:
            raise ValueError
        sizes: dict[str, Any] = {kind: float(size)}
        return TerrainConfig(**sizes, flat=0.0, least=1.0)
    except ConfigError as error:
        raise ConfigError(f"ground: {text}: {error}") from None
    except ValueError:
        raise ConfigError(
            f"ground: cannot read {text!r} (known: rough:METRES, slope:DEGREES, stairs:METRES, "
            "each above 0)"
        ) from None


def changes(condition: str) -> dict[str, Any]:
    """The fields that a condition changes, with their values.

    Args:
      condition: 'nominal', a perturbation such as 'payload=5', or a ground such as 'rough:0.05';
        `terrain` is a field of `trials.Setting.physics`.

    Raises:
      ConfigError: the condition is unknown, or its value is out of range.
    """
    if condition == "nominal":
        return {}
    if ":" in condition:
        return {"terrain": terrain(condition)}
    name, _, value = condition.partition("=")
    try:
        if not math.isfinite(float(value)):
            raise ValueError
        made = PERTURBATIONS[name](float(value))
        RandomizeConfig(**{k: v for k, v in made.items() if k in ROBOT})
    except ConfigError as error:
        raise ConfigError(f"perturb: {condition}: {error}") from None
    except (KeyError, ValueError):
        known = ", ".join(f"{name}=X" for name in PERTURBATIONS)
        raise ConfigError(f"perturb: cannot read {condition!r} (known: {known}, all)") from None
    return made


def settings(made: dict[str, Any], randomize: RandomizeConfig) -> dict[str, Any]:
    """Fields of `trials.Setting` for the `changes` of a condition.

    The fields of `randomize` that the condition does not change keep their values.
    """
    robot = {name: value for name, value in made.items() if name in ROBOT}
    rest = {name: value for name, value in made.items() if name not in ROBOT}
    return rest | {"randomize": dataclasses.replace(randomize, **robot)}
