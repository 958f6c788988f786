"""The same robot as a Gymnasium environment in numpy and C MuJoCo, in the usual hand-written style.

Physics, motors, control rate, frames and histories give the same numbers as ours. Otherwise it does
less work than our environment, which favours it in a comparison: no domain randomisation, no
pushes, and only a dozen reward terms. It is for timing, not for training.
"""

import copy
import math
from typing import Any

import gymnasium
import mujoco
import numpy as np

from kslc_jax import motors, observations, robot
from kslc_jax.config import Config
from kslc_jax.gait import LEG, pattern
from kslc_jax.signals import CONTACT_FORCE

Observation = dict[str, np.ndarray]


class NominalMotors:
    """`randomize.nominal` in numpy."""

    kp = kd = motor_strength = 1.0
    joint_friction = 0.0


class XBot(gymnasium.Env[Observation, np.ndarray]):
    """One robot under one commanded velocity per episode."""

    def __init__(self, config: Config, seed: int = 0):
        self.config = config
        self.robot = robot.load(
            "train",
            config.physics.timestep,
            config.physics.iterations,
            config.physics.ls_iterations,
            config.physics.cone,
            config.physics.robot,
        )
        frames = observations.actor_table(self.robot), observations.critic_table(self.robot)
        self.model = copy.copy(self.robot.mj_model)  # its servos change at every step
        self.data = mujoco.MjData(self.model)
        self.rng = np.random.default_rng(seed)
        shapes = {
            "policy": (config.env.frames, observations.width(frames[0])),
            "critic": (config.env.privileged_frames, observations.width(frames[1])),
        }
        self.observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-np.inf, np.inf, shape) for name, shape in shapes.items()}
        )
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.robot.count,))
        self._history = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        self._scale = {
            "policy": observations.row(frames[0], "scale"),
            "critic": observations.row(frames[1], "scale"),
        }
        noise = observations.row(frames[0], "noise") * self._scale["policy"]
        self._noise = config.env.noise_level * noise
        self._legs = [pattern(self.robot, side, LEG) for side in ("left", "right")]
        self._slices = {
            name: [self.robot.sensor(f"{side}_foot_{name}") for side in ("left", "right")]
            for name in ("pos", "touch")
        }
        self._momentum = self.robot.sensor("angmom")
        self._torso = (self.robot.torso_box_center, self.robot.torso_box_half_size)

    def reset(self, *, seed: int | None = None, options: Any = None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        mujoco.mj_resetData(self.model, self.data)
        noise = self.config.env.reset_joint_noise
        self.data.qpos[:] = self.robot.default_qpos
        self.data.qpos[7:] += self.rng.uniform(-noise, noise, self.robot.count)
        self.action = np.zeros(self.robot.count)
        self.last_action = np.zeros(self.robot.count)
        self.command = np.array([self.rng.uniform(0.0, 1.0), self.rng.uniform(-0.3, 0.3), 0.0])
        self.time = 0
        for history in self._history.values():
            history[:] = 0.0
        self._read()
        return self._observe(), {}

    def step(self, action: np.ndarray):
        config = self.config
        action = np.clip(action, -config.env.action_clip, config.env.action_clip)
        delay = config.env.action_delay * self.rng.random()
        action = (1.0 - delay) * action + delay * self.action
        action *= 1.0 + config.env.action_noise * self.rng.standard_normal(self.robot.count)
        self.last_action, self.action = self.action, action
        joint_vel = self.data.qvel[6:].copy()
        scale = motors.action_scale(config.env, self.robot)
        self.simulate(self.robot.default_qpos[7:] + scale * action)
        self.time += 1
        self._read()
        terminated = self._torso_height() < 0.0
        truncated = self.time >= config.episode_steps and not terminated
        reward = self._reward(joint_vel)
        return self._observe(), reward, terminated, truncated, {}

    def simulate(self, target: np.ndarray) -> None:
        """One control step of the physics towards the joint targets [n, rad]."""
        data, servos = self.data, self.model.actuator_biasprm
        for _ in range(self.config.physics.decimation):
            self.torque, data.ctrl[:], servos[:, motors.SERVO_DAMPING] = motors.drive(
                self.robot, NominalMotors, data.qpos[7:], data.qvel[6:], target, np
            )
            mujoco.mj_step(self.model, data)

    def _read(self) -> None:
        """Computes the signals that observations and rewards share."""
        data, config = self.data, self.config
        w, x, y, z = quat = data.qpos[3:7]
        self.euler = np.array(
            [
                math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
                math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
                math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            ]
        )
        self.linvel, self.up, inverse = np.zeros(3), np.zeros(3), np.zeros(4)
        mujoco.mju_negQuat(inverse, quat)
        mujoco.mju_rotVecQuat(self.linvel, data.qvel[:3], inverse)
        mujoco.mju_rotVecQuat(self.up, np.array([0.0, 0.0, 1.0]), inverse)
        self.angvel = data.qvel[3:6].copy()
        self.foot_z = np.array([data.sensordata[s][2] for s in self._slices["pos"]])
        touch = np.array([data.sensordata[s][0] for s in self._slices["touch"]])
        self.contact = touch > CONTACT_FORCE
        angle = 2.0 * math.pi * self.time * config.control_dt / config.gait.cycle_time
        self.clock = np.array([math.sin(angle), math.cos(angle)])
        both = abs(self.clock[0]) < config.gait.double_support
        self.stance = np.array([self.clock[0] >= 0.0 or both, self.clock[0] < 0.0 or both])
        s = 0.0 if both else self.clock[0]
        left, right = self._legs
        leg = config.gait.reference_scale
        self.reference = leg * (left * min(s, 0.0) + right * max(s, 0.0))

    def _observe(self) -> Observation:
        """Appends the present frames; returns copies of the histories [K, W] and [Kp, W]."""
        joint_pos = self.data.qpos[7:] - self.robot.default_qpos[7:]
        joint_vel = self.data.qvel[6:]
        shared = [self.clock, self.command, joint_pos, joint_vel, self.action]
        actor = np.concatenate([*shared, self.angvel, self.euler]) * self._scale["policy"]
        actor += self._noise * self.rng.standard_normal(len(actor))
        mass = self.model.body_mass[self.robot.trunk_body_id]
        critic = np.concatenate(
            [
                *shared,
                joint_pos - self.reference,
                self.linvel,
                self.angvel,
                self.euler,
                np.zeros(5),
                [1.0, mass],
                self.stance,
                self.contact,
            ]
        )
        limit = self.config.env.observation_clip
        frames = {"policy": actor, "critic": critic * self._scale["critic"]}
        for name, frame in frames.items():
            history = self._history[name]
            history[:-1] = history[1:]
            history[-1] = np.clip(frame, -limit, limit)
        return {name: history.copy() for name, history in self._history.items()}

    def _torso_height(self) -> float:
        """Height of the torso box's lowest corner above the ground [m]."""
        centre, half = self._torso
        return self.data.qpos[2] + self.up @ centre - np.abs(self.up) @ half

    def _reward(self, last_joint_vel: np.ndarray) -> float:
        """The weighted sum of a dozen terms."""
        c, w, dt = self.config.rewards, self.config.rewards.weights, self.config.control_dt
        joint_pos = self.data.qpos[7:] - self.robot.default_qpos[7:]
        joint_vel = self.data.qvel[6:]
        error = np.linalg.norm(joint_pos - self.reference)
        height = (
            self.data.qpos[2]
            - (self.foot_z @ self.stance) / self.stance.sum()
            + self.robot.sole_drop
        )
        momentum = np.linalg.norm(self.data.sensordata[self._momentum]) / c.momentum_scale
        jerk = self.action - self.last_action
        total = (
            w.tracking_lin_vel
            * math.exp(-c.tracking_sigma * ((self.command - self.linvel)[:2] ** 2).sum())
            + w.tracking_ang_vel
            * math.exp(-c.tracking_sigma * (self.command[2] - self.angvel[2]) ** 2)
            + w.joint_pos * (math.exp(-c.joint_pos_kernel * error) - c.joint_pos_penalty * error)
            + w.orientation * math.exp(-10.0 * np.abs(self.euler[:2]).sum())
            + w.base_height * math.exp(-c.base_height_kernel * abs(height - c.base_height_target))
            + w.feet_contact_number * np.where(self.contact == self.stance, 1.0, -0.3).mean()
            + w.angular_momentum * max(1.0 - math.exp(min(momentum, 3.0)), c.momentum_floor)
            + w.default_joint_pos * math.exp(-np.abs(joint_pos).sum())
            + w.action_smoothness * (jerk @ jerk)
            + w.torques * (self.torque @ self.torque)
            + w.dof_vel * (joint_vel @ joint_vel)
            + w.dof_acc * (((joint_vel - last_joint_vel) / dt) ** 2).sum()
        )
        return max(total * dt, 0.0)
