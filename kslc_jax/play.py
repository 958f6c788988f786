"""Watch a policy: python -m kslc_jax.play POLICY

Opens a live viewer in the browser. Its sliders command the robot while it runs. With --follow the
viewer takes each new policy of a running training. The options --gait-strip and --video draw off
screen instead. --gait-strip draws the paper's gait figure: the robot every 0.25 s on a 1 m grid,
one strip per speed. --video makes a film of one speed after the other. The default physics is C
MuJoCo at high fidelity. Strips and films can also use Drake. POLICY is a run folder, a checkpoint
folder, or the name of a shipped policy.
"""

import contextlib
import ipaddress
import math
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from kslc_jax import cli, files, runtime, sim2sim
from kslc_jax.config import ConfigError, Fidelity, TerrainConfig, require_seed
from kslc_jax.errors import MissingPackage
from kslc_jax.evaluation import perturbations

FPS = 50

STRIPS = (".png", ".jpg")
FILMS = (".mp4", ".mkv", ".mov")
ANIMATIONS = (".webp", ".gif")
"""Suffixes of films that web pages show like pictures. They need no ffmpeg. They have half the
frames."""

QUALITY = 60
"""Quality of an animation, 0 to 100. With it, six seconds take about 1 MB."""

SPEED_SECONDS = 0.5
"""Window for the mean speed that the video shows as text [s]."""


@dataclass(frozen=True)
class Args:
    """The policy, and the way to watch it."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    fidelity: Fidelity = "high"
    """train: the training engine. high: full C MuJoCo at 1 ms."""
    engine: sim2sim.Engine = "mujoco"
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
    speeds: tuple[float, ...] = (2.0, 3.5)
    """Commanded forward speeds of strip and video [m/s]."""
    seconds: float = 2.0
    """Time that strip and video show per speed. It starts after the robot has gathered speed."""
    gait_strip: Path | None = None
    """PNG or JPG to write: one strip per speed."""
    video: Path | None = None
    """Film to write: one speed after the other. MP4, MKV and MOV need the package imageio-ffmpeg
    (pip install 'kslc_jax[video]'). WEBP and GIF need no more packages."""

    def __post_init__(self):
        if not 0 < self.seconds < math.inf:
            raise ConfigError("seconds must be positive")
        if not (self.speeds and all(map(math.isfinite, self.speeds))):
            raise ConfigError("speeds: name at least one, finite")
        require_seed(self.seed)
        for path, kinds in ((self.gait_strip, STRIPS), (self.video, FILMS + ANIMATIONS)):
            if path is not None and path.suffix.lower() not in kinds:
                raise ConfigError(f"{path}: its name must end in {' or '.join(kinds)}")
        if self.engine != "mujoco" and self.fidelity != "high":
            raise ConfigError(f"engine: {self.engine} takes the robot at --fidelity high only")
        if self.terrain and self.engine != "mujoco":
            raise ConfigError(f"ground: {self.engine} has the flat floor only")
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


# ---------------------------------------------------------------------------------------- pictures


def record(args: Args, policy, settle: float = 4.0):
    """(trace [T, S, ...], number of steps in `settle` seconds, length of a control step [s])."""
    import jax
    import numpy as np

    from kslc_jax.evaluation import trials

    velocities = np.zeros((len(args.speeds), 3))
    velocities[:, 0] = args.speeds
    engine = trials.engine(policy, args.fidelity, args.terrain)
    setting = trials.Setting(
        engine,
        seconds=settle + max(1.0, np.ceil(args.seconds)),
        simulate=sim2sim.simulator(args.engine),
    )
    trace = trials.join(list(trials.run(policy, setting, velocities, args.seed)))
    start = round(settle / engine.control_dt)
    stop = start + round(args.seconds / engine.control_dt)
    return jax.tree.map(lambda x: x[:stop], trace), start, engine.control_dt


def shown(alive, start: int) -> range:
    """The steps of one trial to show, from `alive` [T].

    These are the steps from `start` on. If the robot fell, they are as many steps, or all if there
    are fewer, up to its fall.
    """
    steps = len(alive)
    fall = steps if alive[-1] else int(alive.argmin())
    return range(max(0, fall - (steps - start)), fall) if fall else range(1)


def caption(picture, text: str):
    """The picture [H, W, 3] with `text` in its upper left corner."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = image.height // 20
    ImageDraw.Draw(image).multiline_text(
        (size, size),
        text,
        fill="white",
        stroke_fill="black",
        stroke_width=size // 10,
        font=ImageFont.load_default(size),
    )
    return np.asarray(image)


def film_writer():
    """The module imageio. If it is missing, MissingPackage says what to install."""
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401 (its own error is clearer than imageio's)
    except ImportError as error:
        raise MissingPackage(f"films: {error} (pip install 'kslc_jax[video]')") from error
    return imageio


def ground_of(trace, steps: range, trial: int):
    """The ground [len(steps)] of one trial of the trace; None on the flat floor."""
    import jax

    return jax.tree.map(lambda x: x[steps, trial], trace.ground)


def film(args: Args, robot, trace, spans: Sequence[range], every: int, dt: float) -> Iterator:
    """Pictures [H, W, 3] of every `every`-th step of the spans, one speed after the other.

    Each picture shows the commanded and the actual speed as text.
    """
    from kslc_jax.viewer import render

    window = round(SPEED_SECONDS / dt)
    for i, (command, steps) in enumerate(zip(args.speeds, spans, strict=True)):
        filmed = steps[::every]
        qpos, ground = trace.qpos[filmed, i], ground_of(trace, filmed, i)
        pictures = render.frames(robot, qpos, ground=ground)
        for step, picture in zip(filmed, pictures, strict=True):
            speed = trace.linvel[max(0, step + 1 - window) : step + 1, i, 0].mean()
            text = f"commanded {command:.1f} m/s\nactual {speed:.2f} m/s"
            yield caption(picture, text)


def write_video(path: Path, args: Args, robot, trace, spans: Sequence[range], dt: float) -> None:
    """Writes the film, which plays in real time. The suffix of `path` decides the format."""
    if path.suffix.lower() in ANIMATIONS:
        every = max(1, round(2.0 / (FPS * dt)))
        write_animation(path, film(args, robot, trace, spans, every, dt), every * dt)
        return
    imageio = film_writer()
    # The warning is harmless here: the fork starts ffmpeg at once and runs no JAX.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
    every = max(1, round(1.0 / (FPS * dt)))
    with imageio.get_writer(str(path), fps=round(1.0 / (every * dt)), macro_block_size=8) as out:
        for picture in film(args, robot, trace, spans, every, dt):
            out.append_data(picture)


def write_animation(path: Path, pictures: Iterable, seconds: float) -> None:
    """Writes an animated WebP or GIF that repeats without end; each picture lasts `seconds`."""
    from PIL import Image

    first, *others = map(Image.fromarray, pictures)
    milliseconds = round(1000 * seconds)
    more = {"append_images": others, "duration": milliseconds, "loop": 0, "quality": QUALITY}
    first.save(path, None, save_all=True, **more)


def draw(args: Args, policy) -> None:
    """Writes the gait strip and the video that `args` names."""
    import matplotlib.image

    from kslc_jax.viewer import render

    for path in (args.gait_strip, args.video):
        files.require_writable(path)
    if args.video is not None and args.video.suffix.lower() in FILMS:
        film_writer()
    trace, start, dt = record(args, policy)
    robot = render.shown_robot(policy, args.terrain)
    for speed, up in zip(args.speeds, trace.alive[-1], strict=True):
        if not up:
            print(f"warning: fell at {speed:g} m/s; what is shown ends there")
    spans = [shown(trace.alive[:, i], start) for i in range(len(args.speeds))]
    if args.gait_strip is not None:
        strips = [
            render.gait_strip(robot, trace.qpos[span, i], dt, ground=ground_of(trace, span, i))
            for i, span in enumerate(spans)
        ]
        matplotlib.image.imsave(args.gait_strip, render.stack(strips))
        print(f"wrote {args.gait_strip}")
    if args.video is not None:
        write_video(args.video, args, robot, trace, spans, dt)
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
        viewer = Viewer(args.policy, *how)
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
    sim2sim.simulator(args.engine)  # fails now if the engine's package is missing
    from kslc_jax.policy import load_policy

    draw(args, load_policy(args.policy))


if __name__ == "__main__":
    sys.exit(main())
