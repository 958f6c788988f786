"""The checks of a robot, in their order, and their results as text."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from kslc_jax import observations, physics, robot, similar
from kslc_jax.checkup import findings, picture, statics, trials
from kslc_jax.checkup.findings import Finding, Patient
from kslc_jax.config import PhysicsConfig, TerrainConfig
from kslc_jax.robot import Robot
from kslc_jax.robots import build, description
from kslc_jax.robots.build import SIDES

PLAIN_WIDTH = 110
"""Characters in a line where the output is no terminal."""

STRAIGHT = 0.99
"""Least component of an axis that is written as x, y or z."""


def check(name: str, out: Path | None, engines: bool) -> None:
    """Prints all that is known of a robot, and what looks wrong.

    Args:
      name: a shipped robot, or the path of a description.
      out: file of the picture; None: no picture.
      engines: also compare MJX with C MuJoCo, which compiles for a minute.

    Raises:
      RobotError: the robot cannot be used.
    """
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = PLAIN_WIDTH
    x = patient(name)
    console.print(geometry(x.train), motors(x.train), facts(x))
    if out:
        picture.draw(x.high, out)
        console.print(f"picture: {escape(str(out))}")
    found = [finding for look in findings.STATIC for finding in look(x)]
    found += _try(console, x)
    if engines:
        found += _compare(console, _on_flat(x.config.physics))
    console.print(verdict(found))


def patient(name: str) -> Patient:
    """The robot of this name or description, with the physics step of its laptop preset."""
    config = similar.preset("laptop", name)
    high = robot.load("high", name=config.physics.robot)
    return Patient(physics.robot_for(_on_flat(config.physics)), high, config)


def _on_flat(config: PhysicsConfig) -> PhysicsConfig:
    return dataclasses.replace(config, terrain=TerrainConfig())


def _try(console: Console, x: Patient) -> Iterator[Finding]:
    """Prints what short simulations show."""
    falls = [trials.fall_time(each) for each in (x.train, x.high)]
    said = ("stands" if math.isinf(t) else f"falls after {t:.1f} s" for t in falls)
    training, high = said
    console.print(
        f"{trials.STAND_SECONDS:g} s without a policy: {training} in training, {high} at high "
        "fidelity"
    )
    sag = np.abs(trials.sag(x.train))
    worst = x.train.joint_names[int(sag.argmax())]
    console.print(f"hung in the air, joints sag by up to {sag.max():.3f} rad ({escape(worst)})")
    missed, there = statics.unfelt(x.train, x.high)
    console.print(
        f"{statics.POSES} random poses: {there} contacts of two limbs, training feels "
        f"{there - missed} of them"
    )
    yield from findings.contacts(missed, there)
    yield from findings.passive(falls[0], trials.STAND_SECONDS)


def _compare(console: Console, config: PhysicsConfig) -> Iterator[Finding]:
    """Prints how far apart the engines are."""
    console.print("compiling MJX, a minute or more; --no-engines leaves it out")
    apart = trials.engines_apart(config)
    console.print(f"engines: {apart:.0e} rad apart after {trials.AGREEMENT_STEPS} control steps")
    yield from findings.engines(apart)


def verdict(found: list[Finding]) -> Table | str:
    """The faults that were found, one line each."""
    if not found:
        return "\n[green]nothing looks wrong"
    table = _table(f"{len(found)} things look wrong" if len(found) > 1 else "one thing looks wrong")
    for column in ("field to change", "what looks wrong"):
        table.add_column(column, overflow="fold")
    for finding in found:
        table.add_row(escape(finding.field), escape(finding.text))
    return table


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))


# ---------------------------------------------------------------------------------------- derived


def geometry(it: Robot) -> Table:
    """Joints in the order of the actions, with what was found out about them."""
    table = _table(f"{it.name}: {it.count} joints, angles in rad")
    for column in ("#", "joint", "part", "axis", "home", "range", "mirror"):
        table.add_column(column, justify="right" if column == "home" else "left")
    for row in geometry_rows(it):
        table.add_row(*map(escape, row))
    return table


def geometry_rows(it: Robot) -> list[tuple[str, ...]]:
    """Cells of `geometry`. "mirror" is the number of the partner and the sign of its angle."""
    body, home = it.anatomy, it.default_qpos[7:]
    data = statics.posed(it, it.default_qpos)
    part = dict.fromkeys(range(it.count), "-")
    for limb, joints in body.limbs.items():
        part |= dict.fromkeys(joints, limb)
    part |= {joint: role for role, joint in body.roles.items()}
    return [
        (
            str(i),
            name,
            part[i].replace("_", " "),
            axis_name(data.xaxis[1 + i]),
            f"{home[i]:.2f}",
            f"{it.joint_lower[i]:.2f} to {it.joint_upper[i]:.2f}",
            f"{body.permutation[i]} {'+' if body.sign[i] > 0 else '-'}",
        )
        for i, name in enumerate(it.joint_names)
    ]


def axis_name(axis: np.ndarray) -> str:
    """ "y", "-x", or the components of an axis [3] that has none of these directions."""
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) >= STRAIGHT:
        return f"{'-' if axis[k] < 0 else ''}{'xyz'[k]}"
    return " ".join(f"{part + 0.0:.2f}" for part in axis)


def motors(it: Robot) -> Table:
    """Motors in the order of the actions."""
    table = _table("motors, in SI units; standing: torque at home")
    for column in ("#", "joint", "kp", "kd", "effort", "speed", "armature", "standing", "sag"):
        table.add_column(column, justify="left" if column in ("#", "joint") else "right")
    for row in motor_rows(it):
        table.add_row(*map(escape, row))
    return table


def motor_rows(it: Robot) -> list[tuple[str, ...]]:
    """Cells of `motors`. "sag" [rad] is the torque that standing takes over kp."""
    standing = statics.standing_torque(it)
    inertia = it.mj_model.dof_armature[6:]
    columns = (it.kp, it.kd, it.effort_limit, it.speed_limit, inertia)
    return [
        (
            str(i),
            name,
            *(f"{column[i]:g}" for column in columns),
            f"{standing[i] + 0.0:.1f}",
            f"{abs(standing[i]) / it.kp[i]:.2f}",
        )
        for i, name in enumerate(it.joint_names)
    ]


def facts(x: Patient) -> Table:
    """Sizes, contacts, observations, and numbers of the preset."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in fact_rows(x):
        table.add_row(name, escape(value))
    return table


def fact_rows(x: Patient) -> list[tuple[str, str]]:
    """Names and values of `facts`."""
    it, config = x.train, x.config
    model, size = it.mj_model, "{:.3f} m, {:.2f} of XBot-L's"
    sole = statics.sole_size(it, "left")
    count, parts = model.npair, len(set(model.pair_geom1) | set(model.pair_geom2))
    widths = observations.actor_width(it), observations.critic_width(it, config.env.critic_memory)
    base, trunk = model.body(it.anatomy.base).name, it.trunk_body_id
    tilted = build.straightened(description.read(config.physics.robot))
    told = f"upright, with the keyframe's joint angles; there it is tilted by {tilted:.2f} rad"
    return [("base", told)] * (tilted > 0) + [
        ("mass", f"{it.total_mass:.1f} kg, {it.mass_ratio:.2f} of XBot-L's"),
        ("standing height", size.format(it.stand_height, it.length_ratio) + f" ({base})"),
        ("trunk", f"{model.body(trunk).name}, {model.body_mass[trunk]:.1f} kg"),
        (
            "soles",
            f"{2 * sole[0]:.3f} m x {2 * sole[1]:.3f} m, {it.sole_drop:.3f} m below the ankle, "
            f"{tilt(it):.1f} degrees from level",
        ),
        ("ankles", f"stiffness {statics.ankle_share(it):.2f} m g h"),
        ("feet, knees apart", f"{it.feet_apart:.3f} m, {it.knees_apart:.3f} m"),
        ("contacts in training", f"{count} pairs of {parts} parts, and the soles"),
        ("observations", f"actor {widths[0]}, critic {widths[1]}"),
        (
            "laptop preset",
            f"gait cycle {config.gait.cycle_time:g} s, commands up to "
            f"{config.curriculum.v_limit:g} m/s",
        ),
        (
            "feet lift",
            f"{statics.foot_lift(config, it):.3f} m in the reference motion, target "
            f"{config.rewards.clearance_target:.3f} m",
        ),
    ]


def tilt(it: Robot) -> float:
    """Largest angle [degrees] of a sole to the ground at home."""
    data: mujoco.MjData = statics.posed(it, it.default_qpos)
    up = [data.site(f"{side}_foot").xmat[8] for side in SIDES]
    return float(np.degrees(np.arccos(np.clip(up, -1, 1))).max())
