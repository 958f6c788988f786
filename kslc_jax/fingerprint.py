"""The fingerprint of a robot: the numbers of its description and model.

A training depends on them, on its config and on the code. Every checkpoint and every policy stores
them. If the robot changes later, a message names the changed numbers. Values that people tune are
stored as numbers. The rest of the compiled model is stored as one checksum per group and fidelity.
"""

import math
import zlib
from typing import Any

import numpy as np

from kslc_jax import robot as robot_lib
from kslc_jax.config import Fidelity
from kslc_jax.robot import Robot

Fingerprint = dict[str, Any]
"""`values`: name -> joint or body -> number; `digests`: fidelity -> group -> checksum."""

FIDELITIES: tuple[Fidelity, ...] = ("train", "high")

DECIMALS = 9
"""Number of decimals that are compared. Another machine may round the last bits of an inertia
differently."""

SHOWN = 3
"""Number of changed values of one kind that a message lists."""

_FIELDS = {
    "inertias": ("body_inertia", "body_ipos", "body_iquat"),
    "frames": ("body_parentid", "body_pos", "body_quat", "jnt_type", "jnt_pos", "jnt_axis"),
    "joint friction and damping": ("dof_frictionloss", "dof_damping", "jnt_stiffness"),
    "contact pairs": (
        *("pair_geom1", "pair_geom2", "pair_dim", "pair_margin", "pair_gap", "pair_friction"),
        *("pair_solref", "pair_solimp", "exclude_signature"),
    ),
    "sensors": (
        *("sensor_type", "sensor_objtype", "sensor_objid", "sensor_adr", "sensor_cutoff"),
        *("site_bodyid", "site_pos", "site_quat"),
    ),
}
"""Groups of the compiled model's arrays."""

_COLLISION = (
    *("bodyid", "type", "size", "pos", "quat", "friction", "condim", "contype", "conaffinity"),
    *("priority", "margin", "gap", "solref", "solimp", "solmix"),
)
"""Arrays `geom_NAME` of the geoms that can touch something."""

_OPTIONS = ("gravity", "integrator", "cone", "solver", "impratio", "tolerance", "disableflags")
"""Options of the simulation that `PhysicsConfig` does not contain."""


def fingerprint(name: str) -> Fingerprint:
    """The present fingerprint of a robot.

    `name` is the name of a shipped robot, or the path of a description.
    """
    robots = {fidelity: robot_lib.load(fidelity, name=name) for fidelity in FIDELITIES}
    return {
        "values": _values(robots["train"]),
        "digests": {fidelity: _digests(robot) for fidelity, robot in robots.items()},
    }


def changes(then: Fingerprint, now: Fingerprint) -> str:
    """The differences between two fingerprints, in one line; empty if there are none.

    A number that only one of them has does not count as a difference.
    """
    values = now.get("values", {})
    found = [
        _changed(name, then["values"][name], values[name])
        for name in values.keys() & then.get("values", {}).keys()
    ]
    fidelities: dict[str, list[str]] = {}
    for fidelity, digests in now.get("digests", {}).items():
        stored = then.get("digests", {}).get(fidelity, {})
        for group in (g for g, digest in digests.items() if stored.get(g, digest) != digest):
            fidelities.setdefault(group, []).append(fidelity)
    for group, where in fidelities.items():
        found.append(group if len(where) > 1 else f"{group} at {where[0]} fidelity")
    return ", ".join(sorted(filter(None, found)))


def _changed(name: str, then: dict[str, float], now: dict[str, float]) -> str:
    """Lists the first changed values of one kind, and the number of the others."""
    if then.keys() != now.keys():
        return f"{name} (of other parts)"
    moved = [
        f"{name} of {part} {then[part]:g} -> {now[part]:g}"
        for part in now
        if not math.isclose(then[part], now[part], rel_tol=1e-6, abs_tol=10**-DECIMALS)
    ]
    more = f" and {len(moved) - SHOWN} more" if len(moved) > SHOWN else ""
    return ", ".join(moved[:SHOWN]) + more


def _values(robot: Robot) -> dict[str, dict[str, float]]:
    """The numbers that people tune, in SI units: name -> joint or body -> number."""
    model = robot.mj_model
    joints = model.actuator_trnid[:, 0]
    by_joint = {
        "kp": robot.kp,
        "kd": robot.kd,
        "effort limit": robot.effort_limit,
        "speed limit": robot.speed_limit,
        "lower limit": robot.joint_lower,
        "upper limit": robot.joint_upper,
        "home angle": robot.default_qpos[7:],
        "armature": model.dof_armature[model.jnt_dofadr[joints]],
    }
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    named = {name: zip(robot.joint_names, x, strict=True) for name, x in by_joint.items()}
    named["mass"] = zip(bodies, model.body_mass[1:], strict=True)
    return {
        name: {part: round(float(x), DECIMALS) for part, x in pairs}
        for name, pairs in named.items()
    }


def _digests(robot: Robot) -> dict[str, str]:
    """One checksum per group of the compiled model's numbers."""
    model = robot.mj_model
    touching = (model.geom_contype | model.geom_conaffinity) > 0
    touching[np.union1d(model.pair_geom1, model.pair_geom2).astype(int)] = True
    groups = {group: [getattr(model, f) for f in fields] for group, fields in _FIELDS.items()}
    groups["shapes"] = [getattr(model, f"geom_{name}")[touching] for name in _COLLISION]
    groups["solver"] = [np.asarray(getattr(model.opt, name)) for name in _OPTIONS]
    return {group: _digest(arrays) for group, arrays in groups.items()}


def _digest(arrays: list[np.ndarray]) -> str:
    """CRC-32 of arrays, rounded to `DECIMALS`, in hexadecimal."""
    crc = 0
    for array in arrays:
        rounded = np.round(np.asarray(array, np.float64), DECIMALS) + 0.0  # no -0
        crc = zlib.crc32(rounded.tobytes(), crc)
    return f"{crc:08x}"
