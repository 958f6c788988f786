"""One control step of the robot: joint targets -> PD torques -> decimated physics -> PhysicsState.

Two engines have one signature and one model. Their results agree up to float32 rounding:

- ``mjx``: MJX's JAX implementation, pure XLA, on any device.
- ``mujoco``: C MuJoCo's ``mujoco.batch.Batch`` on the CPU cores, called by one
  ``jax.pure_callback`` that uses numpy only. Vmapped environments arrive in it as one batch.

Only the small `PhysicsState` is passed from step to step: a whole ``mjx.Data`` takes 16 KB per
environment.
"""

import contextlib
import copy
import functools
import io
import sys
import threading
from collections.abc import Callable, Generator
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # mjx prints a notice about an optional backend
    from mujoco import mjx

from kslc_jax import ground as ground_lib
from kslc_jax import processors
from kslc_jax import robot as robot_lib
from kslc_jax.config import PhysicsConfig
from kslc_jax.ground import Ground
from kslc_jax.motors import SERVO_DAMPING, drive
from kslc_jax.randomize import Dynamics, model_fields
from kslc_jax.robot import Robot


@flax.struct.dataclass
class PhysicsState:
    """Physics of one environment. The next control step and all signals are computed from it."""

    qpos: jax.Array  # [7 + n] base position [m], base quaternion (w, x, y, z), joint angles [rad]
    qvel: (
        jax.Array
    )  # [6 + n] base velocity, world [m/s]; base rate, body frame [rad/s]; joints [rad/s]
    qacc_warmstart: jax.Array  # [6 + n] start of the contact solver
    sensordata: jax.Array  # [S] named sensors of the model, see Robot.sensor
    torque: jax.Array  # [n] motor torque minus joint friction, last physics step [N m]


def robot_for(config: PhysicsConfig) -> Robot:
    """The robot with the config's fidelity, timestep and solver settings (cached)."""
    return robot_lib.load(
        config.fidelity,
        name=config.robot,
        timestep=config.timestep,
        iterations=config.iterations,
        ls_iterations=config.ls_iterations,
        cone=config.cone,
        terrain=config.uneven,
    )


def resolve_engine(config: PhysicsConfig) -> str:
    """'mjx' or 'mujoco'. 'auto' means mjx if JAX has an accelerator, else mujoco."""
    if config.engine != "auto":
        return config.engine
    return "mujoco" if jax.default_backend() == "cpu" else "mjx"


def initial_state(config: PhysicsConfig, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
    """State before the first step. Its sensors have the values of the home pose, without touch."""
    model = robot_for(config).mj_model
    return PhysicsState(
        qpos=qpos,
        qvel=qvel,
        qacc_warmstart=jnp.zeros(model.nv),
        sensordata=jnp.asarray(_home_sensordata(config), jnp.float32),
        torque=jnp.zeros(model.nu),
    )


def step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    ground_friction: float,
    force: jax.Array | None = None,
    alter: Callable[[dict[str, jax.Array]], dict[str, jax.Array]] | None = None,
) -> PhysicsState:
    """Advances one environment by one control step towards the joint targets [n, rad].

    The new state has the dtypes of the old one, also in a program that enables x64.

    Args:
      config: engine and solver.
      state: before the step.
      target: joint angles [n, rad].
      dynamics: how this robot differs from the described one.
      ground_friction: see `model_fields`.
      force: [nbody, 6] force [N] and torque [N m] on each body at its centre of mass, world frame.
      alter: maps the mjModel fields of `model_fields` to those of a robot that differs in more.
    """
    fields = model_fields(robot_for(config), dynamics, ground_friction)
    fields = alter(fields) if alter else fields
    planes = None
    if dynamics.ground is not None:
        if config.fidelity == "high":
            fields = _with_height_field(robot_for(config), state, dynamics.ground, fields)
        else:
            planes = _planes(config, state, dynamics.ground)
    engine = _step_mujoco if resolve_engine(config) == "mujoco" else _step_mjx
    return engine(config, state, target, dynamics, fields, force, planes)


Planes = tuple[jax.Array, jax.Array]
"""Position [decimation, k, 3] and orientation [decimation, k, 4] of the plane below each sole
sphere, for each physics step."""


def _planes(config: PhysicsConfig, state: PhysicsState, ground: Ground) -> Planes:
    """The planes that touch the ground where the sole spheres will be.

    The spheres' positions are expected from their position and velocity at the start of the control
    step. A small error of the expected position matters little: the plane is tangent to the ground
    there, so below the sphere its height is wrong by second order only.
    """
    robot = robot_for(config)
    pos, vel = (state.sensordata[robot.soles(what)].reshape(-1, 3) for what in ("pos", "vel"))
    times = config.timestep * jnp.arange(config.decimation)[:, None, None]
    return jax.vmap(functools.partial(ground_lib.planes, ground))(pos + times * vel)


def _with_height_field(
    robot: Robot, state: PhysicsState, ground: Ground, fields: dict[str, jax.Array]
) -> dict[str, jax.Array]:
    """Adds the window of the height field that the robot stands on to mjModel fields."""
    pos, quat, far = ground_lib.place(ground, *state.qpos[:2])
    floor = robot.ground_geom_ids[0]

    def changed(name: str, value: jax.Array) -> jax.Array:
        before = fields.get(name, jnp.asarray(getattr(robot.mj_model, name)))
        return before.at[floor].set(value)

    return fields | {
        "geom_pos": changed("geom_pos", pos),
        "geom_quat": changed("geom_quat", quat),
        "geom_dataid": changed("geom_dataid", far.astype(int)),
    }


@functools.lru_cache(maxsize=8)
def _home_sensordata(config: PhysicsConfig) -> np.ndarray:
    robot = robot_for(config)
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_forward(robot.mj_model, data)
    values = data.sensordata.copy()
    for name in ("left_foot_touch", "right_foot_touch"):
        values[robot.sensor(name)] = 0.0
    return values


# ----------------------------------------------------------------------------------------- mjx


@functools.lru_cache(maxsize=8)
def _mjx_model(config: PhysicsConfig) -> mjx.Model:
    with jax.ensure_compile_time_eval():
        model = mjx.put_model(robot_for(config).mj_model, device=_own_device(), impl="jax")
    if config.cone == "pyramidal":
        return model
    fewer = min(config.ls_iterations, max(FEW_SEARCHES, config.ls_iterations // 4))
    return model.replace(opt=model.opt.replace(ls_iterations=fewer))


FEW_SEARCHES = 5
"""In elliptic cones MJX takes a quarter of `ls_iterations`, but not fewer than 5, unless fewer are
asked for. It tries three points in each: with 5 it makes the same error as C MuJoCo with 20
(docs/fidelity_physics.md)."""


def _blank_data(model: mujoco.MjModel) -> mjx.Data:
    """MJX's data before a step.

    MJX's solver has elliptic cones beside contacts without friction, but `mjx.make_data` refuses
    them (MJX 3.17). So this makes data for pyramids, and then lays out the rows of the constraints
    anew. That needs a part of MJX that is not public.
    """
    pyramids = copy.copy(model)
    pyramids.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    data = mjx.make_data(pyramids, device=_own_device(), impl="jax")
    if model.opt.cone == pyramids.opt.cone:
        return data
    from mujoco.mjx._src import constraint as mjx_rows

    of_jax: Any = data._impl
    kinds = mjx_rows.make_efc_type(model, of_jax.contact.dim)
    address = mjx_rows.make_efc_address(model, of_jax.contact.dim, kinds)
    rows = {
        name: jnp.zeros((kinds.size, *getattr(of_jax, name).shape[1:]), of_jax.efc_D.dtype)
        for name in _ROWS
    }
    contact = of_jax.contact.replace(efc_address=address)
    return data.replace(
        _impl=of_jax.replace(nefc=kinds.size, efc_type=kinds, contact=contact, **rows)
    )


_ROWS = ("efc_J", "efc_pos", "efc_margin", "efc_frictionloss", "efc_D", "efc_aref", "efc_force")
"""Arrays of MJX's data with one row per row of the constraints."""


def _own_device() -> jax.Device:
    """First device of this process. MJX's default may be a device of another process."""
    return jax.local_devices()[0]


def _step_mjx(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    fields: dict[str, jax.Array],
    force: jax.Array | None,
    planes: Planes | None,
) -> PhysicsState:
    robot = robot_for(config)
    model = _mjx_model(config).replace(**fields)
    blank = _blank_data(robot.mj_model)
    data = blank.replace(
        qpos=state.qpos.astype(blank.qpos.dtype),  # under x64 the state need not be float64
        qvel=state.qvel.astype(blank.qvel.dtype),
        qacc_warmstart=state.qacc_warmstart.astype(blank.qacc_warmstart.dtype),
    )
    if force is not None:
        data = data.replace(xfrc_applied=force)

    def substep(data: mjx.Data, planes: Planes | None) -> tuple[mjx.Data, jax.Array]:
        torque, ctrl, bias = drive(robot, dynamics, data.qpos[7:], data.qvel[6:], target)
        changes = {"actuator_biasprm": model.actuator_biasprm.at[:, SERVO_DAMPING].set(bias)}
        if planes is not None:
            ground = robot.ground_geom_ids
            changes["geom_pos"] = model.geom_pos.at[ground].set(planes[0])
            changes["geom_quat"] = model.geom_quat.at[ground].set(planes[1])
        return mjx.step(model.replace(**changes), data.replace(ctrl=ctrl)), torque

    with jax.default_matmul_precision("highest"):
        data, torques = jax.lax.scan(substep, data, planes, length=config.decimation)
        data = _refresh_sensors(model, data)
    new = PhysicsState(
        qpos=data.qpos,
        qvel=data.qvel,
        qacc_warmstart=data.qacc_warmstart,
        sensordata=data.sensordata,
        torque=torques[-1],
    )
    return jax.tree.map(lambda x, old: x.astype(old.dtype), new, state)


def _refresh_sensors(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Recomputes position and velocity sensors at the new state.

    Touch sensors keep the forces of the last physics step.
    """
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.com_vel(model, data)
    return mjx.sensor_vel(model, mjx.sensor_pos(model, data))


# -------------------------------------------------------------------------------------- mujoco

UNSTABLE = "The simulation is unstable"
"""Part of MuJoCo's warnings of robots that diverge."""


def _say(warning: str) -> None:
    """Prints a warning of MuJoCo, unless a robot diverges: callers see that in its numbers."""
    with contextlib.suppress(Exception):  # an error here would end the process
        if UNSTABLE not in warning:
            print(f"warning: MuJoCo: {warning}", file=sys.stderr)


@contextlib.contextmanager
def own_warnings() -> Generator[None]:
    """Within the context MuJoCo writes no file MUJOCO_LOG.TXT into the user's folder, see `_say`.

    If the user handles MuJoCo's warnings, this stays so.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(before or _say)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


_batches_lock = threading.Lock()


@functools.lru_cache(maxsize=8)
def _batch(robot: Robot, size: int, threads: int, written: frozenset[str]) -> mujoco.batch.Batch:
    """Simulator batch of this size (cached). Every call of `_host_step` overwrites its state and
    the model fields `written`; all other fields are the robot's.

    MuJoCo's own default, 0 threads, would start one for every CPU of the machine.
    """
    count = threads or processors.usable()
    return mujoco.batch.Batch(robot.mj_model, size, nthread=count)


def _step_mujoco(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    fields: dict[str, jax.Array],
    force: jax.Array | None,
    planes: Planes | None,
) -> PhysicsState:
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    return jax.pure_callback(
        functools.partial(_host_step, config),
        like,
        state,
        target,
        dynamics,
        fields,
        force,
        planes,
        vmap_method="broadcast_all",
    )


_KEPT = ("qpos", "qvel", "qacc_warmstart", "sensordata")
"""Fields of a simulator batch that `PhysicsState` has."""


def _host_step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: np.ndarray,
    dynamics: Dynamics,
    fields: dict[str, np.ndarray],
    force: np.ndarray | None = None,
    planes: tuple[np.ndarray, np.ndarray] | None = None,
) -> PhysicsState:
    """One control step of a batch in C MuJoCo; numpy in, numpy out. The result has the dtypes of
    `state`.

    It must not run JAX: that would wait for the running program, which waits for this callback.
    """
    lead = np.shape(target)[:-1]
    robot = robot_for(config)

    def rows(x: Any) -> np.ndarray:
        x = np.asarray(x, np.float64)
        return x.reshape(-1, *x.shape[len(lead) :])

    like = state
    state, dynamics, fields, force, planes = jax.tree.map(
        rows, (state, dynamics, fields, force, planes)
    )
    target = rows(target)
    applied = {} if force is None else {"xfrc_applied": force}
    with _batches_lock, own_warnings():
        moved = {} if planes is None else dict(zip(("geom_pos", "geom_quat"), planes, strict=True))
        written = frozenset(fields | applied | moved)
        batch = _batch(robot, len(target), config.threads, written)
        for name, value in applied.items():
            batch.bind(name)[:] = value
        for name, value in fields.items():
            batch.expand(name)[:] = value
        # All before the first step: a step fills only what is bound.
        bound = {name: batch.bind(name) for name in _KEPT}
        for name in ("qpos", "qvel", "qacc_warmstart"):
            bound[name][:] = getattr(state, name)
        torque = _physics_steps(config, robot, batch, target, dynamics, moved, state.torque)
        new = state.replace(torque=torque, **{name: bound[name] for name in _KEPT})
        return jax.tree.map(
            lambda x, old: np.array(x, old.dtype).reshape(*lead, *x.shape[1:]), new, like
        )


def _physics_steps(
    config: PhysicsConfig,
    robot: Robot,
    batch: mujoco.batch.Batch,
    target: np.ndarray,
    dynamics: Dynamics,
    moved: dict[str, np.ndarray],
    torque: np.ndarray,
) -> np.ndarray:
    """The physics steps of one control step, in place; returns the last torque [N, n, N m].

    `moved` has a value [N, physics step, plane, ...] for each field of the ground's planes.
    """
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    servos = batch.expand("actuator_biasprm")
    for i in range(config.decimation):
        torque, ctrl[:], servos[:, :, SERVO_DAMPING] = drive(
            robot, dynamics, qpos[:, 7:], qvel[:, 6:], target, np
        )
        for name, value in moved.items():
            batch.expand(name)[:, robot.ground_geom_ids] = value[:, i]
        last = i == config.decimation - 1
        batch.step(stage=int(mujoco.mjtStage.mjSTAGE_VEL if last else 0))
    return torque
