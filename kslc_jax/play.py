"""Watch a policy: python -m kslc_jax.play POLICY --gait-strip strip.png --speeds 2.0 3.5

Runs the policy in full C MuJoCo at high fidelity and draws, off screen, the paper's gait figure
(the robot every 0.25 s on a 1 m grid, one strip per speed) and, with --video, a film of one speed
after the other. POLICY is a run folder, a checkpoint folder, or a shipped policy's name.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import runtime
from kslc_jax.config import ConfigError, HighFidelity

FPS = 50


@dataclass(frozen=True)
class Args:
    """What to draw."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    speeds: tuple[float, ...] = (2.0, 3.5)
    """Commanded forward speeds [m/s]."""
    seconds: float = 2.0
    """Time shown per speed, after some seconds to gather speed."""
    gait_strip: Path | None = None
    """PNG to write: one strip per speed."""
    video: Path | None = None
    """MP4 to write; needs the package imageio-ffmpeg (pip install 'kslc_jax[video]')."""
    seed: int = 0
    """Of the initial state."""

    def __post_init__(self):
        if self.seconds <= 0 or not self.speeds:
            raise ConfigError("seconds must be positive, and speeds name at least one")
        if self.gait_strip is None and self.video is None:
            raise ConfigError("nothing to do: give --gait-strip, --video, or both")


def record(args: Args, policy, settle: float = 4.0):
    """qpos [T, S, 23] per speed after `settle` seconds, and the control step [s]."""
    import numpy as np

    from kslc_jax import trials

    velocities = np.zeros((len(args.speeds), 3))
    velocities[:, 0] = args.speeds
    engine = HighFidelity()
    setting = trials.Setting(engine, seconds=settle + max(1.0, np.ceil(args.seconds)))
    trace = trials.join(list(trials.run(policy, setting, velocities, args.seed)))
    start = round(settle / engine.control_dt)
    shown = slice(start, start + round(args.seconds / engine.control_dt))
    return trace.qpos[shown], trace.alive[-1], engine.control_dt


def write_video(path: Path, qpos, dt: float) -> None:
    """Films the speeds one after the other at real time."""
    import imageio.v2 as imageio

    from kslc_jax import render

    every = max(1, round(1.0 / (FPS * dt)))
    with imageio.get_writer(str(path), fps=round(1.0 / (every * dt)), macro_block_size=8) as film:
        for i in range(qpos.shape[1]):
            for picture in render.frames(qpos[::every, i]):
                film.append_data(picture)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    runtime.prepare()
    try:
        args = tyro.cli(Args, args=argv, description=__doc__)
        from kslc_jax import render  # before anything that imports mujoco
        from kslc_jax.checkpoint import CheckpointError, load_policy
    except (ConfigError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        policy = load_policy(args.policy)
        qpos, alive, dt = record(args, policy)
        for speed, up in zip(args.speeds, alive, strict=True):
            if not up:
                print(f"warning: fell at {speed:g} m/s")
        if args.gait_strip is not None:
            import matplotlib.image

            strips = [render.gait_strip(qpos[:, i], dt) for i in range(qpos.shape[1])]
            args.gait_strip.parent.mkdir(parents=True, exist_ok=True)
            matplotlib.image.imsave(args.gait_strip, render.stack(strips))
            print(f"wrote {args.gait_strip}")
        if args.video is not None:
            write_video(args.video, qpos, dt)
            print(f"wrote {args.video}")
    except (CheckpointError, ConfigError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
