"""The fingerprint of a robot: the numbers of its description and model.

A training depends on them, on its config and on the code. Every checkpoint and every policy stores
them. If the robot changes later, a message names the changed numbers. Values that people tune are
stored as numbers. The rest of the compiled model is stored as one checksum per group and fidelity.
"""

import math
import zlib
from typing import Any

import mujoco
import numpy as np

from kslc_jax import robot as robot_lib
from kslc_jax.config import Fidelity
from kslc_jax.robot import Robot
from kslc_jax.robots.shapes import mesh_data

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
    "sizes of sites": ("site_size",),
    "springs and reference angles": ("qpos0", "qpos_spring", "jnt_stiffnesspoly"),
    "nonlinear damping": ("dof_dampingpoly",),
    "softness of joints": (
        *("dof_solref", "dof_solimp", "jnt_solref", "jnt_solimp", "jnt_margin", "jnt_limited"),
    ),
    "actuators": ("actuator_gear", "actuator_dyntype", "actuator_gaintype", "actuator_biastype"),
    "equalities and tendons": (
        *("eq_type", "eq_obj1id", "eq_obj2id", "eq_data", "eq_solref", "eq_solimp", "eq_active0"),
        *("tendon_range", "tendon_stiffness", "tendon_damping", "tendon_frictionloss"),
        *("tendon_lengthspring", "tendon_solref_lim", "tendon_solimp_lim", "wrap_objid"),
        *("wrap_prm",),
    ),
    "gravity compensation": ("body_gravcomp",),
    "adhesion": ("geom_adhesion", "pair_adhesion"),
    "objects of actuators and sensors": (
        *("actuator_trnid", "actuator_trntype", "sensor_reftype", "sensor_refid", "sensor_dim"),
    ),
}
"""Groups of the compiled model's arrays. An older MuJoCo may lack an array. Do not change a group:
add another one, because checkpoints store the checksums."""

_COLLISION = (
    *("bodyid", "type", "size", "pos", "quat", "friction", "condim", "contype", "conaffinity"),
    *("priority", "margin", "gap", "solref", "solimp", "solmix"),
)
"""Arrays `geom_NAME` of the geoms that can touch something."""

_OPTIONS = ("gravity", "integrator", "cone", "solver", "impratio", "tolerance", "disableflags")
"""Options of the simulation as the robot's file has them. `PhysicsConfig` contains the cone, too,
since the presets have elliptic ones."""

_MORE_OPTIONS = ("wind", "density", "viscosity", "ls_tolerance", "enableflags", "ccd_tolerance")
"""Further options. Older checkpoints do not have this group."""

_REST_OF_OPTIONS = (
    *("noslip_iterations", "noslip_tolerance", "ccd_iterations", "jacobian"),
    *("magnetic", "o_margin", "o_solref", "o_solimp", "o_friction", "sdf_iterations"),
    *("sdf_initpoints", "sleep_tolerance", "disableactuator"),
)
"""The options that the two groups above lack. An older MuJoCo may lack one."""


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
    none = np.zeros(0)
    groups = {group: [getattr(model, f, none) for f in fields] for group, fields in _FIELDS.items()}
    groups["shapes"] = [getattr(model, f"geom_{name}")[touching] for name in _COLLISION]
    groups["meshes"] = [_vertices(model, geom) for geom in np.flatnonzero(touching)]
    groups["solver"] = [np.asarray(getattr(model.opt, name)) for name in _OPTIONS]
    groups["further options"] = [np.asarray(getattr(model.opt, name)) for name in _MORE_OPTIONS]
    groups["rest of the options"] = [
        np.asarray(getattr(model.opt, name, none)) for name in _REST_OF_OPTIONS
    ]
    heights = [robot.stand_height, robot.sole_drop, *robot.default_qpos[:7]]
    groups["measures"] = [np.array(heights), robot.hand_points]
    return {group: _digest(arrays) for group, arrays in groups.items()}


def _vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """[k, 3] vertices of a geom's mesh; empty for other shapes."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.zeros((0, 3))
    return mesh_data(model, int(model.geom_dataid[geom]))[0]


def _digest(arrays: list[np.ndarray]) -> str:
    """CRC-32 of arrays, rounded to `DECIMALS`, in hexadecimal."""
    crc = 0
    for array in arrays:
        rounded = np.round(np.asarray(array, np.float64), DECIMALS) + 0.0  # no -0
        crc = zlib.crc32(rounded.tobytes(), crc)
    return f"{crc:08x}"
