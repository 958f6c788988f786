"""The robot: loads our MJCF of XBot-L and reads static facts from the compiled model.

One file gives two models:

- "train": 5 ms steps. The soles touch the floor. Capsules keep the limbs and the trunk apart.
- "high", for evaluation: 1 ms steps, elliptic cones, a converged solver, collision of all parts,
  joint friction and damping.
"""

import functools
import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from kslc_jax import robots
from kslc_jax.config import Fidelity

MODEL_PATH = robots.XBOT_L

_FLOOR_BIT, _PART_BIT = 1, 2
_DECOR_GROUP = 1
"""Geom group of shapes that never collide."""
_BUMPER_GROUP = 5
"""Geom group of capsules that replace parts of other shapes in training; never drawn."""

PAIR_MARGIN = 0.012
"""Distance [m] below which two parts repel each other in training.

A policy uses all of the allowed space, and simulators differ a little. Without this margin policies
trip at high fidelity (docs/fidelity_physics.md)."""

PAIR_CONTACTS = 9
"""Contacts of each condim that MJX solves: those with the smallest distance.

All 9 contacts with friction fit: 8 sole spheres on the floor, and 1 pair of feet."""


@dataclass(frozen=True, eq=False)
class Robot:
    """Static facts of the robot, read from the compiled model. [16] is in action order."""

    mj_model: mujoco.MjModel
    name: str
    joint_names: tuple[str, ...]  # 16
    kp: np.ndarray  # [16] N m/rad
    kd: np.ndarray  # [16] N m s/rad
    effort_limit: np.ndarray  # [16] N m
    speed_limit: np.ndarray  # [16] rad/s
    joint_inertia: np.ndarray  # [16] kg m^2, 1 / diag(M^-1): home pose, no contact
    joint_lower: np.ndarray  # [16] rad
    joint_upper: np.ndarray  # [16] rad
    default_qpos: np.ndarray  # [23] home keyframe
    is_arm: np.ndarray  # [16] bool
    base_body_id: int
    link_body_ids: np.ndarray  # [17] the base, then the link after each joint
    hand_body_ids: np.ndarray  # [2] last link of each arm
    subtree: np.ndarray  # [B, B] 1 if body `column` is in the subtree of body `row`
    foot_geom_ids: np.ndarray  # sole spheres; at high fidelity also the foot boxes
    torso_box_center: np.ndarray  # [3] m, base frame
    torso_box_half_size: np.ndarray  # [3] m
    total_mass: float  # kg

    def sensor(self, name: str) -> slice:
        """Slice of the named sensor in `sensordata`. KeyError lists the known names."""
        slices = _sensor_slices(self)
        if name not in slices:
            raise KeyError(f"no sensor {name!r}; there are {', '.join(slices)}")
        return slices[name]


@functools.lru_cache(maxsize=32)
def _sensor_slices(robot: Robot) -> dict[str, slice]:
    m = robot.mj_model
    return {
        m.sensor(i).name: slice(int(m.sensor_adr[i]), int(m.sensor_adr[i] + m.sensor_dim[i]))
        for i in range(m.nsensor)
    }


@functools.lru_cache(maxsize=32)
def load(
    fidelity: Fidelity = "train",
    timestep: float | None = None,
    iterations: int | None = None,
    ls_iterations: int | None = None,
) -> Robot:
    """Compiles the robot's model and reads its facts (cached).

    Args:
      fidelity: "train" or "high".
      timestep: physics step [s]. None: default of the fidelity.
      iterations: Newton iterations of the contact solver. None: default of the fidelity.
      ls_iterations: line-search iterations. None: default of the fidelity.
    """
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    if fidelity == "high":
        _raise_fidelity(spec)
    else:
        _keep_parts_apart(spec)
    model = spec.compile()
    if fidelity == "high":
        for field in ("frictionloss", "damping"):
            getattr(model, f"dof_{field}")[6:] = model.numeric(f"high_{field}").data
    model.opt.timestep = timestep or model.opt.timestep
    model.opt.iterations = iterations or model.opt.iterations
    model.opt.ls_iterations = ls_iterations or model.opt.ls_iterations
    # A diverged simulation must show NaN. MuJoCo's automatic reset would hide it.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # motors.motor_torque applies the torque limits, which depend on joint speed. The engine must
    # not clamp again: C MuJoCo drops the implicit damping of a saturated actuator, MJX keeps it.
    model.actuator_forcelimited[:] = 0
    joints = model.actuator_trnid[:, 0]
    names = tuple(model.joint(j).name for j in joints)
    is_arm = np.array([name.split("_")[1] in ("shoulder", "elbow") for name in names])
    base, links = model.body("base_link").id, model.jnt_bodyid[joints]
    box = model.site("torso_box")
    return Robot(
        mj_model=model,
        name=spec.modelname,
        joint_names=names,
        kp=model.actuator_gainprm[:, 0].copy(),
        kd=-model.actuator_biasprm[:, 2],
        effort_limit=model.actuator_forcerange[:, 1].copy(),
        speed_limit=model.numeric("speed_limit").data.copy(),
        joint_inertia=_joint_inertia(model),
        joint_lower=model.jnt_range[joints, 0],
        joint_upper=model.jnt_range[joints, 1],
        default_qpos=model.keyframe("home").qpos.copy(),
        is_arm=is_arm,
        base_body_id=base,
        link_body_ids=np.append(base, links),
        hand_body_ids=np.setdiff1d(links[is_arm], model.body_parentid),
        subtree=_subtree(model),
        foot_geom_ids=np.flatnonzero(model.geom_priority > 0),
        torso_box_center=box.pos.copy(),
        torso_box_half_size=box.size.copy(),
        total_mass=float(model.body_subtreemass[0]),
    )


def _subtree(model: mujoco.MjModel) -> np.ndarray:
    """[B, B] float: 1 where the body of the column is in the subtree of the body of the row."""
    subtree = np.eye(model.nbody)
    for body in reversed(range(1, model.nbody)):  # children come after their parents
        subtree[model.body_parentid[body]] += subtree[body]
    return subtree


def _joint_inertia(model: mujoco.MjModel) -> np.ndarray:
    """[16] kg m^2, 1 / diag(M^-1) at the home pose without contact.

    It is the torque on one joint over its acceleration, while all other joints and the base are
    free to move.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.keyframe("home").id)
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return 1.0 / np.diag(inverse)[6:]


def _raise_fidelity(spec: mujoco.MjSpec) -> None:
    """Turns the training model into the evaluation model, in place."""
    spec.option.timestep = 0.001
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.iterations = 100
    spec.option.ls_iterations = 50
    spec.option.tolerance = 1e-10
    for stand_in in (g for g in spec.geoms if g.group == _BUMPER_GROUP):
        spec.delete(stand_in)
    sole = next(g for g in spec.geoms if g.priority > 0)
    friction, priority = sole.friction.copy(), sole.priority
    for geom in spec.geoms:
        if geom.priority > 0:  # the foot boxes replace the sole spheres
            geom.contype = 0
        elif geom.parent.name != "world" and geom.group != _DECOR_GROUP:
            geom.contype, geom.conaffinity = _FLOOR_BIT | _PART_BIT, _PART_BIT
        if geom.name in ("left_foot", "right_foot"):
            geom.friction, geom.priority = friction, priority


def _keep_parts_apart(spec: mujoco.MjSpec) -> None:
    """Adds contact pairs between parts that can touch at high fidelity, in place.

    One capsule represents each part. Parts of different limbs can touch, and parts of a limb can
    touch the trunk. Neighbours cannot, as at high fidelity. Only the pair of feet has friction,
    because friction between the feet makes the robot trip. All other pairs are frictionless: such a
    contact costs the solver one row instead of four.
    """
    capsules = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    parts = sorted((g for g in capsules if g.group != _DECOR_GROUP), key=lambda g: g.group)
    shapes = {g.parent.name: g for g in parts}  # a bumper comes last and replaces the part
    feet = {g.parent.name for g in spec.geoms if g.priority > 0}
    neighbours = {frozenset((e.bodyname1, e.bodyname2)) for e in spec.excludes}
    for (name, a), (other, b) in itertools.combinations(shapes.items(), 2):
        related = _limb(a.parent) == _limb(b.parent) or a.parent.name == b.parent.parent.name
        if related or frozenset((name, other)) in neighbours:
            continue
        spec.add_pair(
            geomname1=a.name,
            geomname2=b.name,
            condim=3 if {name, other} <= feet else 1,
            margin=PAIR_MARGIN,
        )
    spec.add_numeric(name="max_contact_points", data=[PAIR_CONTACTS])


def _limb(body: mujoco.MjsBody) -> str:
    """Name of the first body of the limb that `body` belongs to; for the trunk, its own name."""
    while body.parent.name != "world" and body.parent.parent.name != "world":
        body = body.parent
    return body.name


def mirror_joints() -> tuple[np.ndarray, np.ndarray]:
    """(permutation [16], sign [16]): q[permutation] * sign is the left-right mirrored joint vector.

    This robot's joint axes are such that mirroring swaps the sides and negates every joint.
    """
    names = load().joint_names
    swap = {"left": "right", "right": "left"}
    partner = [swap[side] + "_" + rest for side, rest in (n.split("_", 1) for n in names)]
    return np.array([names.index(p) for p in partner]), -np.ones(len(names), np.float32)
