"""Reads the files that trainings and evaluations have written. Imports no JAX and no matplotlib."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kslc_jax import files

Records = dict[str, np.ndarray]
"""Columns of a metrics.jsonl, by name; one value per train step."""

COLUMNS = (
    "env_steps",
    "seconds",
    "curriculum/v_max",
    "curriculum/tracking",
    "episode_steps",
    "steps_per_second",
)
"""Values that each record of a metrics.jsonl must have."""

LEARNT = ("command", "survival", "forward_mean")
"""Values that each row of a learning.json must have."""


def read_metrics(path: Path) -> Records:
    """Columns of a metrics.jsonl, or of the one in a run folder; ValueError if not readable."""
    path = path / files.METRICS if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"no {files.METRICS} at {path}")
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        records = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
        _ = [records[name] for name in COLUMNS]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} holds no metrics of a training") from error
    return records


def growth(records: Records) -> np.ndarray:
    """Indices of the records at which the commanded-speed range has grown."""
    return np.flatnonzero(np.diff(records["curriculum/v_max"]) > 0) + 1


def milestones(records: Records) -> list[tuple[float, float, float]]:
    """(v_max [m/s], environment steps, seconds) at each change of the commanded-speed range."""
    v = records["curriculum/v_max"]
    return [(v[i], records["env_steps"][i], records["seconds"][i]) for i in growth(records)]


def milestone_steps(records: Records) -> dict[str, float]:
    """Environment steps until the commands reached each speed, by the speed [m/s] as text."""
    return {f"{speed:g}": steps for speed, steps, _ in milestones(records)}


def short(x: float) -> float:
    """A value for a file that is kept: a whole number as it is, others with five digits."""
    return int(x) if float(x).is_integer() else float(f"{x:.5g}")


def thinned(records: Records, every: int, names: Iterable[str]) -> str:
    """Lines of a metrics.jsonl that is kept: the columns `names` of every `every`-th record.

    The records at which the range of commands grew, and the last one, are kept as well.
    """
    count = len(records["env_steps"])
    kept = sorted({*range(0, count, every), *growth(records), count - 1})
    rows = ({name: short(records[name][i]) for name in names} for i in kept)
    return "".join(f"{json.dumps(row)}\n" for row in rows)


def in_minutes(seconds: float) -> str:
    """A time [s] as '34 min'; below ten minutes with a decimal, as '1.5 min'."""
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes >= 10.0 else f"{minutes:.1f} min"


def read_evaluations(paths: Sequence[Path]) -> dict[str, list[list[dict[str, float]]]]:
    """Rows of evaluation files, one list per seed, by method.

    The method is the name of the file without '-seedN'. For files with the name evaluation.json it
    is the name of their folder.

    Raises:
      ValueError: a file is no evaluation, or the seeds of a method were tried at different speeds.
    """
    found: dict[str, list[list[dict[str, float]]]] = {}
    for path in paths:
        try:
            content = json.loads(path.read_text())
            rows = content["rows"] if "rows" in content else content["conditions"]["nominal"]
            _ = [float(row["command"]) for row in rows]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is no evaluation (of evaluate or sim2sim --json)") from error
        name = files.run_name(path.parent) if path.name == files.EVALUATION else path.stem
        found.setdefault(_method(name), []).append(rows)
    for name, seeds in found.items():
        if len({tuple(row["command"] for row in rows) for rows in seeds}) > 1:
            raise ValueError(f"the seeds of {name} were tried at different speeds")
    return found


def _method(run: str) -> str:
    return run.rsplit("-seed", 1)[0]


@dataclass(frozen=True)
class Curve:
    """Mean speeds of one training's policies, over its environment steps."""

    env_steps: np.ndarray  # [P]
    speeds: tuple[float, ...]  # [V] m/s, commanded
    reached: np.ndarray  # [P, V] m/s, mean forward speed


def read_learning(paths: Sequence[Path]) -> dict[str, list[Curve]]:
    """Curves of learning.json files, or of those in run folders, by method.

    The seeds of a method are cut to the length of the shortest one.

    Raises:
      ValueError: a file is no learning curve, or the curves do not fit together.
    """
    found: dict[str, list[Curve]] = {}
    for path in paths:
        file = path / files.LEARNING if path.is_dir() else path
        try:
            content = json.loads(file.read_text())
            found.setdefault(_method(content["run"]), []).append(_curve(content["points"]))
        except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{file} is no learning curve (made by kslc_jax.learning)") from error
    if len({curve.speeds for curves in found.values() for curve in curves}) > 1:
        raise ValueError("the runs were tried at different speeds")
    return {name: _aligned(name, curves) for name, curves in found.items()}


def _curve(points: list[dict]) -> Curve:
    return Curve(
        np.array([point["env_steps"] for point in points]),
        tuple(row["command"] for row in points[0]["rows"]),
        np.array([[row["forward_mean"] for row in point["rows"]] for point in points]),
    )


def _aligned(name: str, curves: list[Curve]) -> list[Curve]:
    count = min(len(curve.env_steps) for curve in curves)
    cut = [Curve(c.env_steps[:count], c.speeds, c.reached[:count]) for c in curves]
    if not all(np.array_equal(c.env_steps, cut[0].env_steps) for c in cut):
        raise ValueError(f"the seeds of {name} kept their policies at different steps")
    return cut


def read_schedules(path: Path, condition: str) -> list[dict]:
    """Rows of one condition in a file of sim2sim --schedule --json; ValueError if there are
    none."""
    conditions = read_conditions(path)
    if condition not in conditions:
        raise ValueError(f"{path} has no condition {condition!r}, but {', '.join(conditions)}")
    rows = conditions[condition]
    try:
        _ = [row["series"]["forward"][0][0] for row in rows]
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path} holds no schedules (of sim2sim --schedule --json)") from error
    return rows


def read_conditions(path: Path) -> dict[str, list[dict]]:
    """Rows of a file of sim2sim --json, by condition; ValueError if it is no such file."""
    try:
        conditions = json.loads(path.read_text())["conditions"]
        names = [[(row_name(row), row["survival"]) for row in rows] for rows in conditions.values()]
        if not (names and names[0]):
            raise ValueError("no rows")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} holds no conditions (of sim2sim --json)") from error
    return conditions


def row_name(row: dict) -> str:
    """Name of a row: its schedule, or its commanded speed."""
    return row["schedule"] if "schedule" in row else f"{row['command']:g} m/s"
