"""Runs an exported policy on its robot in MuJoCo, with numpy and onnxruntime, without JAX.

See docs/export.md.

python examples/onnx_runner.py policy.onnx --vx 1.0 --seconds 10
"""

import argparse
import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import onnxruntime

STOP = 0.9  # share of the dead zone below which a walking robot stops


class Controller:
    """Computes joint targets from measurements, once per control step.

    Its state is the gait clock, the history of frames and the last action.
    """

    def __init__(self, path, vx, vy=0.0, heading=0.0):
        one = onnxruntime.SessionOptions()
        one.intra_op_num_threads = 1  # the network is small; more threads only wait
        self.network = onnxruntime.InferenceSession(path, one, providers=["CPUExecutionProvider"])
        text = self.network.get_modelmeta().custom_metadata_map
        if text.get("metadata_version") != "5":
            raise SystemExit(f"error: {path} has no metadata of version 5, see docs/export.md")
        m = {k: json.loads(v, object_hook=lambda x: SimpleNamespace(**x)) for k, v in text.items()}
        self.meta = m = SimpleNamespace(**m)
        self.wanted = self.velocity = np.zeros(2)
        self.heading, self.turns = heading, True
        self.phase = 0.0
        self.command(vx, vy, heading)
        self.free = np.array([name not in m.held_joints for name in m.joint_names])
        self.action = np.zeros(len(m.joint_names))
        self.history = np.zeros((m.history_length, sum(c.width for c in m.frame)), np.float32)

    def command(self, vx, vy=0.0, heading=0.0):
        """Sets the command: vx, vy [m/s], heading [rad].

        Walking begins above the dead zone and ends below 0.9 times it. So a trembling joystick at
        the edge of the dead zone does not start and stop the robot. While a command holds, a turn
        on the spot that has ended does not begin again; a new command may begin one.
        """
        before = *self.wanted, self.heading
        speed, edge = np.hypot(vx, vy), self.meta.command.dead_zone
        walks = speed > (STOP if self.wanted.any() else 1) * edge
        self.wanted = np.array([vx, vy]) * max(edge / speed, 1) if walks else np.zeros(2)
        self.heading = heading
        self.turns |= (*self.wanted, heading) != before
        self.approach(0.0)

    def approach(self, dt):
        """Moves the velocity towards the wanted one, for `dt` seconds."""
        way, acceleration = self.wanted - self.velocity, self.meta.command.acceleration
        share = acceleration * dt / max(np.hypot(*way), 1e-6) if acceleration else 1
        self.velocity = self.velocity + way * min(share, 1)

    def frame(self, quat, angvel, joint_pos, joint_vel):
        """The observation frame of one control step.

        quat: base orientation (w, x, y, z). angvel: [3] rad/s, in the base frame. joint_pos,
        joint_vel: [n] rad and rad/s.
        """
        m, (w, x, y, z) = self.meta, quat
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        rate = m.command.heading_gain * ((self.heading - yaw + np.pi) % (2 * np.pi) - np.pi)
        rate = np.clip(rate, -m.command.max_yaw_rate, m.command.max_yaw_rate)
        walks = self.wanted.any() or self.velocity.any()
        self.turns &= abs(rate) > m.command.turning
        moving = not m.command.stand_still or walks or self.turns
        angle = 2 * np.pi * self.phase
        offset = joint_pos - np.array(m.default_joint_pos)
        values = dict(joint_pos=offset, joint_vel=joint_vel, last_action=self.action)
        values |= dict(base_angvel=angvel, base_euler=np.array([roll, pitch, yaw]))
        values["clock"] = moving * np.array([np.sin(angle), np.cos(angle)])
        values["command"] = moving * np.array([*self.velocity, rate])
        frame = np.concatenate([values[c.name] * np.array(c.scale) for c in m.frame])
        return np.clip(frame, -m.observation_clip, m.observation_clip)

    @staticmethod
    def cycle(gait, speed):
        """Duration [s] of a gait cycle at a commanded forward speed [m/s]."""
        if gait.cycle_from_speed > 0:
            steps = max(speed - gait.cycle_from_speed, 0) / gait.speed_step
            return max(gait.base_cycle_time * gait.cycle_factor**steps, gait.cycle_time)
        share = min(speed / gait.v_max, 1) if gait.cycle_follows_speed else 1
        return gait.base_cycle_time + share * (gait.cycle_time - gait.base_cycle_time)

    def targets(self, *measured, dt=None):
        """Joint targets [n, rad] until the next control step; advances clock and history.

        measured: the arguments of `frame`. dt: the time until the next control step [s]; the
        default is the control step of the training.
        """
        m, gait = self.meta, self.meta.gait
        self.history = np.vstack([self.history[1:], self.frame(*measured)]).astype(np.float32)
        action = np.array(self.network.run(["action"], {"history": self.history[None]})[0])[0]
        self.action = np.clip(action, -m.action_clip, m.action_clip) * self.free
        dt = dt or m.control_dt
        self.approach(dt)
        self.phase = (self.phase + dt / self.cycle(gait, abs(self.velocity[0]))) % 1
        return m.default_joint_pos + np.array(m.action_scale) * self.action


def motor_torque(m, target, q, dq):
    """PD torque [n, N m] within the motors' limits.

    Near the speed limit the driving torque falls to zero. Beyond the limit the motor brakes.
    """
    full, fall = np.array(m.effort_limit), (1 - m.corner_speed) * np.array(m.speed_limit)
    upper, lower = (full * np.clip((m.speed_limit - s * dq) / fall, -1, 1) for s in (1, -1))
    return np.clip(m.kp * (target - q) - m.kd * dq, -lower, upper)


def steps_per_control(control_dt, timestep):
    """Number of physics steps in a control step; an error if they do not fill it exactly."""
    steps = max(1, round(control_dt / timestep))
    if abs(steps * timestep - control_dt) > 1e-6 * control_dt:
        raise SystemExit(
            f"error: timestep {timestep:g} s does not divide the control step, {control_dt:g} s"
        )
    return steps


def difference(m, model):
    """How the robot of a model differs from the policy's, whose metadata are `m`; None if equal.

    The joints, and the servos that drive them, must have the policy's order and gains.
    """
    joints = [model.joint(i).name for i in range(model.njnt)][1:]  # the first one is the base's
    kinds = zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    driven = [model.joint(i).name if k == mujoco.mjtTrn.mjTRN_JOINT else None for k, i in kinds]
    for what, names in (("joint", joints), ("the joint of actuator", driven)):
        for i, (found, wanted) in enumerate(itertools.zip_longest(names, m.joint_names)):
            if found != wanted:
                return f"{what} {i} is {found}, not {wanted}"
    gains = np.stack([model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 1]])
    wrong = ~np.isclose(gains, m.kp, rtol=1e-4)  # an exported MJCF has six digits
    if not wrong.any():
        return None
    row, i = np.argwhere(wrong)[0]
    return f"the gain of {m.joint_names[i]} is {gains[row, i]:g}, not {m.kp[i]:g}"


def simulate(controller, model, seconds):
    """Base positions [T, 3, m] at each control step, until the time ends or the robot falls."""
    m, data = controller.meta, mujoco.MjData(model)
    steps = steps_per_control(m.control_dt, model.opt.timestep)
    quat, angvel, q, dq = data.qpos[3:7], data.qvel[3:6], data.qpos[7:], data.qvel[6:]  # views
    q[:], track = m.default_joint_pos, [data.qpos[:3].copy()]
    model.actuator_forcelimited[:] = 0  # motor_torque limits the torque
    damping = 0.6 * np.array(m.kd)  # integrated implicitly, as in the package away from the limits
    model.actuator_biasprm[:, 2] = -damping
    while len(track) <= round(seconds / m.control_dt) and track[-1][2] > track[0][2] / 2:
        target = controller.targets(quat, angvel, q, dq, dt=steps * model.opt.timestep)
        for _ in range(steps):
            torque = motor_torque(m, target, q, dq)
            data.ctrl = q + (torque + damping * dq) / m.kp  # servos: kp (ctrl - q) - damping dq
            mujoco.mj_step(model, data)
        track.append(data.qpos[:3].copy())
    return np.array(track)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="file written by python -m kslc_jax.export")
    parser.add_argument("--vx", type=float, default=1.0, help="commanded forward speed [m/s]")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--model", help="the robot's MJCF; the file that lies beside the policy")
    args = parser.parse_args()
    mjcf = Path(args.model or Path(args.policy).with_suffix(".xml"))
    for path in (Path(args.policy), mjcf):
        if not path.is_file():
            parser.error(f"no file '{path}'")
    model, controller = mujoco.MjModel.from_xml_path(str(mjcf)), Controller(args.policy, args.vx)
    if found := difference(controller.meta, model):
        parser.exit(2, f"error: {mjcf} is not the robot of {args.policy}: {found}\n")
    model.opt.timestep = 0.001  # with 5 ms the motors cannot keep a shank within its speed limit
    track, dt = simulate(controller, model, args.seconds), controller.meta.control_dt
    speed = np.diff(track[len(track) // 2 :, 0]).mean() / dt
    print(f"mean forward speed over the second half: {speed:.2f} m/s")
    fell = track[-1, 2] <= track[0, 2] / 2
    print(f"fell after {(len(track) - 1) * dt:.2f} s" if fell else "did not fall")
