"""The robot: our MJCF of XBot-L, and everything the rest asks of it by name.

Two fidelities come from the one file: "train", where the soles meet the floor and the lower legs
each other, and "high", for evaluation: 1 ms, elliptic cones, converged solver, collision of all
parts, joint friction.
"""

import functools
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
"""Geom group of the feet's stand-ins in training, never drawn."""


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
        is_arm=np.array([name.split("_")[1] in ("shoulder", "elbow") for name in names]),
        base_body_id=model.body("base_link").id,
        foot_geom_ids=np.flatnonzero(model.geom_priority > 0),
        torso_box_center=box.pos.copy(),
        torso_box_half_size=box.size.copy(),
        total_mass=float(model.body_subtreemass[0]),
    )


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
    for stand_in in (*spec.pairs, *(g for g in spec.geoms if g.group == _BUMPER_GROUP)):
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


def mirror_joints() -> tuple[np.ndarray, np.ndarray]:
    """(permutation [16], sign [16]): q[permutation] * sign is the left-right mirrored joint vector.

    With this robot's axes, mirroring swaps the sides and negates every joint.
    """
    names = load().joint_names
    swap = {"left": "right", "right": "left"}
    partner = [swap[side] + "_" + rest for side, rest in (n.split("_", 1) for n in names)]
    return np.array([names.index(p) for p in partner]), -np.ones(len(names), np.float32)
