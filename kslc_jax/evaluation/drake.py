"""A second, independent engine: Drake's SAP contact solver with hydroelastic feet.

The plant takes masses, frames, limits and shapes from the compiled MuJoCo model. Drake computes the
dynamics. `step` has the signature of `physics.step`. So environment, signals and observations are
the same as with MuJoCo. MuJoCo only computes the kinematic sensors at Drake's state.

It needs the package drake: pip install 'kslc_jax[drake]'.
"""

import copy
import functools
import threading
from dataclasses import dataclass

import jax
import mujoco
import numpy as np
from pydrake import geometry
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.geometry import GeometryId, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    RevoluteSpring,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from kslc_jax import motors, physics
from kslc_jax.config import ConfigError, PhysicsConfig
from kslc_jax.physics import PhysicsState
from kslc_jax.randomize import Dynamics, model_fields
from kslc_jax.robot import Robot
from kslc_jax.robots.shapes import mesh_data

SLAB = 0.1
"""Depth [m] within which the pressure in the floor rises from zero to `MODULUS`."""

MODULUS = 1e7
"""Pressure of the floor at the depth `SLAB` [Pa]. The standing robot sinks in by 0.2 mm."""

DISSIPATION = 1.0
"""Hunt-Crossley dissipation of the contact [s/m]."""

MESH_SIZE = 0.002
"""Length [m] of the triangles that stand for a round shape of a foot."""

TOUCH_SENSORS = ("left_foot_touch", "right_foot_touch")
"""Sensors of the force between each foot and the floor."""

KINEMATICS = (
    mujoco.mj_kinematics,
    mujoco.mj_comPos,
    mujoco.mj_comVel,
    mujoco.mj_subtreeVel,  # explicit, because mj_sensorVel expects it to be up to date
    mujoco.mj_sensorPos,
    mujoco.mj_sensorVel,
)
"""Stages of MuJoCo that compute its position and velocity sensors."""

_lock = threading.Lock()


@dataclass(frozen=True, eq=False)
class World:
    """One simulated robot with fixed parameters. Each step overwrites `context` and `data`."""

    robot: Robot
    data: mujoco.MjData  # for the kinematic sensors; its model has the plant's parameters
    diagram: Diagram
    plant: MultibodyPlant
    context: Context  # of the diagram
    feet: tuple[frozenset[GeometryId], ...]  # shapes of the left and of the right foot
    q_index: np.ndarray  # [7 + n] index in Drake's positions of each element of qpos
    v_index: np.ndarray  # [6 + n] index in Drake's velocities of each element of qvel

    @property
    def plant_context(self) -> Context:
        """The plant's part of `context`."""
        return self.plant.GetMyContextFromRoot(self.context)


# -------------------------------------------------------------------------------------- building


def build(robot: Robot, model: mujoco.MjModel) -> World:
    """Builds the robot on a half space, with the parameters of `model`.

    `model` is the robot's model or a changed copy. All shapes have the friction of the feet.

    Raises:
      ConfigError: Drake cannot take over the robot, see `require_hinged`.
    """
    require_hinged(robot)
    builder = DiagramBuilder()
    settings = MultibodyPlantConfig(
        time_step=model.opt.timestep,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="sap",
        use_sampled_output_ports=False,
    )
    plant, scene = AddMultibodyPlant(settings, builder)
    _add_bodies(plant, robot, model)
    ids = _add_shapes(plant, robot, model)
    plant.mutable_gravity_field().set_gravity_vector(model.opt.gravity)
    plant.Finalize()
    _exclude(plant, scene, model)
    diagram = builder.Build()
    base = plant.GetBodyByName(model.body(robot.anatomy.base).name)
    joints = [plant.GetJointByName(name) for name in robot.joint_names]
    q, v = base.floating_positions_start(), base.floating_velocities_start_in_v()
    return World(
        robot=robot,
        data=mujoco.MjData(model),
        diagram=diagram,
        plant=plant,
        context=diagram.CreateDefaultContext(),
        feet=tuple(frozenset(ids[geom] for geom in foot) for foot in robot.foot_shapes),
        # Drake's order: quaternion, position; angular, linear velocity. MuJoCo's is the reverse.
        q_index=np.r_[q + 4 : q + 7, q : q + 4, [j.position_start() for j in joints]],
        v_index=np.r_[v + 3 : v + 6, v : v + 3, [j.velocity_start() for j in joints]],
    )


def require_hinged(robot: Robot) -> None:
    """ConfigError if a body does not have exactly one joint."""
    model = robot.mj_model
    if wrong := [model.body(i).name for i in range(1, model.nbody) if model.body_jntnum[i] != 1]:
        raise ConfigError(
            f"engine: drake takes robots with one joint per body; {wrong[0]!r} of {robot.name} has "
            f"{model.body(wrong[0]).jntnum[0]}: take --engine mujoco"
        )


def _add_bodies(plant: MultibodyPlant, robot: Robot, model: mujoco.MjModel) -> None:
    """Adds bodies, hinges, springs and motors, in the robot's joint order.

    The joints get the full damping of the servos, and Drake integrates it implicitly. MuJoCo gets
    the part that `motors.motor_damping` gives.
    """
    for i in range(1, model.nbody):
        plant.AddRigidBody(model.body(i).name, _inertia(model, i))
    for name, servo_damping in zip(robot.joint_names, robot.kd, strict=True):
        joint = model.joint(name)
        child = model.body(int(joint.bodyid[0]))
        parent = plant.GetBodyByName(model.body(int(child.parentid[0])).name)
        anchor = RigidTransform(joint.pos)
        # The frames coincide at angle zero. MuJoCo's angle is `ref` in the pose of the MJCF.
        turned = RigidTransform(RotationMatrix(AngleAxis(-joint.qpos0[0], joint.axis)), [0, 0, 0])
        place = _pose(child.pos, child.quat) @ anchor @ turned
        hinge = RevoluteJoint(
            name,
            plant.AddFrame(FixedOffsetFrame(f"{name}_parent", parent, place)),
            plant.AddFrame(
                FixedOffsetFrame(f"{name}_child", plant.GetBodyByName(child.name), anchor)
            ),
            joint.axis,
            damping=joint.damping[0] + servo_damping,
        )
        hinge.set_position_limits(joint.range[:1], joint.range[1:])
        hinge = plant.AddJoint(hinge)
        if stiffness := float(joint.stiffness[0]):
            rest = float(joint.qpos_spring[0])
            plant.AddForceElement(RevoluteSpring(hinge, rest, stiffness))
        motor = plant.AddJointActuator(name, hinge)
        motor.set_default_rotor_inertia(joint.armature[0])


def _pose(pos: np.ndarray, quat: np.ndarray) -> RigidTransform:
    return RigidTransform(Quaternion(quat), pos)


def _inertia(model: mujoco.MjModel, body: int) -> SpatialInertia:
    """Mass and inertia of a body about the origin of its frame."""
    turn = RotationMatrix(Quaternion(model.body_iquat[body])).matrix()
    central = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return SpatialInertia.MakeFromCentralInertia(
        model.body_mass[body],
        model.body_ipos[body],
        RotationalInertia(*np.diag(central), central[0, 1], central[0, 2], central[1, 2]),
    )


def _add_shapes(
    plant: MultibodyPlant, robot: Robot, model: mujoco.MjModel
) -> dict[int, GeometryId]:
    """Adds every geom that collides: rigid feet, a compliant floor, point contact for the rest.

    Returns the ids of Drake by those of the geoms.
    """
    feet, ids = np.concatenate(robot.foot_shapes), {}
    friction = float(model.geom_friction[feet[0], 0])
    for i in np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist():
        geom = model.geom(i)
        body = plant.GetBodyByName(model.body(int(geom.bodyid[0])).name)
        properties = geometry.ProximityProperties()
        geometry.AddContactMaterial(
            properties, dissipation=DISSIPATION, friction=CoulombFriction(friction, friction)
        )
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geometry.AddCompliantHydroelasticPropertiesForHalfSpace(SLAB, MODULUS, properties)
        elif i in feet:
            geometry.AddRigidHydroelasticProperties(MESH_SIZE, properties)
        name = geom.name or f"geom{i}"
        ids[i] = plant.RegisterCollisionGeometry(
            body, _pose(geom.pos, geom.quat), _shape(model, i, name), name, properties
        )
    return ids


def _shape(model: mujoco.MjModel, geom: int, name: str) -> geometry.Shape:
    """Drake's shape for a geom. MuJoCo's sizes are half lengths; of a mesh its hull collides."""
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    a, b, c = map(float, model.geom_size[geom])
    match kind:
        case mujoco.mjtGeom.mjGEOM_PLANE:
            return geometry.HalfSpace()
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return geometry.Sphere(a)
        case mujoco.mjtGeom.mjGEOM_BOX:
            return geometry.Box(2 * a, 2 * b, 2 * c)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return geometry.Capsule(a, 2 * b)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return geometry.Cylinder(a, 2 * b)
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return geometry.Ellipsoid(a, b, c)
        case mujoco.mjtGeom.mjGEOM_MESH:
            vertices, _ = mesh_data(model, int(model.geom_dataid[geom]))
            return geometry.Convex(vertices.T.astype(float), name)
    raise ValueError(f"geom {name}: no Drake shape for {kind}")


def _exclude(plant: MultibodyPlant, scene: SceneGraph, model: mujoco.MjModel) -> None:
    """Excludes the contacts that the model excludes.

    Both engines skip the contacts of a body with its parent anyway.
    """

    def shapes_of(body: int) -> geometry.GeometrySet:
        link = plant.GetBodyByName(model.body(body).name)
        return geometry.GeometrySet(plant.GetCollisionGeometriesForBody(link))

    for signature in model.exclude_signature:
        one, other = divmod(int(signature), 1 << 16)
        scene.collision_filter_manager().Apply(
            geometry.CollisionFilterDeclaration().ExcludeBetween(shapes_of(one), shapes_of(other))
        )


# -------------------------------------------------------------------------------------- stepping


def set_state(world: World, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """Sets the robot's `qpos` [7 + n] and `qvel` [6 + n], given in MuJoCo's conventions."""
    q, v = np.empty(len(qpos)), np.empty(len(qvel))
    rate = np.empty(3)
    mujoco.mju_rotVecQuat(rate, qvel[3:6], qpos[3:7])
    q[world.q_index], v[world.v_index] = qpos, np.r_[qvel[:3], rate, qvel[6:]]
    world.plant.SetPositionsAndVelocities(world.plant_context, np.r_[q, v])


def get_state(world: World) -> tuple[np.ndarray, np.ndarray]:
    """The robot's qpos [7 + n] and qvel [6 + n] in MuJoCo's conventions."""
    qpos = world.plant.GetPositions(world.plant_context)[world.q_index]
    qvel = world.plant.GetVelocities(world.plant_context)[world.v_index]
    mujoco.mju_normalize4(qpos[3:7])
    mujoco.mju_rotVecQuat(qvel[3:6], qvel[3:6].copy(), qpos[3:7] * [1, -1, -1, -1])
    return qpos, qvel


def advance(
    world: World, state: PhysicsState, target: np.ndarray, dynamics: Dynamics, steps: int
) -> PhysicsState:
    """Does `steps` physics steps of one robot towards the joint targets [n, rad], in numpy.

    If Drake fails in a step, qpos and qvel are NaN, as after a diverged step in MuJoCo.
    """
    robot, actuation = world.robot, world.plant.get_actuation_input_port()
    joint_friction = world.data.model.dof_frictionloss[6:]
    torque, forces = np.asarray(state.torque), np.zeros(len(world.feet))
    try:
        set_state(world, np.asarray(state.qpos), np.asarray(state.qvel))
        for i in range(steps):
            qpos, qvel = get_state(world)
            q, dq = qpos[7:], qvel[6:]
            torque = motors.motor_torque(robot, dynamics, q, dq, target, np)
            passive = -joint_friction * np.tanh(dq / motors.FRICTION_SPEED)
            actuation.FixValue(world.plant_context, torque + passive + robot.kd * dq)
            if i == steps - 1:
                forces = foot_forces(world)
            new = world.diagram.EvalUniquePeriodicDiscreteUpdate(world.context)
            world.context.get_mutable_discrete_state().SetFrom(new)
        qpos, qvel = get_state(world)
    except (RuntimeError, SystemExit):  # Drake raises SystemExit for non-finite numbers
        qpos, qvel = np.full(state.qpos.shape, np.nan), np.full(state.qvel.shape, np.nan)
    sensordata = _sensordata(world, qpos, qvel, forces)
    return state.replace(qpos=qpos, qvel=qvel, sensordata=sensordata, torque=torque)


def foot_forces(world: World) -> np.ndarray:
    """Normal force [2] between each foot and the floor in the present state [N]."""
    contacts = world.plant.get_contact_results_output_port().Eval(world.plant_context)
    forces = np.zeros(len(world.feet))
    for i in range(contacts.num_hydroelastic_contacts()):
        contact = contacts.hydroelastic_contact_info(i)
        surface = contact.contact_surface()
        touching = {surface.id_M(), surface.id_N()}
        for foot, shapes in enumerate(world.feet):
            if touching & shapes:
                forces[foot] += abs(contact.F_Ac_W().translational()[2])
    return forces


def _sensordata(world: World, qpos: np.ndarray, qvel: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """All sensor values: foot forces from Drake, kinematic sensors from MuJoCo."""
    model, data = world.data.model, world.data
    data.qpos[:], data.qvel[:] = qpos, qvel
    for stage in KINEMATICS:
        stage(model, data)
    for name, force in zip(TOUCH_SENSORS, forces, strict=True):
        data.sensordata[world.robot.sensor(name)] = force
    return data.sensordata.copy()


def step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    ground_friction: float,
    force: None = None,
) -> PhysicsState:
    """Advances one environment by one control step, as `physics.step` does, but in Drake.

    Under vmap it steps one environment after the other. It knows no forces on links.
    """
    fields = model_fields(physics.robot_for(config), dynamics, ground_friction)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    call = functools.partial(_host_step, config)
    return jax.pure_callback(call, like, state, target, dynamics, fields, vmap_method="sequential")


def _host_step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: np.ndarray,
    dynamics: Dynamics,
    fields: dict[str, np.ndarray],
) -> PhysicsState:
    """The host's part of `step`, in numpy.

    It must not run JAX: the new computation would wait for the program that waits for this call.
    """
    state, target, dynamics, fields = jax.tree.map(
        lambda x: np.asarray(x, np.float64), (state, target, dynamics, fields)
    )
    changes = tuple((name, value.tobytes()) for name, value in fields.items())
    with _lock:
        new = advance(_world(config, changes), state, target, dynamics, config.decimation)
    return jax.tree.map(lambda x: x.astype(np.float32), new)


@functools.lru_cache(maxsize=64)
def _world(config: PhysicsConfig, changes: tuple[tuple[str, bytes], ...]) -> World:
    """A `World` of the robot with changed model fields. The cache keeps the last 64 worlds."""
    robot = physics.robot_for(config)
    model = copy.copy(robot.mj_model)
    for name, raw in changes:
        field = getattr(model, name)
        field[:] = np.frombuffer(raw).reshape(field.shape)
    return build(robot, model)
