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
from collections.abc import Callable
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
from kslc_jax.config import PhysicsConfig
from kslc_jax.randomize import Dynamics, model_fields
from kslc_jax.robot import Robot

TORQUE_KNEE = 0.75
"""Share of a joint's speed limit above which its driving torque falls, linearly, to zero."""

SERVO_DAMPING = 2
"""Where -damping stands in a servo's `actuator_biasprm`."""

IMPLICIT = 0.6
"""theta: share of a step's motor torque taken from its end. 1, backward Euler, brakes at 5 ms what
moves freely at 1 ms; below 0.5 it is unstable."""

LEAST_CHANGE = 0.01
"""Least change of joint speed [rad/s] over which `motor_damping` takes a chord."""

FRICTION_SPEED = 0.2
"""Joint speed [rad/s] at which Coulomb friction is 76 % grown (tanh keeps it smooth)."""


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


def motor_torque(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """PD torque within the motor's limits, minus joint friction [16, N m].

    clip(kp (target - q) - kd dq, lower, upper): in the driving direction the available torque
    falls on a line from its full value (0.85 x effort limit x strength) at 75 % of the joint's
    speed limit to zero at the limit, and on from there: a motor that is turned faster than it can
    turn by itself brakes. Braking keeps all of the torque.

    Args:
      robot: gains and limits.
      dynamics: factors on them, see `Dynamics`.
      q, dq, target: joint angles [rad], speeds [rad/s], target angles [rad], [..., 16].
      xp: numpy or jax.numpy; the two engines share this function.
    """
    pd = dynamics.kp * robot.kp * (target - q) - dynamics.kd * robot.kd * dq
    full = robot.effort_limit * dynamics.motor_strength
    fall = (1.0 - TORQUE_KNEE) * robot.speed_limit
    upper = full * xp.clip((robot.speed_limit - dq) / fall, -1.0, 1.0)
    lower = -full * xp.clip((robot.speed_limit + dq) / fall, -1.0, 1.0)
    return xp.clip(pd, lower, upper) - dynamics.joint_friction * xp.tanh(dq / FRICTION_SPEED)


def motor_damping(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any = jnp):
    """How `motor_torque` falls with joint speed over the coming physics step [16, N m s/rad], from
    its present `torque`.

    The engines take it implicitly: full torque would carry an unloaded shank by 20 rad/s in 5 ms.
    It is `IMPLICIT` times the slope of the chord from the present speed to that at the end of the
    step, so that a joint alone moves by the theta-method.
    """
    change = _speed_ahead(robot, dynamics, q, dq, target, torque, xp) - dq
    change = xp.where(xp.abs(change) < LEAST_CHANGE, LEAST_CHANGE, change)
    then = motor_torque(robot, dynamics, q, dq + change, target, xp)
    return IMPLICIT * (torque - then) / change


def _speed_ahead(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any):
    """Joint speed [16] at the end of the step, were each joint alone with its inertia.

    v = dq + h / inertia ((1 - theta) torque + theta torque(v)), solved for each straight piece of
    the torque's law. The law falls with v, so that the solutions are clipped by each other as the
    pieces are.
    """
    rate = robot.mj_model.opt.timestep / robot.joint_inertia
    start, rate = dq + (1.0 - IMPLICIT) * rate * torque, IMPLICIT * rate
    gain, kd = dynamics.kp * robot.kp, dynamics.kd * robot.kd
    full = robot.effort_limit * dynamics.motor_strength
    slope = full / ((1.0 - TORQUE_KNEE) * robot.speed_limit)
    slowest, fastest = start - rate * full, start + rate * full

    def on_line(torque_at_rest, slope):
        return (start + rate * torque_at_rest) / (1.0 + rate * slope)

    upper = xp.clip(on_line(slope * robot.speed_limit, slope), slowest, fastest)
    lower = xp.clip(on_line(-slope * robot.speed_limit, slope), slowest, fastest)
    return xp.clip(on_line(gain * (target - q), kd), lower, upper)


def servo_control(robot: Robot, torque, damping, q, dq):
    """Control signal that makes position servos kp (ctrl - q) - damping dq give `torque`."""
    return q + (torque + damping * dq) / robot.kp


def drive(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """(motor torque, servos' control, servos' bias on joint speed) of one physics step, [..., 16].

    The last one belongs to `actuator_biasprm[..., SERVO_DAMPING]`.
    """
    torque = motor_torque(robot, dynamics, q, dq, target, xp)
    damping = motor_damping(robot, dynamics, q, dq, target, torque, xp)
    return torque, servo_control(robot, torque, damping, q, dq), -damping


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
    force: jax.Array | None = None,
    alter: Callable[[dict[str, jax.Array]], dict[str, jax.Array]] | None = None,
) -> PhysicsState:
    """Advances one environment by one control step towards the joint targets [16, rad].

    Args:
      config: engine and solver.
      state: before the step.
      target: joint angles [16, rad].
      dynamics: how this robot differs from the described one.
      ground_friction: see `model_fields`.
      force: [nbody, 6] force [N] and torque [N m] on each body at its centre of mass, world frame.
      alter: maps the mjModel fields of `model_fields` to those of a robot that differs in more.
    """
    fields = model_fields(robot_for(config), dynamics, ground_friction)
    fields = alter(fields) if alter else fields
    engine = _step_mujoco if resolve_engine(config) == "mujoco" else _step_mjx
    return engine(config, state, target, dynamics, fields, force)


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
    force: jax.Array | None,
) -> PhysicsState:
    robot = robot_for(config)
    model = _mjx_model(config).replace(**fields)
    data = mjx.make_data(robot.mj_model, device=_own_device(), impl="jax").replace(
        qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart
    )
    if force is not None:
        data = data.replace(xfrc_applied=force)

    def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, jax.Array]:
        torque, ctrl, bias = drive(robot, dynamics, data.qpos[7:], data.qvel[6:], target)
        servos = model.actuator_biasprm.at[:, SERVO_DAMPING].set(bias)
        return mjx.step(model.replace(actuator_biasprm=servos), data.replace(ctrl=ctrl)), torque

    with jax.default_matmul_precision("highest"):
        data, torques = jax.lax.scan(substep, data, None, length=config.decimation)
        data = _refresh_sensors(model, data)
    return PhysicsState(
        qpos=data.qpos,
        qvel=data.qvel,
        qacc_warmstart=data.qacc_warmstart,
        sensordata=data.sensordata,
        torque=torques[-1],
    )


def _refresh_sensors(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Position and velocity sensors at the new state; contact sensors stay the last step's."""
    from mujoco.mjx._src import sensor  # not exported; no public way to run the sensors alone

    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.com_vel(model, data)
    return sensor.sensor_vel(model, sensor.sensor_pos(model, data))


# -------------------------------------------------------------------------------------- mujoco

_batches: dict[Any, mujoco.batch.Batch] = {}
_batches_lock = threading.Lock()


def _batch(robot: Robot, size: int, threads: int, written: frozenset[str]) -> mujoco.batch.Batch:
    """The cached simulator batch of this size; its state and the fields `written` are overwritten
    at every call, all others are the robot's."""
    key = (robot, size, threads, written)
    if key not in _batches:
        _batches[key] = mujoco.batch.Batch(robot.mj_model, size, nthread=threads)
    return _batches[key]


def _step_mujoco(
    config: PhysicsConfig,
    state: PhysicsState,
    target: jax.Array,
    dynamics: Dynamics,
    fields: dict[str, jax.Array],
    force: jax.Array | None,
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
        vmap_method="broadcast_all",
    )


def _host_step(
    config: PhysicsConfig,
    state: PhysicsState,
    target: np.ndarray,
    dynamics: Dynamics,
    fields: dict[str, np.ndarray],
    force: np.ndarray | None,
) -> PhysicsState:
    """numpy in, numpy out: no JAX call in here, it would wait for the program that waits for us."""
    lead = np.shape(target)[:-1]
    robot = robot_for(config)

    def rows(x: Any) -> np.ndarray:
        x = np.asarray(x, np.float64)
        return x.reshape(-1, *x.shape[len(lead) :])

    state, dynamics, fields, force = jax.tree.map(rows, (state, dynamics, fields, force))
    target = rows(target)
    applied = {} if force is None else {"xfrc_applied": force}
    with _batches_lock:
        batch = _batch(robot, len(target), config.threads, frozenset(fields | applied))
        for name, value in applied.items():
            batch.bind(name)[:] = value
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
        return jax.tree.map(lambda x: np.array(x, np.float32).reshape(*lead, *x.shape[1:]), new)
