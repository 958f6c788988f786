"""Films of recorded motion. Imports JAX and the renderer only when it draws."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from kslc_jax.errors import MissingPackage

FPS = 50

FILMS = (".mp4", ".mkv", ".mov")
ANIMATIONS = (".webp", ".gif")
"""Suffixes of films that web pages show like pictures. They need no ffmpeg. They have half the
frames."""

QUALITY = 60
"""Quality of an animation, 0 to 100. With it, six seconds take about 1 MB."""

SPEED_SECONDS = 0.5
"""Window for the mean speed that the video shows as text [s]."""


def shown(alive, start: int) -> range:
    """The steps of one trial to show, from `alive` [T].

    Without a fall these are the steps from `start` to T. After a fall they are as many steps, or
    fewer if it came earlier, up to the fall.
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


def film(robot, trace, spans: Sequence[range], every: int, dt: float) -> Iterator:
    """Pictures [H, W, 3] of every `every`-th step of the spans, one trial after the other.

    Each picture shows the commanded and the actual speed as text.
    """
    from kslc_jax.viewer import render

    window = round(SPEED_SECONDS / dt)
    for i, steps in enumerate(spans):
        filmed = steps[::every]
        qpos, ground = trace.qpos[filmed, i], ground_of(trace, filmed, i)
        pictures = render.frames(robot, qpos, ground=ground)
        for step, picture in zip(filmed, pictures, strict=True):
            speed = trace.linvel[max(0, step + 1 - window) : step + 1, i, 0].mean()
            text = f"commanded {trace.command[step, i, 0]:.1f} m/s\nactual {speed:.2f} m/s"
            yield caption(picture, text)


def write_video(path: Path, robot, trace, spans: Sequence[range], dt: float) -> None:
    """Writes the film, which plays in real time. The suffix of `path` decides the format."""
    if path.suffix.lower() in ANIMATIONS:
        every = max(1, round(2.0 / (FPS * dt)))
        write_animation(path, film(robot, trace, spans, every, dt), every * dt)
        return
    imageio = film_writer()
    every = max(1, round(1.0 / (FPS * dt)))
    with warnings.catch_warnings():
        # The warning is harmless here: the fork starts ffmpeg at once and runs no JAX.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        fps = round(1.0 / (every * dt))
        with imageio.get_writer(str(path), fps=fps, macro_block_size=8) as out:
            for picture in film(robot, trace, spans, every, dt):
                out.append_data(picture)


def write_animation(path: Path, pictures: Iterable, seconds: float) -> None:
    """Writes an animated WebP or GIF that repeats without end; each picture lasts `seconds`."""
    from PIL import Image

    first, *others = map(Image.fromarray, pictures)
    milliseconds = round(1000 * seconds)
    more = {"append_images": others, "duration": milliseconds, "loop": 0, "quality": QUALITY}
    first.save(path, None, save_all=True, **more)
