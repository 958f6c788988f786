"""Watch a policy: python -m kslc_jax.play POLICY

Opens a live viewer in the browser. Its sliders command the robot while it runs, and a button shoves
a link of the robot. With --follow the viewer takes each new policy of a running training. With
--schedule the command changes by itself, until the user moves a slider or presses a key. --punch
and --hold-arms disturb the robot as in kslc_jax.sim2sim. The options --gait-strip and --video draw
off screen instead. --gait-strip draws the paper's gait figure: the robot every 0.25 s on a 1 m
grid, one strip per speed. --video makes a film of one speed after the other. With --schedule both
show the schedule from its start. The default physics is C MuJoCo at high fidelity. Strips and films
can also use Drake. POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.

Examples:
  python -m kslc_jax.play xbot_l_run
  python -m kslc_jax.play runs/laptop-seed0 --follow
  python -m kslc_jax.play xbot_l_run --schedule tour --ground rough:0.03
  python -m kslc_jax.play xbot_l_run --schedule random --top 2 --punch 200 --hold-arms
  python -m kslc_jax.play xbot_l_run --video stop.webp --schedule stop --top 2 --seconds 9
  python -m kslc_jax.play xbot_l_run --gait-strip strip.png --speeds 1 2 3.5
"""

import contextlib
import functools
import ipaddress
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from kslc_jax import cli, files, runtime
from kslc_jax.config import ConfigError, Fidelity, RandomizeConfig, TerrainConfig, require_seed
from kslc_jax.errors import MissingPackage
from kslc_jax.evaluation import options, perturbations
from kslc_jax.viewer import films

if TYPE_CHECKING:
    from kslc_jax.evaluation.schedules import Schedule
    from kslc_jax.policy import Policy

STRIPS = (".png", ".jpg")
"""Suffixes of gait strips."""

SPEEDS = (2.0, 3.5)
"""Speeds of strip and video [m/s] of XBot-L, if none are given."""

SETTLE_SECONDS = 4.0
"""Time in which the robot gathers speed before a strip or video shows it [s]."""

SECONDS, SCHEDULE_SECONDS = 2.0, 10.0
"""Time that strip and video show per speed; of a schedule [s]."""


@dataclass(frozen=True)
class Args:
    """The policy, and the way to watch it."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    fidelity: Fidelity = "high"
    """train: the training engine. high: full C MuJoCo at 1 ms."""
    engine: options.Engine = "mujoco"
    """Physics engine of strip and video; drake is an extra (pip install 'kslc_jax[drake]')."""
    seed: int = 0
    """Seed of the initial state."""
    follow: bool = False
    """Watch a training while it runs. POLICY is then its run folder; the viewer takes each new
    checkpoint or snapshot."""
    host: str = "127.0.0.1"
    """Address of the viewer. Only this machine reaches the default; every machine reaches
    0.0.0.0."""
    port: int = 8080
    """Port of the viewer; 0 takes any free port."""
    ground: str | None = None
    """Uneven ground: rough:M (random waves of up to M metres up and down), slope:DEGREES or
    stairs:M (steps of M metres). The first 0.5 m are flat."""
    schedule: str | None = None
    """Commands that change: stop (top speed 5 s, rest 4 s), reverse (top speed 5 s, backwards 4 s),
    box (a new command as in training every 4 s), random (the same every 1 to 4 s, with stops and
    reversals from the top speed), jitter (as random, every 0.3 to 4 s), turns (at three speeds),
    tour (way-points), or the path of a JSON file (kslc_jax.sim2sim --help describes it)."""
    top: float | None = None
    """Fastest command of the schedule [m/s]; None: the fastest command of the policy's training."""
    punch: float = 0.0
    """Force [N] for 0.08 s at a random link in a random direction every 4 s; the first one comes
    2 s after the start."""
    hold_arms: bool = False
    """The arms follow random targets, at most 0.3 rad/s fast, in place of the policy's actions."""
    speeds: tuple[float, ...] | None = None
    """Commanded forward speeds of strip and video [m/s]; --schedule replaces them. None: 2.0 and
    3.5, scaled to the robot's size."""
    seconds: float | None = None
    """Time that strip and video show. None: 2 s per speed, after 4 s in which the robot gathers
    speed; or 10 s of a schedule, from its start."""
    gait_strip: Path | None = None
    """PNG or JPG to write: one strip per speed."""
    video: Path | None = None
    """Film to write: one speed after the other. MP4, MKV and MOV need the package imageio-ffmpeg
    (pip install 'kslc_jax[video]'). WEBP and GIF need no more packages."""

    def __post_init__(self):
        if not 0 < self.shown_seconds < math.inf:
            raise ConfigError("seconds must be positive")
        options.check_speeds(self.speeds)
        require_seed(self.seed)
        options.check_disturbances(self.punch, self.top, self.schedule is not None)
        videos = films.FILMS + films.ANIMATIONS
        for path, kinds in ((self.gait_strip, STRIPS), (self.video, videos)):
            files.require_suffix(path, kinds)
        if self.engine != "mujoco" and self.fidelity != "high":
            raise ConfigError(f"engine: {self.engine} takes the robot at --fidelity high only")
        if self.terrain and self.engine != "mujoco":
            raise ConfigError(f"ground: {self.engine} has the flat floor only")
        if self.punch and self.engine != "mujoco":
            raise ConfigError(f"punch: {self.engine} knows no forces on links")
        if not 0 <= self.port < 2**16:
            raise ConfigError("port must lie in 0 to 65535")
        if self.follow and not self.live:
            raise ConfigError("follow is for the live viewer, not for --gait-strip and --video")
        if self.live and self.engine != "mujoco":
            raise ConfigError(f"engine: {self.engine} is for --gait-strip and --video only")

    @property
    def live(self) -> bool:
        """True if the command opens the viewer."""
        return self.gait_strip is None and self.video is None

    @property
    def terrain(self) -> TerrainConfig | None:
        """Uneven ground; None: the flat floor."""
        return perturbations.terrain(self.ground) if self.ground else None

    @property
    def shown_seconds(self) -> float:
        """Time that strip and video show [s]."""
        if self.seconds is not None:
            return self.seconds
        return SECONDS if self.schedule is None else SCHEDULE_SECONDS


def plan(args: Args, policy: "Policy") -> "Schedule | None":
    """The schedule of `args` for a policy. ConfigError if there is no such schedule."""
    from kslc_jax.evaluation import schedules

    if args.schedule is None:
        return None
    v_max = float(policy.curriculum.v_max)
    return schedules.named(args.schedule, policy.config, v_max, args.top)


def randomize(args: Args) -> RandomizeConfig:
    """The disturbances of `args`."""
    from kslc_jax.evaluation import trials

    return perturbations.disturbed(trials.NOMINAL, args.punch, args.hold_arms)


def speeds_of(args: Args, policy: "Policy") -> tuple[float, ...]:
    """The commanded speeds [m/s] of strip and video."""
    return options.speeds_for(policy.config.physics.robot, args.speeds, SPEEDS)


# ---------------------------------------------------------------------------------------- pictures


def record(args: Args, policy):
    """(trace [T, S, ...], number of its first step to show, length of a control step [s]).

    S is the number of speeds, or 1 for a schedule.
    """
    import jax
    import numpy as np

    from kslc_jax import physics
    from kslc_jax.evaluation import trials

    schedule = plan(args, policy)
    speeds, settle = ((0.0,), 0.0) if schedule else (speeds_of(args, policy), SETTLE_SECONDS)
    velocities = np.zeros((len(speeds), 3))
    velocities[:, 0] = speeds
    engine = trials.engine(policy, args.fidelity, args.terrain)
    setting = trials.Setting(
        engine,
        randomize(args),
        seconds=settle + max(1.0, np.ceil(args.shown_seconds)),
        simulate=options.simulator(args.engine),
        schedule=schedule,
    )
    robot = physics.robot_for(engine)
    options.require_engine(args.engine, robot)
    trials.require(setting, robot)
    trace = trials.join(list(trials.run(policy, setting, velocities, args.seed)))
    start = round(settle / engine.control_dt)
    stop = start + round(args.shown_seconds / engine.control_dt)
    return jax.tree.map(lambda x: x[:stop], trace), start, engine.control_dt


def draw(args: Args, policy) -> None:
    """Writes the gait strip and the video that `args` names."""
    import matplotlib.image

    from kslc_jax.viewer import render

    if args.video is not None and args.video.suffix.lower() in films.FILMS:
        films.film_writer()
    render.require_gl()  # before the simulation, which takes a minute
    trace, start, dt = record(args, policy)
    robot = render.shown_robot(policy, args.terrain)
    tried = (
        [args.schedule]
        if args.schedule
        else [f"{speed:g} m/s" for speed in speeds_of(args, policy)]
    )
    for name, up in zip(tried, trace.alive[-1], strict=True):
        if not up:
            print(f"warning: fell at {name}; what is shown ends there")
    spans = [films.shown(trace.alive[:, i], start) for i in range(len(tried))]
    if args.gait_strip is not None:
        strips = [
            render.gait_strip(robot, trace.qpos[s, i], dt, ground=films.ground_of(trace, s, i))
            for i, s in enumerate(spans)
        ]
        with files.saving(args.gait_strip) as part:
            matplotlib.image.imsave(part, render.stack(strips))
        print(f"wrote {args.gait_strip}")
    if args.video is not None:
        with files.saving(args.video) as part:
            films.write_video(part, robot, trace, spans, dt)
        print(f"wrote {args.video}")


# ------------------------------------------------------------------------------------------ viewer


def is_local(host: str) -> bool:
    """True if only this machine reaches the address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def watch(args: Args) -> None:
    """Serves the viewer until Ctrl-C."""
    try:
        from kslc_jax.viewer.app import Viewer
    except ImportError as error:
        raise MissingPackage(f"the viewer: {error} (pip install 'kslc_jax[viewer]')") from error

    if not is_local(args.host):
        print(f"warning: {args.host} is not localhost; others on the network can open the viewer")
    with contextlib.suppress(KeyboardInterrupt):
        how = (args.fidelity, args.host, args.port, args.seed, args.follow, args.terrain)
        made = functools.partial(plan, args)
        viewer = Viewer(args.policy, *how, plan=made, randomize=randomize(args))
        host = "localhost" if is_local(args.host) else args.host
        print(f"viewer: http://{host}:{viewer.server.get_port()} (Ctrl-C ends it)", flush=True)
        viewer.run()


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _play(cli.parse("play", Args, argv, __doc__)))


def _play(args: Args) -> None:
    if args.live:
        watch(args)
        return
    runtime.choose_gl()  # before anything that imports mujoco
    for path in (args.gait_strip, args.video):
        files.require_writable(path)
    options.simulator(args.engine)  # fails now if the engine's package is missing
    from kslc_jax.policy import load_policy

    draw(args, load_policy(args.policy))


if __name__ == "__main__":
    sys.exit(main())
