"""Description and MJCF -> the training model or the evaluation model, as an MjSpec.

An MJCF of ours (`prepared`) has all that the package reads by name. Any other MJCF gets it here:
its bodies and joints are rebuilt on XBot-L's floor (skeleton.py), with soles of four spheres
(soles.py), sites, sensors and servos. In training one capsule stands for each part (capsules.py).
At high fidelity the MJCF's own shapes collide.
"""

import functools
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from kslc_jax.robots import capsules, contacts, description, servos, shapes, skeleton, soles
from kslc_jax.robots.anatomy import Anatomy, study
from kslc_jax.robots.description import Description, Motor, RobotError
from kslc_jax.robots.skeleton import Source
from kslc_jax.robots.soles import Sole

CLEARANCE = 0.0731
"""Height of the soles above the ground at the start of an episode, as a share of the standing
height. The value is XBot-L's: its soles begin 6.5 cm above the ground."""

TOUCH_BORDER = 0.008
"""The site of the touch sensor is larger than the sole by this length [m] on each side."""

TOUCH_HEIGHT = 0.012
"""Half the height [m] of the site of the touch sensor, which is centred on the sole."""

SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class Rig:
    """A robot under construction: the spec has its bodies and joints, but no shapes and sensors."""

    spec: mujoco.MjSpec
    source: Source
    bodies: list[int]  # the source's body per body of the spec, without the world
    bare: mujoco.MjModel  # the spec so far, compiled
    anatomy: Anatomy  # of `bare`
    soles: tuple[Sole, Sole]
    stand_height: float  # m, the base's origin above the soles at home

    def body(self, body: int) -> mujoco.MjsBody:
        """The spec's body of an id in `bare`."""
        return self.spec.body(self.bare.body(body).name)

    def points(self, bodies: list[int]) -> np.ndarray:
        """[k, 3] points on the shapes of bodies of `bare`, world at home [m]."""
        return shapes.surface(self.source, self._shapes(bodies))

    def collides(self, bodies: list[int]) -> bool:
        """True if a shape of these bodies of `bare` collides in the MJCF."""
        return bool(shapes.collides(self.source.model)[self._shapes(bodies)].any())

    def _shapes(self, bodies: list[int]) -> list[int]:
        return shapes.of_bodies(self.source, [self.bodies[body - 1] for body in bodies])


def spec(about: Description, fidelity: Literal["train", "high"]) -> mujoco.MjSpec:
    """The model of a robot, ready to be compiled.

    Raises:
      RobotError: the MJCF or the description cannot be used; one line says how to mend it.
    """
    make = _prepared if about.prepared else _derived
    try:
        return make(about, _compiled(about.mjcf, changed_at(about)), fidelity == "high")
    except RobotError as error:
        known = str(error).startswith((str(about.path), str(about.mjcf)))
        raise (error if known else RobotError(f"{about.path}: {error}")) from None


def changed_at(about: Description) -> int:
    """When the description, its MJCF or a file that the MJCF names last changed [ns since 1970]."""
    try:
        files = mujoco.mju_getXMLDependencies(str(about.mjcf))
    except mujoco.FatalError:  # no XML
        files = [about.mjcf]
    found = (Path(file) for file in (about.path, *files))
    return max(file.stat().st_mtime_ns for file in found if file.exists())


def straightened(about: Description) -> float:
    """Angle [rad] by which the MJCF's keyframe tilts the base, which is upright here; else 0."""
    if about.prepared:
        return 0.0
    return skeleton.tilt(about, _compiled(about.mjcf, changed_at(about)))


@functools.lru_cache(maxsize=2)
def _compiled(mjcf: Path, changed: int) -> mujoco.MjModel:
    """An MJCF as it is (cached, because meshes take seconds); `changed` is of `changed_at`."""
    try:
        return mujoco.MjModel.from_xml_path(str(mjcf))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotError(f"{mjcf}: {' '.join(str(error).split())}") from None


def _prepared(about: Description, model: mujoco.MjModel, high: bool) -> mujoco.MjSpec:
    """The model of an MJCF of ours."""
    made = mujoco.MjSpec.from_file(str(about.mjcf))
    given = {"home": about.home, "weld": about.weld, "keyframe": about.keyframe}
    if wrong := [field for field, value in given.items() if value]:
        raise RobotError(
            f"{wrong[0]}: not with prepared = true; change the MJCF's keyframe instead"
        )
    if about.stand_height is None or about.sole_drop is None:
        raise RobotError("prepared = true needs stand_height and sole_drop")
    (contacts.raise_prepared if high else contacts.train_prepared)(made)
    motors = servos.motors(about, model, list(range(1, model.njnt)))
    _finish(made, motors, high, about.stand_height, about.sole_drop)
    return made


def _finish(
    made: mujoco.MjSpec, motors: list[Motor], high: bool, stand_height: float, sole_drop: float
) -> None:
    """Adds the servos and the numbers that callers read by name."""
    servos.add_servos(made, motors, high)
    made.add_numeric(name="stand_height", data=[stand_height])
    made.add_numeric(name="sole_drop", data=[sole_drop])


def _derived(about: Description, model: mujoco.MjModel, high: bool) -> mujoco.MjSpec:
    """The model of any other MJCF."""
    source = skeleton.at_home(about, model)
    motors = servos.motors(about, model, source.joints)
    made, sun, box = _stage(about.name)
    rig = _assemble(made, source)
    base = rig.body(rig.anatomy.base)
    base.add_light(**sun)
    stand_height = about.stand_height or rig.stand_height
    sizes = {field: share * stand_height for field, share in box.items()}
    base.add_site(name="torso_box", **sizes, **_HIDDEN_BOX)
    base.add_site(name="imu", size=[0.01] * 3, group=4)
    _add_soles(rig, high)
    (_add_shapes if high else _add_capsules)(rig)
    _add_sensors(rig)
    _add_home(rig)
    _finish(made, motors, high, stand_height, about.sole_drop or _sole_drop(rig))
    return made


_HIDDEN_BOX = {"type": mujoco.mjtGeom.mjGEOM_BOX, "rgba": [0, 0, 0, 0], "group": 4}


def _stage(name: str) -> tuple[mujoco.MjSpec, dict[str, object], dict[str, np.ndarray]]:
    """XBot-L's MJCF without the robot: floor, sky, camera, solver and classes of shapes.

    Returns also XBot-L's light, and the place and half size of its torso box as shares of its
    standing height. An episode ends when this box touches the ground.
    """
    xbot = description.read("xbot_l")
    assert xbot.stand_height
    made = mujoco.MjSpec.from_file(str(xbot.mjcf))
    lamp, box = made.lights[0], made.site("torso_box")
    fields = ("name", "mode", "type", "pos", "dir", "diffuse")
    sun = {
        field: np.copy(x) if hasattr(x := getattr(lamp, field), "shape") else x for field in fields
    }
    place = {"pos": box.pos / xbot.stand_height, "size": box.size / xbot.stand_height}
    made.delete(made.worldbody.first_body())
    for leftover in (*made.keys, *made.numerics):
        made.delete(leftover)
    made.modelname = name
    return made, sun, place


def _assemble(made: mujoco.MjSpec, source: Source) -> Rig:
    """Adds bodies and joints to the stage and studies them."""
    bodies = list(skeleton.grow(made, source))
    bare = made.compile()
    anatomy = study(bare, np.concatenate([[0, 0, 0, 1, 0, 0, 0], source.angles]))
    found = []
    for side, foot in zip(SIDES, anatomy.feet, strict=True):
        ankle = anatomy.roles[f"{side}_ankle"]
        points = shapes.surface(source, shapes.of_bodies(source, [bodies[foot - 1]]))
        pitch, joint = float(anatomy.pitch[ankle]), source.names[ankle]
        found.append(soles.find(points, joint, pitch, source.straightened))
    left, right = found
    stand_height = -min(left.centre[2], right.centre[2])
    return Rig(made, source, bodies, bare, anatomy, (left, right), float(stand_height))


def _add_soles(rig: Rig, high: bool) -> None:
    """Adds four spheres per foot, which touch the floor in training, and sites of touch sensors."""
    sphere = rig.spec.find_default("sole")
    radius = float(sphere.geom.size[0])
    for side, foot, sole in zip(SIDES, rig.anatomy.feet, rig.soles, strict=True):
        body, own = rig.body(foot), rig.bodies[foot - 1]
        for corner, place in sole.corners(radius, radius).items():
            pos = rig.source.local(own, place)
            new = body.add_geom(sphere, name=f"{side}_{corner}", pos=pos)
            new.contype = 0 if high else new.contype
        size = [sole.half_length + TOUCH_BORDER, sole.half_width + TOUCH_BORDER, TOUCH_HEIGHT]
        quat = rig.source.turn(own, sole.rotation)
        pos = rig.source.local(own, sole.centre)
        body.add_site(name=f"{side}_foot", pos=pos, quat=quat, size=size, **_HIDDEN_BOX)


def _add_capsules(rig: Rig) -> None:
    """Adds one capsule per part, and the contact pairs of training."""
    members = capsules.parts(rig.bare, rig.anatomy)
    clouds = {name: rig.points(bodies) for name, bodies in members.items()}
    for side in SIDES:  # at high fidelity only those shapes collide that collide in the MJCF
        if rig.collides(members[f"{side}_thigh"]) and not rig.collides(members[f"{side}_hip"]):
            del clouds[f"{side}_hip"]
    fitted = capsules.slim(capsules.fit_all(clouds))
    style = rig.spec.find_default("bumper")
    for name, capsule in fitted.items():
        body = members[name][0]
        own = rig.bodies[body - 1]
        ends = [rig.source.local(own, end) for end in (capsule.start, capsule.end)]
        rig.body(body).add_geom(
            style,
            name=capsules.geom_name(name),
            fromto=np.concatenate(ends),
            size=[capsule.radius, 0, 0],
        )
    free = [
        pair
        for pair in capsules.strangers(list(fitted))
        if capsules.gap(fitted[pair[0]], fitted[pair[1]]) >= 0
    ]
    barred = {
        frozenset(map(capsules.geom_name, pair))
        for pair in itertools.combinations(fitted, 2)
        if pair not in free
    }
    contacts.keep_parts_apart(rig.spec, [capsules.part(name) for name in fitted], barred)


def _add_shapes(rig: Rig) -> None:
    """Adds the MJCF's shapes. Those that collide in the MJCF collide, and so do the feet."""
    contacts.high_options(rig.spec)
    source, sole = rig.source, rig.spec.find_default("sole").geom
    feet = shapes.of_each(source, [rig.bodies[foot - 1] for foot in rig.anatomy.feet])
    colliding = set(np.flatnonzero(shapes.collides(source.model)).tolist()) | feet
    carrier = source.carrier[source.model.geom_bodyid]
    for body, own in enumerate(rig.bodies, start=1):
        for geom in np.flatnonzero(carrier == own).tolist():
            new = shapes.copy(rig.spec, rig.body(body), source, geom)
            if geom in colliding:
                new.contype = contacts.FLOOR_BIT | contacts.PART_BIT
                new.conaffinity = contacts.PART_BIT
            if geom in feet:
                new.friction, new.priority = sole.friction, sole.priority
    names = {own: rig.bare.body(body).name for body, own in enumerate(rig.bodies, start=1)}
    for a, b in sorted(shapes.excluded(source) | shapes.touching(source, colliding)):
        rig.spec.add_exclude(bodyname1=names[a], bodyname2=names[b])


def _add_sensors(rig: Rig) -> None:
    """Adds the sensors of XBot-L's MJCF."""
    kind, thing = mujoco.mjtSensor, mujoco.mjtObj
    base = rig.bare.body(rig.anatomy.base).name
    sensors = [
        ("base_quat", kind.mjSENS_FRAMEQUAT, thing.mjOBJ_XBODY, base),
        ("base_linvel", kind.mjSENS_VELOCIMETER, thing.mjOBJ_SITE, "imu"),
        ("base_gyro", kind.mjSENS_GYRO, thing.mjOBJ_SITE, "imu"),
        ("com", kind.mjSENS_SUBTREECOM, thing.mjOBJ_BODY, base),
        ("angmom", kind.mjSENS_SUBTREEANGMOM, thing.mjOBJ_BODY, base),
    ]
    for side, foot in zip(SIDES, rig.anatomy.feet, strict=True):
        ankle = rig.bare.body(foot).name
        knee = rig.bare.body(rig.bare.jnt_bodyid[1 + rig.anatomy.roles[f"{side}_knee"]]).name
        sensors += [
            (f"{side}_foot_pos", kind.mjSENS_FRAMEPOS, thing.mjOBJ_XBODY, ankle),
            (f"{side}_foot_zaxis", kind.mjSENS_FRAMEZAXIS, thing.mjOBJ_SITE, f"{side}_foot"),
            (f"{side}_foot_linvel", kind.mjSENS_FRAMELINVEL, thing.mjOBJ_XBODY, ankle),
            (f"{side}_knee_pos", kind.mjSENS_FRAMEPOS, thing.mjOBJ_XBODY, knee),
            (f"{side}_foot_touch", kind.mjSENS_TOUCH, thing.mjOBJ_SITE, f"{side}_foot"),
        ]
    for name, sensor, objtype, objname in sensors:
        rig.spec.add_sensor(name=name, type=sensor, objtype=objtype, objname=objname)


def _add_home(rig: Rig) -> None:
    """Adds the home keyframe: upright, with the soles a little above the ground."""
    height = rig.stand_height * (1 + CLEARANCE)
    rig.body(rig.anatomy.base).pos = [0, 0, height]
    angles = rig.source.angles
    rig.spec.add_key(name="home", qpos=[0, 0, height, 1, 0, 0, 0, *angles])


def _sole_drop(rig: Rig) -> float:
    """Mean height [m] of the feet's frames above their soles."""
    places = rig.source.data.xpos[[rig.bodies[foot - 1] for foot in rig.anatomy.feet]]
    return float(
        np.mean([z - sole.centre[2] for z, sole in zip(places[:, 2], rig.soles, strict=True)])
    )
