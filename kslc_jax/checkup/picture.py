"""A robot at home from the front and from the side, with its joints, as a picture."""

from pathlib import Path

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from scipy.spatial import ConvexHull, QhullError

from kslc_jax import files
from kslc_jax.checkup import statics
from kslc_jax.robot import Robot
from kslc_jax.robots import shapes
from kslc_jax.robots.build import SIDES

VIEWS = {
    "from the front": (np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])),
    "from its right": (np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])),
}
"""Per view, in the world: the direction to the right of the picture, and towards the viewer."""

LIMBS = {
    "left_leg": "#1f77b4",
    "right_leg": "#d98c2b",
    "left_arm": "#7fb8de",
    "right_arm": "#f2c27f",
    "trunk": "#a8a8a8",
}
TRUNK = "#6f6f6f"
"""Colour of the trunk, the heaviest of the links that belong to no limb."""

TURNS = (("roll", "#2ca02c"), ("pitch", "#d62728"), ("yaw", "#7b3fa0"))
"""Kind and colour of a joint whose axis is nearest to x, y or z."""

LABELS = ("hip", "knee", "ankle", "shoulder", "elbow")
"""Roles that are written beside the joint."""

ARROW = 0.09
"""Length of the arrow of a joint's axis, as a share of the standing height."""


def draw(robot: Robot, out: Path) -> None:
    """Writes the picture.

    Args:
      robot: at high fidelity, whose shapes are the MJCF's.
      out: a file that matplotlib can write, such as robot.png.

    Raises:
      ConfigError: the file cannot be written.
    """
    data = statics.posed(robot, statics.on_the_ground(robot))
    figure = Figure(figsize=(8, 8.5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, view in zip(axes, VIEWS, strict=True):
        _view(axis, robot, data, view)
    axes[0].set_ylabel("height [m]")
    figure.suptitle(f"{robot.name} at home: {robot.count} joints, {robot.total_mass:.1f} kg")
    figure.legend(handles=_legend(robot), loc="outside lower center", ncols=5, fontsize=8)
    with files.saving(out) as part:
        figure.savefig(part, dpi=100)


def _view(axis: Axes, robot: Robot, data: mujoco.MjData, view: str) -> None:
    """Draws one view."""
    right, towards = VIEWS[view]
    flat = np.stack([right, [0.0, 0.0, 1.0]], axis=1)  # world -> picture: points @ flat
    model = robot.mj_model
    own = [geom for geom in shapes.drawn(model) if model.geom_bodyid[geom]]
    for geom in sorted(own, key=lambda geom: data.geom_xpos[geom] @ towards):
        points = shapes.points(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T
        axis.add_patch(
            Polygon(
                _outline((points + data.geom_xpos[geom]) @ flat),
                facecolor=_colour(robot, geom),
                edgecolor="white",
                linewidth=0.4,
            )
        )
    _ground_and_soles(axis, data, flat, robot)
    size = ARROW * robot.stand_height
    for joint in range(robot.count):
        if right[0] and data.xanchor[1 + joint] @ towards < -0.02:
            continue  # hidden by the near side
        _joint(axis, robot, data, joint, flat, towards, size)
    axis.set_title(view)
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.margins(0.12, 0.05)
    axis.grid(alpha=0.25)
    axis.set_xlabel("y [m], its left" if right[1] else "x [m], forward")


def _outline(points: np.ndarray) -> np.ndarray:
    """[k, 2] corners of the convex hull of points [m, 2]."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # all in one line
        return points[:1]


def _colour(robot: Robot, geom: int) -> str:
    body = int(robot.mj_model.geom_bodyid[geom])
    if body == robot.trunk_body_id:
        return TRUNK
    return LIMBS[statics.limb_of_bodies(robot)[body]]


def _ground_and_soles(axis: Axes, data: mujoco.MjData, flat: np.ndarray, robot: Robot) -> None:
    """Draws the ground, the soles, the fall box, and the centre of mass above the ground."""
    axis.axhline(0, color="black", linewidth=0.8)
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    for side in SIDES:
        site = data.site(f"{side}_foot")
        size = [*statics.sole_size(robot, side), 0.0]
        places = (site.xpos + corners * size @ site.xmat.reshape(3, 3).T) @ flat
        ends = places[[places[:, 0].argmin(), places[:, 0].argmax()]]
        axis.plot(*ends.T, color="black", linewidth=3, solid_capstyle="butt")
    middle = robot.torso_box_center + data.qpos[:3]
    low = middle @ flat - (half := np.abs(robot.torso_box_half_size @ np.abs(flat)))
    axis.add_patch(Rectangle(tuple(low), *(2 * half), fill=False, linestyle=":", color="black"))
    com = data.sensor("com").data @ flat
    axis.plot([com[0], com[0]], [0, com[1]], color="black", linewidth=0.6, linestyle="--")
    axis.plot(*com, marker="x", color="black", markersize=8, markeredgewidth=2)


def _joint(
    axis: Axes,
    robot: Robot,
    data: mujoco.MjData,
    joint: int,
    flat: np.ndarray,
    towards: np.ndarray,
    size: float,
) -> None:
    """Draws a joint's axis as an arrow, or as a circle if it points to the viewer or away."""
    turn = data.xaxis[1 + joint]
    colour = TURNS[int(np.abs(turn).argmax())][1]
    place, along = data.xanchor[1 + joint] @ flat, turn @ flat * size
    if np.linalg.norm(along) < 0.4 * size:
        inside = "." if turn @ towards > 0 else "x"
        axis.plot(*place, marker="o", color="white", markeredgecolor=colour, markersize=9)
        axis.plot(*place, marker=inside, color=colour, markersize=5)
    else:
        arrow = {"arrowstyle": "-|>", "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", place + along, place, arrowprops=arrow | {"color": colour})
        axis.plot(*place, marker="o", color=colour, markersize=3)
    role = next((r for r, j in robot.anatomy.roles.items() if j == joint), "").partition("_")[2]
    if towards[1] and role in LABELS:
        label = axis.annotate(role, place, (-9, 4), textcoords="offset points", ha="right")
        label.set(fontsize=9, weight="bold")


def _legend(robot: Robot) -> list[Patch | Line2D]:
    limbs = [name for name in LIMBS if name in robot.anatomy.limbs]
    patches = [Patch(color=LIMBS[name], label=name.replace("_", " ")) for name in limbs]
    patches += [Patch(color=TRUNK, label="trunk"), Patch(color=LIMBS["trunk"], label="in no limb")]
    lines = [Line2D([], [], color=colour, label=f"{turn} axis") for turn, colour in TURNS]
    lines += [
        Line2D([], [], color="black", linewidth=3, label="sole"),
        Line2D([], [], color="black", linestyle=":", label="fall box"),
        Line2D([], [], color="black", linestyle="", marker="x", label="centre of mass"),
    ]
    lines += [
        Line2D([], [], color="grey", linestyle="", marker=f"${sign}$", markersize=9, label=text)
        for text, sign in (("axis towards you", r"\odot"), ("axis away from you", r"\otimes"))
    ]
    return [*patches, *lines]
