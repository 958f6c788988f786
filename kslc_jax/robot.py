"""A robot: compiles its model and reads static facts from it.

One description gives two models:

- "train": 5 ms steps. The soles touch the floor. Capsules keep the limbs and the trunk apart.
- "high", for evaluation: 1 ms steps, elliptic cones, a converged solver, collision of all parts,
  joint friction and damping.
"""

import functools
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from kslc_jax import ground
from kslc_jax.config import XBOT_L, Cone, Fidelity, TerrainConfig
from kslc_jax.robots import anatomy, build, description, floors
from kslc_jax.robots.anatomy import Anatomy

SOLE_RISE = 0.02
"""Height that a sole's contact point gains per distance that it moves inwards. Half a millimetre
decides which points of a flat foot carry the load."""


_CONES = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}


@dataclass(frozen=True, eq=False)
class Robot:
    """Static facts of a robot, read from the compiled model. [n] is in action order."""

    mj_model: mujoco.MjModel
    name: str
    joint_names: tuple[str, ...]  # n
    kp: np.ndarray  # [n] N m/rad
    kd: np.ndarray  # [n] N m s/rad
    effort_limit: np.ndarray  # [n] N m
    speed_limit: np.ndarray  # [n] rad/s
    joint_inertia: np.ndarray  # [n] kg m^2, 1 / diag(M^-1): home pose, no contact
    joint_lower: np.ndarray  # [n] rad
    joint_upper: np.ndarray  # [n] rad
    default_qpos: np.ndarray  # [7 + n] home keyframe
    anatomy: Anatomy
    trunk_body_id: int  # heaviest body outside the limbs; carries the payload
    joint_body_ids: np.ndarray  # [n] the link that each joint moves
    link_body_ids: np.ndarray  # [L] the base, then every link with a joint, each once
    hand_body_ids: np.ndarray  # [2] last link of each arm; [0] for a robot without arms
    hand_points: np.ndarray  # [2, 3] m, centre of each hand, frame of its link
    subtree: np.ndarray  # [B, B] 1 if body `column` is in the subtree of body `row`
    foot_geom_ids: np.ndarray  # sole spheres; at high fidelity also the foot boxes
    sole_geom_ids: np.ndarray  # [k] sole spheres
    sole_inward: np.ndarray  # [k, 3] direction from each sphere to its sole's middle, see _inward
    terrain: TerrainConfig | None  # uneven ground; None: the flat floor
    ground_geom_ids: np.ndarray  # what moves with uneven ground: a plane per sphere, or the floor
    torso_box_center: np.ndarray  # [3] m, base frame
    torso_box_half_size: np.ndarray  # [3] m
    total_mass: float  # kg
    stand_height: float  # m, base above the soles at home
    sole_drop: float  # m, frame of a foot above its sole
    feet_apart: float  # m, distance of the feet at home
    knees_apart: float  # m, distance of the knees at home
    mass_ratio: float  # total mass by XBot-L's
    length_ratio: float  # standing height by XBot-L's
    files_changed: int  # ns since 1970, see build.changed_at

    @property
    def count(self) -> int:
        """Number n of joints."""
        return len(self.joint_names)

    @property
    def is_arm(self) -> np.ndarray:
        """[n] bool, True for joints of the arms."""
        return self.anatomy.is_arm

    @property
    def reference_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit [n] of the joint angles, measured from the home pose [rad]."""
        home = self.default_qpos[7:]
        return self.joint_lower - home, self.joint_upper - home

    @property
    def foot_shapes(self) -> tuple[np.ndarray, ...]:
        """Ids of the geoms that collide, of the left and of the right foot.

        At high fidelity they are the foot's own shapes, in training its sole spheres, too.
        """
        model = self.mj_model
        colliding = (model.geom_contype | model.geom_conaffinity) > 0
        left, right = self.anatomy.feet
        return tuple(np.flatnonzero(colliding & (model.geom_bodyid == f)) for f in (left, right))

    def roll_and_yaw(self, side: str) -> list[int]:
        """Joints of the hip of one side that turn about x and z; a leg may lack one."""
        names = f"{side}_hip_roll", f"{side}_hip_yaw"
        return [self.anatomy.roles[name] for name in names if name in self.anatomy.roles]

    def sensor(self, name: str) -> slice:
        """Slice of the named sensor in `sensordata`. KeyError lists the known names."""
        slices = _sensor_slices(self)
        if name not in slices:
            raise KeyError(f"no sensor {name!r}; there are {', '.join(slices)}")
        return slices[name]

    def soles(self, what: Literal["pos", "vel"]) -> slice:
        """Slice of the positions, or velocities, [k, 3] of all sole spheres in `sensordata`.

        Only the training model with uneven ground has these sensors.
        """
        first = self.sensor(f"sole_{what}_0")
        return slice(first.start, first.start + 3 * len(self.ground_geom_ids))


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
    cone: Cone | None = None,
    name: str = XBOT_L,
    terrain: TerrainConfig | None = None,
) -> Robot:
    """Compiles a robot's model and reads its facts (cached: a training keeps its robot).

    Args:
      fidelity: "train" or "high".
      timestep: physics step [s]. None: default of the fidelity.
      iterations: Newton iterations of the contact solver. None: default of the fidelity.
      ls_iterations: line-search iterations. None: default of the fidelity.
      cone: shape of the friction cone. None: default of the fidelity.
      name: a shipped robot, or the path of a description.
      terrain: uneven ground, in place of the flat floor.

    Raises:
      RobotError: no such robot, or one that cannot be used.
    """
    about = description.read(name)
    files_changed, spec = build.changed_at(about), build.spec(about, fidelity)
    model = _on_ground(spec, fidelity, terrain) if terrain else spec.compile()
    model.opt.timestep = timestep or model.opt.timestep
    model.opt.iterations = iterations or model.opt.iterations
    model.opt.ls_iterations = ls_iterations or model.opt.ls_iterations
    model.opt.cone = _CONES[cone] if cone else model.opt.cone
    # A diverged simulation must show NaN. MuJoCo's automatic reset would hide it.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # motors.motor_torque applies the torque limits, which depend on joint speed. The engine must
    # not clamp again: C MuJoCo drops the implicit damping of a saturated actuator, MJX keeps it.
    model.actuator_forcelimited[:] = 0
    joints = model.actuator_trnid[:, 0]
    names = tuple(model.joint(j).name for j in joints)
    home = model.keyframe("home").qpos.copy()
    parts, links = anatomy.study(model, home), model.jnt_bodyid[joints]
    hands = [links[arm[-1]] for limb, arm in parts.limbs.items() if limb.endswith("arm")]
    box, mass = model.site("torso_box"), float(model.body_subtreemass[0])
    stand_height = float(model.numeric("stand_height").data[0])
    xbot = load() if name != XBOT_L else None
    at_home = _at_home(model)
    is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    spheres = np.flatnonzero(is_sphere & (model.geom_priority > 0))
    return Robot(
        mj_model=model,
        name=spec.modelname,
        joint_names=names,
        kp=model.actuator_gainprm[:, 0].copy(),
        kd=-model.actuator_biasprm[:, 2],
        effort_limit=model.actuator_forcerange[:, 1].copy(),
        speed_limit=model.numeric("speed_limit").data.copy(),
        joint_inertia=_joint_inertia(model, at_home),
        joint_lower=model.jnt_range[joints, 0],
        joint_upper=model.jnt_range[joints, 1],
        default_qpos=home,
        anatomy=parts,
        trunk_body_id=parts.trunk,
        joint_body_ids=links,
        link_body_ids=np.array(list(dict.fromkeys([parts.base, *links.tolist()]))),
        hand_body_ids=np.array(hands, int),
        hand_points=_hand_points(model, hands),
        subtree=_subtree(model),
        foot_geom_ids=np.flatnonzero(model.geom_priority > 0),
        sole_geom_ids=spheres,
        sole_inward=_inward(at_home, spheres),
        terrain=terrain,
        ground_geom_ids=_ground_geoms(model, fidelity) if terrain else np.array([], int),
        torso_box_center=box.pos.copy(),
        torso_box_half_size=box.size.copy(),
        total_mass=mass,
        stand_height=stand_height,
        sole_drop=float(model.numeric("sole_drop").data[0]),
        feet_apart=_apart(at_home, "foot_pos"),
        knees_apart=_apart(at_home, "knee_pos"),
        mass_ratio=mass / xbot.total_mass if xbot else 1.0,
        length_ratio=stand_height / xbot.stand_height if xbot else 1.0,
        files_changed=files_changed,
    )


def _on_ground(spec: mujoco.MjSpec, fidelity: Fidelity, terrain: TerrainConfig) -> mujoco.MjModel:
    """Compiles the model with uneven ground: own planes in training, else a height field."""
    if fidelity == "train":
        floors.own_planes(spec)
        model = spec.compile()
    else:
        largest = ground.largest(terrain)
        windows = [ground.window(largest, far) for far in (False, True)]
        reach = float(ground.reach(largest))
        floors.height_fields(spec, len(windows), len(windows[0]), ground.HALF, reach)
        model = spec.compile()
        floors.fill(model, windows)
        model.geom(floors.FLOOR).pos = [0.0, 0.0, -reach]
    model.geom_sameframe[_ground_geoms(model, fidelity)] = 0  # use geom_pos and geom_quat
    return model


def _ground_geoms(model: mujoco.MjModel, fidelity: Fidelity) -> np.ndarray:
    """Geoms of the ground, see `Robot.ground_geom_ids`."""
    if fidelity == "high":
        return np.array([model.geom(floors.FLOOR).id])
    kinds, of_world = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, model.geom_bodyid == 0
    planes = np.flatnonzero(kinds & of_world)
    return planes[planes != model.geom(floors.FLOOR).id]


def _at_home(model: mujoco.MjModel) -> mujoco.MjData:
    """The robot at rest in its home pose."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.keyframe("home").id)
    mujoco.mj_forward(model, data)
    return data


def _inward(at_home: mujoco.MjData, spheres: np.ndarray) -> np.ndarray:
    """[k, 3] direction in which each sole sphere moves when its sole gets smaller, link frame.

    It leads to the middle of the foot's spheres. It has the length 1 along the ground, and rises by
    `SOLE_RISE`.
    """
    feet, ways = at_home.model.geom_bodyid[spheres], np.zeros((len(spheres), 3))
    for foot in np.unique(feet):
        points = at_home.geom_xpos[spheres[feet == foot]]
        offset = (points.mean(axis=0) - points)[:, :2]
        along = offset / np.linalg.norm(offset, axis=1, keepdims=True)
        rising = np.column_stack([along, np.full(len(along), SOLE_RISE)])
        ways[feet == foot] = rising @ at_home.xmat[foot].reshape(3, 3)
    return ways


def _apart(data: mujoco.MjData, sensor: str) -> float:
    """Lateral distance [m] of the left and the right position sensor of this name."""
    left, right = (data.sensor(f"{side}_{sensor}").data[1] for side in ("left", "right"))
    return float(left - right)


def _hand_points(model: mujoco.MjModel, hands: list[int]) -> np.ndarray:
    """[2, 3] centre of the geoms "left_hand" and "right_hand", else the link's centre of mass."""
    points = np.reshape(model.body_ipos[hands], (-1, 3)).copy()
    for i, side in enumerate(("left", "right")[: len(hands)]):
        hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, f"{side}_hand")
        if hand >= 0:
            points[i] = model.geom_pos[hand]
    return points


def _subtree(model: mujoco.MjModel) -> np.ndarray:
    """[B, B] float: 1 where the body of the column is in the subtree of the body of the row."""
    subtree = np.eye(model.nbody)
    for body in reversed(range(1, model.nbody)):  # children come after their parents
        subtree[model.body_parentid[body]] += subtree[body]
    return subtree


def _joint_inertia(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """[n] kg m^2, 1 / diag(M^-1) at the home pose `data`, without contact.

    It is the torque on one joint over its acceleration, while all other joints and the base are
    free to move.
    """
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return 1.0 / np.diag(inverse)[6:]
