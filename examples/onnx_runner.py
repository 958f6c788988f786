"""Runs an exported policy as a robot's own computer would: numpy, onnxruntime and mujoco, no JAX.

  python examples/onnx_runner.py policy.onnx --vx 1.0 --seconds 10

All numbers come from the file's metadata (docs/export.md), the robot from an MJCF.
"""

import argparse
import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import onnxruntime

XBOT_L = Path(__file__).resolve().parents[1] / "kslc_jax" / "assets" / "xbot_l.xml"


class Controller:
    """Measurements in, joint targets out, once per control step; keeps clock and history."""

    def __init__(self, path, vx, vy=0.0, heading=0.0):
        self.network = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        stored = self.network.get_modelmeta().custom_metadata_map
        if stored.get("metadata_version") != "1":
            raise SystemExit(f"error: {path} has no metadata of version 1, see docs/export.md")
        self.meta = m = SimpleNamespace(**{k: json.loads(v) for k, v in stored.items()})
        self.velocity, self.heading = np.array([vx, vy]), heading
        self.free = np.array([name not in m.held_joints for name in m.joint_names])
        self.action, self.phase = np.zeros(len(m.joint_names)), 0.0
        self.history = np.zeros((m.history_length, sum(c["width"] for c in m.frame)), np.float32)

    def frame(self, quat, angvel, joint_pos, joint_vel):
        """Observation of one instant: base attitude (w, x, y, z), base rates in its own frame."""
        m, (w, x, y, z) = self.meta, quat
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        limit = m.command["max_yaw_rate"]
        error = (self.heading - yaw + np.pi) % (2 * np.pi) - np.pi
        rate = np.clip(m.command["heading_gain"] * error, -limit, limit)
        stands = m.command["stand_still"] and not self.velocity.any()
        moving = not (stands and abs(rate) <= m.command["turning"])
        angle = 2 * np.pi * self.phase
        values = {
            "clock": np.array([np.sin(angle), np.cos(angle)]) * moving,
            "command": np.array([*self.velocity, rate]) * moving,
            "joint_pos": joint_pos,
            "joint_vel": joint_vel,
            "last_action": self.action,
            "base_angvel": angvel,
            "base_euler": np.array([roll, pitch, yaw]),
        }
        frame = np.concatenate([values[c["name"]] * np.asarray(c["scale"]) for c in m.frame])
        return np.clip(frame, -m.observation_clip, m.observation_clip)

    def targets(self, *measured):
        """Joint targets [rad] until the next control step; advances clock and history."""
        m, gait = self.meta, self.meta.gait
        self.history = np.vstack([self.history[1:], self.frame(*measured)]).astype(np.float32)
        action = np.asarray(self.network.run(["action"], {"history": self.history[None]}))[0, 0]
        self.action = np.clip(action, -m.action_clip, m.action_clip) * self.free
        share = min(abs(self.velocity[0]) / gait["v_max"], 1.0)
        share = share if gait["cycle_follows_speed"] else 1.0
        cycle = gait["base_cycle_time"] + share * (gait["cycle_time"] - gait["base_cycle_time"])
        self.phase = (self.phase + m.control_dt / cycle) % 1.0
        return m.default_joint_pos + m.action_scale * self.action


def motor_torque(m, target, q, dq):
    """PD torque [N m]; driving torque falls to zero at the speed limit and brakes beyond it."""
    pd = np.asarray(m.kp) * (target - q) - np.asarray(m.kd) * dq
    full, top = np.asarray(m.effort_limit), np.asarray(m.speed_limit)
    upper, lower = ((top - s * dq) / ((1 - m.torque_knee) * top) for s in (1, -1))
    return np.clip(pd, -full * np.clip(lower, -1, 1), full * np.clip(upper, -1, 1))


def simulate(controller, model, seconds):
    """Base positions [T, 3] at each control step until the time is over or the robot has fallen."""
    m, data = controller.meta, mujoco.MjData(model)
    joints = [model.joint(name).id for name in m.joint_names]
    motors = [int(np.flatnonzero(model.actuator_trnid[:, 0] == j)[0]) for j in joints]
    at, dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    # The limits are motor_torque's; any actuator that is affine in (q, dq) is solved for its ctrl.
    model.actuator_forcelimited[:] = 0
    gain, bias = model.actuator_gainprm[motors, 0], model.actuator_biasprm[motors].T
    data.qpos[at] = m.default_joint_pos
    track = [data.qpos[:3].copy()]
    for _ in range(round(seconds / m.control_dt)):
        target = controller.targets(data.qpos[3:7], data.qvel[3:6], data.qpos[at], data.qvel[dof])
        for _ in range(round(m.control_dt / model.opt.timestep)):
            q, dq = data.qpos[at], data.qvel[dof]
            torque = motor_torque(m, target, q, dq)
            data.ctrl[motors] = (torque - bias[0] - bias[1] * q - bias[2] * dq) / gain
            mujoco.mj_step(model, data)
        track.append(data.qpos[:3].copy())
        if fallen(track):
            break
    return np.array(track)


def fallen(track):
    """Whether the base has sunk to half of its first height."""
    return track[-1][2] < 0.5 * track[0][2]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="file written by python -m kslc_jax.export")
    parser.add_argument("--mjcf", default=str(XBOT_L), help="robot and floor")
    parser.add_argument("--vx", type=float, default=1.0, help="commanded forward speed [m/s]")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    for path in (args.policy, args.mjcf):
        if not Path(path).is_file():
            parser.error(f"no file '{path}'")
    controller = Controller(args.policy, args.vx)
    track = simulate(controller, mujoco.MjModel.from_xml_path(args.mjcf), args.seconds)
    dt, x = controller.meta.control_dt, track[len(track) // 2 :, 0]
    print(f"mean forward speed over the second half: {np.diff(x).mean() / dt:.2f} m/s")
    print(f"fell after {(len(track) - 1) * dt:.2f} s" if fallen(track) else "did not fall")


if __name__ == "__main__":
    main()
