"""Replays a golden trace against a program that runs an exported policy (docs/export.md).

python examples/check_trace.py policy.onnx
python examples/check_trace.py policy.onnx --program my_controller.py

`export` has written policy.npz and policy.json beside policy.onnx. The program is a Python file
with a class `Controller(path, vx, vy, heading)`. It has `phase`, that of the gait clock, `action`,
the last action [n], and `targets(quat, angvel, joint_pos, joint_vel)`, which returns the joint
targets [n, rad] of one control step. The checker sets `action` to the recorded one after each
step: else the rounding of one step would grow over the next ones.

The default program is the runner beside this file. The exit code is 0 if all targets agree, else 1.
"""

import argparse
import hashlib
import json
import runpy
import sys
from pathlib import Path

import numpy as np

MEASURED = "quat", "angvel", "joint_pos", "joint_vel"


def foreign_file(policy):
    """The first file beside `policy` that another export has written; None if there is none."""
    stored = json.loads(Path(policy).with_suffix(".json").read_text()).get("sha256", {})
    for suffix, digest in stored.items():
        path = Path(policy).with_suffix(suffix)
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            return path
    return None


def first_difference(controller_class, policy, tolerance):
    """A sentence on the first target that differs by more than `tolerance` [rad]; None if none."""
    trace = np.load(Path(policy).with_suffix(".npz"))
    data = json.loads(Path(policy).with_suffix(".json").read_text())
    for trial, (command, phase, steps) in enumerate(
        zip(trace["command"], trace["phase"], trace["steps"], strict=True)
    ):
        controller = controller_class(str(policy), *map(float, command))
        controller.phase = float(phase)
        for step in range(steps):
            measured = (trace[name][trial, step].astype(float) for name in MEASURED)
            wanted, found = trace["target"][trial, step], controller.targets(*measured)
            worst = int(np.argmax(np.abs(wanted - found)))
            if not np.abs(wanted - found)[worst] <= tolerance:
                return (
                    f"trial {trial} (vx {command[0]:.2f} m/s), step {step} "
                    f"({step * data['control_dt']:.2f} s): {data['joint_names'][worst]} should go "
                    f"to {wanted[worst]:.4f} rad, not to {found[worst]:.4f}"
                )
            controller.action = trace["action"][trial, step].astype(float)
    return None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policy", help="file written by python -m kslc_jax.export")
    parser.add_argument("--program", default=Path(__file__).with_name("onnx_runner.py"))
    parser.add_argument("--tolerance", type=float, default=1e-4, help="rad")
    args = parser.parse_args()
    beside = (Path(args.policy).with_suffix(suffix) for suffix in (".npz", ".json"))
    for path in (args.policy, args.program, *beside):
        if not Path(path).is_file():
            parser.error(f"no file '{path}'")
    if foreign := foreign_file(args.policy):
        print(f"warning: '{foreign}' is not the file that export wrote with the others")
    controller = runpy.run_path(str(args.program))["Controller"]
    difference = first_difference(controller, args.policy, args.tolerance)
    print(difference or "all targets agree")
    sys.exit(1 if difference else 0)
