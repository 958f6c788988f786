"""One control step of the robot: joint targets -> PD torques -> decimated physics -> PhysicsState.

Two engines behind one signature, same model and same numbers within float32:

- ``mjx``: MJX's JAX implementation, pure XLA, any device.
- ``mujoco``: C MuJoCo's ``mujoco.batch.Batch`` on all CPU cores behind one numpy-only
  ``jax.pure_callback`` (vmapped environments arrive in it as one batch).

Only qpos, qvel, the solver's warm start and the sensors cross a step: a whole ``mjx.Data`` is 16 KB
an environment.
"""

import contextlib
import functools
import io
import threading
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # mjx prints about an optional backend
    from mujoco import mjx

from kslc_jax import robot as robot_lib
from kslc_jax import runtime
from kslc_jax.config import PhysicsConfig
from kslc_jax.motors import SERVO_DAMPING, drive
from kslc_jax.randomize import Dynamics, model_fields
from kslc_jax.robot import Robot


@flax.struct.dataclass
class PhysicsState:
    """What the next control step, and every signal, is computed from."""

    qpos: jax.Array  # [23] base position [m], base quaternion (w, x, y, z), joint angles [rad]
    qvel: (
        jax.Array
    )  # [22] base velocity, world [m/s]; base rate, body frame [rad/s]; joints [rad/s]
    qacc_warmstart: jax.Array  # [22] contact solver's start
    sensordata: jax.Array  # [S] named sensors of the model, see Robot.sensor
    torque: jax.Array  # [16] motor torque less joint friction, last physics step [N m]


def robot_for(config: PhysicsConfig) -> Robot:
    """The robot at the config's fidelity, timestep and solver settings (cached)."""
    return robot_lib.load(
        config.fidelity,
        timestep=config.timestep,
        iterations=config.iterations,
        ls_iterations=config.ls_iterations,
    )


def resolve_engine(config: PhysicsConfig) -> str:
    """'mjx' or 'mujoco'; 'auto' takes mjx where JAX has an accelerator."""
    if config.engine != "auto":
        return config.engine
    return "mujoco" if jax.default_backend() == "cpu" else "mjx"


def initial_state(config: PhysicsConfig, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
    """State before any step; sensors hold the home pose's values until the first step."""
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
) -> PhysicsState:
    """Advances one environment by one control step towards the joint targets [16, rad].

    The new state has the dtypes of the old one, also in a program that enables x64.
    """
    fields = model_fields(robot_for(config), dynamics, ground_friction)
    engine = _step_mujoco if resolve_engine(config) == "mujoco" else _step_mjx
    return engine(config, state, target, dynamics, fields)


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
        return mjx.put_model(robot_for(config).mj_model, device=_own_device(), impl="jax")


def _own_device() -> jax.Device:
    """MJX would take the first device of all processes, which may be another one's."""
    return jax.local_devices()[0]


def _step_mjx(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    fields: dict[str, jax.Array],
) -> PhysicsState:
    robot = robot_for(config)
    model = _mjx_model(config).replace(**fields)
    blank = mjx.make_data(robot.mj_model, device=_own_device(), impl="jax")
    data = blank.replace(
        qpos=state.qpos.astype(blank.qpos.dtype),  # under x64 the state need not be float64
        qvel=state.qvel.astype(blank.qvel.dtype),
        qacc_warmstart=state.qacc_warmstart.astype(blank.qacc_warmstart.dtype),
    )

    def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, jax.Array]:
        torque, ctrl, bias = drive(robot, dynamics, data.qpos[7:], data.qvel[6:], target)
        servos = model.actuator_biasprm.at[:, SERVO_DAMPING].set(bias)
        return mjx.step(model.replace(actuator_biasprm=servos), data.replace(ctrl=ctrl)), torque

    with jax.default_matmul_precision("highest"):
        data, torques = jax.lax.scan(substep, data, None, length=config.decimation)
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
    """Position and velocity sensors at the new state; contact sensors stay the last step's."""
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.com_vel(model, data)
    return mjx.sensor_vel(model, mjx.sensor_pos(model, data))


# -------------------------------------------------------------------------------------- mujoco

_batches: dict[tuple[Robot, int, int], mujoco.batch.Batch] = {}
_batches_lock = threading.Lock()


def _batch(robot: Robot, size: int, threads: int) -> mujoco.batch.Batch:
    """The cached simulator batch of this size; its state is overwritten at every call.

    MuJoCo's own default, 0 threads, would start one for every CPU of the machine.
    """
    key = (robot, size, threads)
    if key not in _batches:
        count = threads or runtime.usable_cpus()
        _batches[key] = mujoco.batch.Batch(robot.mj_model, size, nthread=count)
    return _batches[key]


def _step_mujoco(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    fields: dict[str, jax.Array],
) -> PhysicsState:
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    return jax.pure_callback(
        functools.partial(_host_step, config),
        like,
        state,
        target,
        dynamics,
        fields,
        vmap_method="broadcast_all",
    )


def _host_step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: np.ndarray,
    dynamics: Dynamics,
    fields: dict[str, np.ndarray],
) -> PhysicsState:
    """numpy in, numpy out: no JAX call in here, it would wait for the program that waits for us.

    The result has the dtypes of `state`.
    """
    lead = np.shape(target)[:-1]
    robot = robot_for(config)

    def rows(x: Any) -> np.ndarray:
        x = np.asarray(x, np.float64)
        return x.reshape(-1, *x.shape[len(lead) :])

    like = state
    state, dynamics, fields = jax.tree.map(rows, (state, dynamics, fields))
    target = rows(target)
    with _batches_lock:
        batch = _batch(robot, len(target), config.threads)
        for name, value in fields.items():
            batch.expand(name)[:] = value
        qpos, qvel, warmstart = (batch.bind(n) for n in ("qpos", "qvel", "qacc_warmstart"))
        sensordata, ctrl = batch.bind("sensordata"), batch.bind("ctrl")
        servos = batch.expand("actuator_biasprm")
        qpos[:], qvel[:], warmstart[:] = state.qpos, state.qvel, state.qacc_warmstart
        torque = state.torque
        for i in range(config.decimation):
            torque, ctrl[:], servos[:, :, SERVO_DAMPING] = drive(
                robot, dynamics, qpos[:, 7:], qvel[:, 6:], target, np
            )
            last = i == config.decimation - 1
            batch.step(stage=int(mujoco.mjtStage.mjSTAGE_VEL if last else 0))
        new = state.replace(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=warmstart,
            sensordata=sensordata,
            torque=torque,
        )
        return jax.tree.map(
            lambda x, old: np.array(x, old.dtype).reshape(*lead, *x.shape[1:]), new, like
        )
