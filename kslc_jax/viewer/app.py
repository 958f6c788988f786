"""The live viewer. The browser shows a robot, and the user changes its command while it runs.

The viewer needs viser (pip install 'kslc_jax[viewer]'). It needs no GL, because the browser draws.
"""

import collections
import contextlib
import errno
import io
import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from kslc_jax import policy as policy_lib
from kslc_jax.checkpoint_format import CheckpointError
from kslc_jax.config import ConfigError, Fidelity, RandomizeConfig, TerrainConfig
from kslc_jax.evaluation import trials
from kslc_jax.evaluation.schedules import Schedule
from kslc_jax.policy import Policy, load_policy
from kslc_jax.viewer import panel, render
from kslc_jax.viewer.figure import Figure
from kslc_jax.viewer.following import Follower
from kslc_jax.viewer.session import Pacer, Session, View

FPS = 30
PANEL_HZ = 10
"""Redraws of plots and status text per second."""

SPEED_SECONDS = 1.0
"""Window for the means of the actual speed and of the real-time factor [s]."""

SLOW = 0.95
"""Share of the chosen playback speed. At a lower speed the page says "too slow"."""


def policies(given: Path) -> dict[str, Path]:
    """Folders by name: the given policy, the other checkpoints of its run, shipped policies."""
    folder = policy_lib.checkpoint_folder(given)
    found = {str(given): folder}
    others = [p for p in folder.parent.iterdir() if p.name.isdigit() and p != folder]
    for other in sorted(others, key=lambda p: -int(p.name)):
        found[f"step {other.name}"] = other
    for shipped in sorted(policy_lib.POLICIES.glob("*/")):
        found.setdefault(shipped.name, shipped)
    return found


def serve(host: str, port: int) -> viser.ViserServer:
    """A web server at exactly this address; port 0: any free port.

    Raises:
      ConfigError: the address is not available.
    """
    try:
        # Checked here, because viser silently takes the next free port, and hangs at unknown hosts.
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        in_use = error.errno == errno.EADDRINUSE
        why = "the port is in use, give another with --port" if in_use else error.strerror
        raise ConfigError(f"cannot serve at {host}:{port}: {why}") from error
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        return viser.ViserServer(host, port, verbose=False)


class Viewer:
    """Shows one robot to every browser that opens the page."""

    def __init__(
        self,
        policy: Path,
        fidelity: Fidelity = "high",
        host: str = "127.0.0.1",
        port: int = 8080,
        seed: int = 0,
        follow: bool = False,
        terrain: TerrainConfig | None = None,
        plan: Callable[[Policy], Schedule | None] = lambda policy: None,
        randomize: RandomizeConfig = trials.NOMINAL,
    ):
        """Loads the policy and serves the page. The robot does not move before `run`.

        With `follow`, `policy` is the run folder of a training. The viewer takes each new policy of
        this training. `terrain` is uneven ground of one kind and size. `plan` makes the schedule of
        commands for a policy. `randomize` holds the disturbances.
        """
        self._terrain, self._plan, self._randomize = terrain, plan, randomize
        self._fidelity: Fidelity = fidelity
        self._seed = seed
        self._follower = Follower(policy) if follow else None
        folder = self._follower.wait() if self._follower else policy
        self._policies = policies(policy)
        self._given = self._name = next(iter(self._policies))
        loaded = load_policy(folder)
        plan(loaded)  # an unknown schedule fails before the page is served
        self.server = serve(host, port)
        session = self._session(loaded)
        self.panel = panel.Panel(
            self.server,
            list(self._policies),
            loaded.config.command,
            session.links,
            session.schedule.name if session.schedule else None,
        )
        robot = render.shown_robot(loaded, terrain)
        self.figure = Figure(self.server, robot, self.panel.choose)
        self._rng = np.random.default_rng(seed)
        self._play(session)

    def _session(self, policy: Policy) -> Session:
        engine = trials.engine(policy, self._fidelity, self._terrain)
        return Session(policy, engine, self._seed, self._plan(policy), self._randomize)

    def _play(self, session: Session) -> None:
        """Starts a new session, and draws its robot."""
        policy = session.policy
        robot = render.shown_robot(policy, self._terrain)
        if self.figure.robot is not robot:
            self.figure.draw(robot)
        self.session = session
        self.session.advance()  # compiles
        self.panel.offer(session.links, robot.mass_ratio)
        self.panel.allow(float(policy.curriculum.v_max))
        self._pacer = Pacer(self.session.dt)
        shown = round(panel.PLOT_SECONDS / self.session.dt)
        self._recent: collections.deque[View] = collections.deque(maxlen=shown)
        self._paced: collections.deque[tuple[float, float, float]]  # s: clock, simulated, due
        self._paced = collections.deque(maxlen=round(SPEED_SECONDS * FPS))
        self._drawn = 0.0
        self.reset()

    def reset(self) -> None:
        """Puts the robot back to the start of an episode."""
        self.session.reset()
        self._recent.clear()
        self.figure.show(self.session.view)

    def _switch(self, name: str) -> None:
        """Plays the policy of this name. If it cannot be loaded, keeps the old one and says so."""
        self._name = name
        self.panel.status.content = f"loading {name} ..."
        try:
            self._play(self._session(load_policy(self._policies[name])))
        except CheckpointError as error:
            for client in self.server.get_clients().values():
                client.add_notification("Not loaded", str(error), color="red")

    def _take(self, folder: Path) -> None:
        """Continues the motion with a newer policy of the training.

        The training may have removed it already. Then the viewer waits for the next one.
        """
        try:
            policy = load_policy(folder)
        except CheckpointError:
            return
        if policy.config != self.session.policy.config:
            self._play(self._session(policy))
            return
        self.session.policy, self.session.schedule = policy, self._plan(policy)
        self.panel.allow(float(policy.curriculum.v_max))

    def frame(self, now: float) -> None:
        """Does the control steps that are due at the clock time `now` [s] and draws the result."""
        if self.panel.policy.value != self._name:
            self._switch(self.panel.policy.value)
        if self._follower and (newer := self._follower.fresh(now)):
            self._policies[self._given] = newer
            if self._name == self._given:
                self._take(newer)
        if self.panel.take_reset():
            self.reset()
        idle = self.panel.paused or not self.server.get_clients()
        rate = 0.0 if idle else panel.RATES[self.panel.rate.value]
        steps = self._pacer.due(now, rate)
        for _ in range(steps):
            if shove := self.panel.take_shove(self._rng):
                self.session.shove(*shove)
            self._recent.append(self.session.advance(self.panel.command))
        before, simulated, asked = self._paced[-1] if self._paced else (now, 0.0, 0.0)
        asked += rate * (now - before)
        self._paced.append((now, simulated + steps * self.session.dt, asked))
        if steps:
            self.figure.follow = self.panel.follow.value
            self.figure.show(self.session.view)
        if now - self._drawn >= 1.0 / PANEL_HZ:
            self._drawn = now
            self._report()

    def _report(self) -> None:
        """Updates the plots, the status text, and the sliders if the robot follows a schedule."""
        if self.panel.command is None:
            self.panel.show(np.asarray(self.session.view.command))
        seconds, simulated, wanted = np.subtract(self._paced[-1], self._paced[0])
        factor = simulated / max(seconds, 1e-6)
        slow = simulated < SLOW * wanted - self.session.dt  # one due step may still be missing
        self.panel.title(factor, slow)
        self.panel.plot(list(self._recent), self._paced[-1][1], self.session.dt)
        last = [v.velocity[0] for v in self._recent][-round(SPEED_SECONDS / self.session.dt) :]
        self.panel.status.content = panel.status(
            self.session.view,
            speed=float(np.mean(last)) if last else 0.0,
            factor=factor,
            slow=slow,
            policy=self.session.policy,
            paused=self.panel.paused,
        )

    def run(self) -> None:
        """Runs the viewer until an interrupt, then stops the server."""
        try:
            while True:
                began = time.monotonic()
                self.frame(began)
                time.sleep(max(0.0, began + 1.0 / FPS - time.monotonic()))
        finally:
            self.server.stop()
