"""The viewer's controls: sliders, buttons, keys and plots. It does not simulate."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from viser.uplot import Axis, Legend, Scale, Series

from kslc_jax.config import CommandConfig
from kslc_jax.policy import Policy
from kslc_jax.viewer.session import View

MARGIN = 0.5
"""Reach of the vx slider [m/s]: backwards from 0, and forwards beyond the trained range."""

SIDE_MARGIN = 0.2
"""Reach of the vy slider [m/s] beyond the trained range, on each side."""

RATES = {"0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0}

TITLE = "kslc_jax"

PLOT_SECONDS = 6.0
PLOT_HEIGHT = 130
"""Height of a plot [pixels]."""

NEWTONS, FIRST, MOST = 50.0, 4, 20
"""Step of the force of a shove for XBot-L [N]; the first and the largest force, in steps."""

STEP = np.array([0.25, 0.1, 0.2])
"""Change of vx, vy [m/s] and yaw rate [rad/s] per key press."""

# viser uses W A S D Q E and the arrow keys for the camera.
WAYS = {
    "I": ("Faster", (1, 0, 0)),
    "K": ("Slower", (-1, 0, 0)),
    "J": ("Turn left", (0, 0, 1)),
    "L": ("Turn right", (0, 0, -1)),
    "U": ("Step left", (0, 1, 0)),
    "O": ("Step right", (0, -1, 0)),
}
ACTIONS = {"P": "Shove", "space": "Pause", "R": "Reset", "X": "Stop"}

HELP = """**I K** faster, slower; **J L** turn; **U O** step sideways; **X** stop; **P** shove;
**space** pause; **R** reset. **W A S D Q E** and the arrows move the camera."""

DIRECTIONS = {"forwards": 0.0, "left": 0.5 * np.pi, "backwards": np.pi, "right": -0.5 * np.pi}
"""Directions of a shove: angle from the robot's heading to the left [rad]."""

RANDOM = "random"

BLUE, ORANGE, GREEN = "#2d6cdf", "#e8590c", "#2b8a3e"


class Panel:
    """Reads the user's input. Shows plots and text beside the picture."""

    def __init__(
        self,
        server: viser.ViserServer,
        names: Sequence[str],
        config: CommandConfig,
        links: Sequence[str],
        schedule: str | None = None,
    ):
        """Builds the controls.

        Args:
          server: the viser server of the page.
          names: names of the policies that the user can choose.
          config: gives the trained ranges of vy and of the yaw rate.
          links: names of the links that the user can shove.
          schedule: name of the schedule of commands; None: only the user gives commands.
        """
        self.paused = False
        self._gui, self._title = server.gui, TITLE
        self._reset_wanted, self._shove_wanted = threading.Event(), threading.Event()
        gui = server.gui
        turn = max(config.max_yaw_rate, STEP[2])
        gui.set_panel_label(TITLE)
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.status = gui.add_markdown("")
        self._schedule: viser.GuiCheckboxHandle | None = None
        with gui.add_folder("Command"):
            if schedule is not None:
                self._schedule = gui.add_checkbox(f"Schedule {schedule}", True)
            self._sliders = (
                gui.add_slider("vx m/s", -MARGIN, MARGIN, 0.05, 0.0),
                gui.add_slider(
                    "vy m/s", config.vy[0] - SIDE_MARGIN, config.vy[1] + SIDE_MARGIN, 0.05, 0.0
                ),
                gui.add_slider("yaw rad/s", -turn, turn, 0.05, 0.0),
            )
            buttons = gui.add_button_group("", ("Stop", "Pause", "Reset"))
        self._add_shove(links)
        self._add_show(names)
        self._plots = _plots(gui)
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown(HELP)
        actions: dict[str, Callable[[], None]] = {
            "Shove": self._shove_wanted.set,
            "Pause": self._pause,
            "Reset": self._reset_wanted.set,
            "Stop": self._stop,
        }
        buttons.on_click(lambda event: actions[event.target.value]())
        for slider in self._sliders:
            slider.on_update(self._moved)
        for key, label in ACTIONS.items():
            _bind(gui, key, label, actions[label])
        for key, (label, way) in WAYS.items():
            _bind(gui, key, label, lambda way=way: self._change(STEP * way))

    def _add_shove(self, links: Sequence[str]) -> None:
        """The folder in which the user chooses a force on a link."""
        gui = self._gui
        with gui.add_folder("Shove"):
            self._link = gui.add_dropdown("link", tuple(links), initial_value=links[0])
            towards = (*DIRECTIONS, RANDOM)
            self._direction = gui.add_dropdown("towards", towards, initial_value=RANDOM)
            self._newtons = gui.add_slider(
                "force N", NEWTONS, MOST * NEWTONS, NEWTONS, FIRST * NEWTONS
            )
            shove = gui.add_button("Shove")
            shove.on_click(lambda _: self._shove_wanted.set())

    def _add_show(self, names: Sequence[str]) -> None:
        """The folder of what the page shows."""
        gui = self._gui
        with gui.add_folder("Show"):
            self.follow = gui.add_checkbox("Follow", True)
            self.rate = gui.add_dropdown("Playback", tuple(RATES), initial_value="1x")
            self.policy = gui.add_dropdown("Policy", tuple(names), initial_value=names[0])

    def _pause(self) -> None:
        self.paused = not self.paused

    def _moved(self, event: viser.GuiEvent) -> None:
        """Ends the schedule if a user moved the slider; `show` moves it without a client."""
        if event.client is not None:
            self._by_hand()

    def _by_hand(self) -> None:
        if self._schedule is not None:
            self._schedule.value = False

    def _stop(self) -> None:
        self._by_hand()
        for slider in self._sliders:
            slider.value = 0.0

    def _change(self, by: np.ndarray) -> None:
        self._by_hand()
        for slider, change in zip(self._sliders, by, strict=True):
            if change:
                wanted = round(slider.value + change, 6)
                slider.value = float(np.clip(wanted, slider.min, slider.max))

    def allow(self, fastest: float) -> None:
        """Sets the range of the vx slider for a policy that was trained up to `fastest` [m/s]."""
        vx = self._sliders[0]
        vx.value = min(vx.value, fastest + MARGIN)
        vx.max = fastest + MARGIN
        speed, _ = self._plots
        speed.scales = _scales(-MARGIN, fastest + MARGIN)

    def offer(self, links: Sequence[str], mass_ratio: float) -> None:
        """Lists the links of another robot, and the forces for its mass in units of XBot-L's."""
        if self._link.options != tuple(links):
            self._link.options = tuple(links)
        force, step = self._newtons, max(round(NEWTONS * mass_ratio), 1)
        if force.step != step:
            force.min, force.max, force.step, force.value = step, MOST * step, step, FIRST * step

    def choose(self, link: str) -> None:
        """Selects a link for the next shove."""
        self._link.value = link

    @property
    def command(self) -> np.ndarray | None:
        """The values of the sliders [3]: vx, vy [m/s], yaw rate [rad/s].

        None: the robot follows the schedule.
        """
        if self._schedule is not None and self._schedule.value:
            return None
        return np.array([slider.value for slider in self._sliders])

    def show(self, command: np.ndarray) -> None:
        """Moves the sliders to the schedule's command [3]: vx, vy [m/s], yaw rate [rad/s]."""
        for slider, value in zip(self._sliders, command, strict=True):
            slider.value = round(float(np.clip(value, slider.min, slider.max)), 2)

    def take_reset(self) -> bool:
        """True if the user asked for a reset since the last call."""
        wanted = self._reset_wanted.is_set()
        self._reset_wanted.clear()
        return wanted

    def take_shove(self, rng: np.random.Generator) -> tuple[str, float, float] | None:
        """Arguments of `Session.shove` if the user asked for a shove since the last call."""
        if not self._shove_wanted.is_set():
            return None
        self._shove_wanted.clear()
        direction = self._direction.value
        angle = rng.uniform(0.0, 2.0 * np.pi) if direction == RANDOM else DIRECTIONS[direction]
        return self._link.value, self._newtons.value, angle

    def title(self, factor: float, slow: bool) -> None:
        """Shows the real-time factor in the title if it is slow. A folded panel shows its title."""
        title = f"{TITLE}, {factor:.2f}x real time" if slow else TITLE
        if title != self._title:
            self._title = title
            self._gui.set_panel_label(title)

    def plot(self, recent: Sequence[View], now: float, dt: float) -> None:
        """Plots every second view. Views are `dt` [s] apart; the last one is of time `now` [s]."""
        views = recent[::-2][::-1]
        if len(views) < 2:
            return
        rows = [
            [now + 2 * dt * i, v.command[0], v.velocity[0], v.phase, *v.contact]
            for i, v in enumerate(views, 1 - len(views))
        ]
        seconds, command, velocity, phase, left, right = np.array(rows, np.float64).T
        speed, gait = self._plots
        speed.data = (seconds, command, velocity)
        gait.data = (seconds, phase, 1.2 + 0.6 * right, 2.2 + 0.6 * left)


def _bind(gui: viser.GuiApi, key: Any, label: str, action: Callable[[], None]) -> None:
    gui.add_command(label, hotkey=key).on_trigger(lambda _: action())


def _scales(low: float, high: float) -> dict[str, Scale]:
    """Horizontal axis in seconds, vertical axis from `low` to `high`."""
    return {"x": Scale(time=False), "y": Scale(range=(low, high))}


def _plots(gui: viser.GuiApi) -> tuple[viser.GuiUplotHandle, viser.GuiUplotHandle]:
    """Two plots of the last seconds: forward speed; gait phase with foot contacts."""
    empty = np.zeros(2)
    common: dict[str, Any] = {
        "legend": Legend(live=False),
        "height": PLOT_HEIGHT,
        "padding": (12, 24, 0, 0),
    }
    speed = gui.add_uplot(
        (empty,) * 3,
        (
            Series(),
            Series(label="commanded vx [m/s]", stroke=BLUE, width=2),
            Series(label="actual", stroke=ORANGE, width=1),
        ),
        scales=_scales(-MARGIN, MARGIN),
        **common,
    )
    gait = gui.add_uplot(
        (empty,) * 4,
        (
            Series(),
            Series(label="gait phase", stroke=BLUE, width=1),
            Series(label="right foot down", stroke=ORANGE, width=1),
            Series(label="left foot down", stroke=GREEN, width=1),
        ),
        scales=_scales(0.0, 3.0),
        axes=(Axis(), Axis(splits=(0.5, 1.5, 2.5), values=("phase", "right", "left"))),
        **common,
    )
    return speed, gait


def status(
    view: View, speed: float, factor: float, slow: bool, policy: Policy, paused: bool
) -> str:
    """The Markdown text above the controls.

    Args:
      view: the present control step.
      speed: mean forward speed [m/s].
      factor: real-time factor [].
      slow: True if `factor` is below the chosen playback speed.
      policy: the policy that acts.
      paused: True if the simulation is paused.
    """
    how = "**fallen**" if view.fallen else "paused" if paused else "up"
    pace = f"real-time factor {factor:.2f}"
    pace = f"**{pace}, too slow**" if slow else pace
    return (
        f"**{speed:z.2f} m/s** of {view.command[0]:.2f} commanded, {how}  \n"
        f"{pace}, train step {policy.step}, "
        f"trained up to {float(policy.curriculum.v_max):.1f} m/s"
    )
