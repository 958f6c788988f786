"""The robot: our MJCF of XBot-L, and everything the rest asks of it by name.

Two fidelities come from the one file: "train", where the soles meet the floor and capsules keep the
limbs and the trunk apart, and "high", for evaluation: 1 ms, elliptic cones, converged solver,
collision of all parts, joint friction.
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
"""Geom group of capsules that stand for a part of another shape in training, never drawn."""

PAIR_MARGIN = 0.012
"""Distance [m] at which two parts already push each other away in training. Policies go to the very
limit, and simulators differ; without it they trip at high fidelity (docs/fidelity.md)."""

PAIR_CONTACTS = 9
"""Contacts of each kind that MJX solves for: the nearest. The soles and the feet have
9 with friction."""


@dataclass(frozen=True, eq=False)
class Robot:
    """Static facts of the robot, read back from the compiled model. [16] is in action order."""

    mj_model: mujoco.MjModel
    name: str
    joint_names: tuple[str, ...]  # 16
    kp: np.ndarray  # [16] N m/rad
    kd: np.ndarray  # [16] N m s/rad
    effort_limit: np.ndarray  # [16] N m
    speed_limit: np.ndarray  # [16] rad/s
    joint_inertia: np.ndarray  # [16] kg m^2, of each joint alone at home in the air
    joint_lower: np.ndarray  # [16] rad
    joint_upper: np.ndarray  # [16] rad
    default_qpos: np.ndarray  # [23] the home keyframe
    is_arm: np.ndarray  # [16] bool
    base_body_id: int
    link_body_ids: np.ndarray  # [17] the base, then the link after each joint
    hand_body_ids: np.ndarray  # the last link of each arm
    subtree: np.ndarray  # [B, B] 1 where a body (column) is part of a body's subtree (row)
    foot_geom_ids: np.ndarray  # geoms that meet the floor under the feet
    torso_box_center: np.ndarray  # [3] m, base frame
    torso_box_half_size: np.ndarray  # [3] m
    total_mass: float  # kg

    def sensor(self, name: str) -> slice:
        """Where the named sensor lies in sensordata; KeyError lists the names."""
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
    """Compiles the robot (cached).

    Args:
      fidelity: "train" or "high".
      timestep: physics step [s]; the fidelity's own if None.
      iterations: Newton iterations of the contact solver; the fidelity's own if None.
      ls_iterations: line-search iterations; the fidelity's own if None.
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
    # A diverged simulation must show as NaN, not restart behind our back.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # Torque limits depend on joint speed and are applied in motors.motor_torque. The engine must
    # not clamp as well: C MuJoCo drops the implicit damping of a saturated actuator, MJX keeps it.
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
    """[B, B] float: 1 where the column's body is part of the subtree of the row's body."""
    subtree = np.eye(model.nbody)
    for body in reversed(range(1, model.nbody)):  # children come after their parents
        subtree[model.body_parentid[body]] += subtree[body]
    return subtree


def _joint_inertia(model: mujoco.MjModel) -> np.ndarray:
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
        if geom.priority > 0:  # the foot boxes take the place of the sole spheres
            geom.contype = 0
        elif geom.parent.name != "world" and geom.group != _DECOR_GROUP:
            geom.contype, geom.conaffinity = _FLOOR_BIT | _PART_BIT, _PART_BIT
        if geom.name in ("left_foot", "right_foot"):
            geom.friction, geom.priority = friction, priority


def _keep_parts_apart(spec: mujoco.MjSpec) -> None:
    """Adds a contact pair for every two parts that can meet at high fidelity, in place.

    One capsule stands for each part. Parts of different limbs meet, and those of a limb meet the
    trunk; neighbours do not, as at high fidelity. The feet rub, because feet that brush past each
    other trip by friction. All other pairs are smooth: such a contact costs the solver one row
    instead of four.
    """
    capsules = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    parts = sorted((g for g in capsules if g.group != _DECOR_GROUP), key=lambda g: g.group)
    shapes = {g.parent.name: g for g in parts}  # a bumper comes last and takes the part's place
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
    """Name of the first body of the limb that `body` belongs to; the trunk's own for the trunk."""
    while body.parent.name != "world" and body.parent.parent.name != "world":
        body = body.parent
    return body.name


def mirror_joints() -> tuple[np.ndarray, np.ndarray]:
    """(permutation [16], sign [16]): q[permutation] * sign is the left-right mirrored joint vector.

    With this robot's axes, mirroring swaps the sides and negates every joint.
    """
    names = load().joint_names
    swap = {"left": "right", "right": "left"}
    partner = [swap[side] + "_" + rest for side, rest in (n.split("_", 1) for n in names)]
    return np.array([names.index(p) for p in partner]), -np.ones(len(names), np.float32)
