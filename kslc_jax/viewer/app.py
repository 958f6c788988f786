"""The live viewer. The browser shows a robot, and the user changes its command while it runs.

The viewer needs viser (pip install 'kslc_jax[viewer]'). It needs no GL, because the browser draws.
"""

import collections
import contextlib
import errno
import io
import socket
import time
from pathlib import Path

import mujoco
import numpy as np
import viser
from trimesh.exchange.gltf import export_glb

from kslc_jax import ground as ground_lib
from kslc_jax import policy as policy_lib
from kslc_jax.checkpoint_format import CheckpointError
from kslc_jax.config import ConfigError, Fidelity, TerrainConfig
from kslc_jax.evaluation import trials
from kslc_jax.ground import Ground
from kslc_jax.policy import Policy, load_policy
from kslc_jax.robot import Robot
from kslc_jax.viewer import panel, render, shapes
from kslc_jax.viewer.following import Follower
from kslc_jax.viewer.session import Pacer, Session, View

FPS = 30
PANEL_HZ = 10
"""Redraws of plots and status text per second."""

CAMERA, LOOK_AT, FOV = (2.2, -3.0, 1.5), (0.4, 0.3, 0.75), 45.0
"""Start position and target of the camera, relative to the robot [m]; field of view [degrees]."""

SPEED_SECONDS = 1.0
"""Window for the means of the actual speed and of the real-time factor [s]."""

SHOWN_GROUP = 2
"""Highest geom group that is drawn, as in MuJoCo's own viewer."""

GROUND_COLOR = (214, 218, 224)
"""Colour of uneven ground: red, green, blue."""

SLOW = 0.95
"""Share of the chosen playback speed. At a lower speed the page says "too slow"."""


# -------------------------------------------------------------------------------------------- robot


class Figure:
    """The robot and the floor in a viser scene.

    With `follow` the robot stays in the picture and the world moves under it. Without `follow` the
    world stays and the robot moves. The user's camera never moves by itself.
    """

    def __init__(self, server: viser.ViserServer, robot: Robot):
        self.follow = True
        self._server = server
        self.draw(robot)

    def draw(self, robot: Robot) -> None:
        """Clears the scene and draws this robot, which must have high fidelity."""
        self.robot, model = robot, robot.mj_model
        self._model, self._data = model, mujoco.MjData(model)
        server, scene = self._server, self._server.scene
        scene.reset()
        scene.configure_environment_map("studio", environment_intensity=0.4)
        server.initial_camera.position, server.initial_camera.look_at = CAMERA, LOOK_AT
        server.initial_camera.fov = np.radians(FOV)
        self._world = scene.add_frame("/world", show_axes=False)
        self._bodies = {}
        self._windows: list[viser.MeshHandle] = []
        for geom in range(model.ngeom):
            body = int(model.geom_bodyid[geom])
            if model.geom_group[geom] > SHOWN_GROUP:
                continue
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._add_floor(scene)
                continue
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
                self._add_ground(scene)
                continue
            name = f"/world/{model.body(body).name}"
            if body not in self._bodies:
                self._bodies[body] = scene.add_frame(name, show_axes=False)
            glb = export_glb(shapes.mesh(model, geom), include_normals=True)
            scene.add_glb(f"{name}/{geom}", glb)

    @staticmethod
    def _add_floor(scene: viser.SceneApi) -> None:
        scene.add_grid(
            "/world/floor",
            infinite_grid=True,
            cell_size=0.5,
            cell_color=(214, 218, 224),
            section_size=1.0,
            section_color=(176, 182, 192),
            fade_distance=40.0,
            plane_color=(236, 238, 241),
            plane_opacity=1.0,
            shadow_opacity=0.3,
        )

    def _add_ground(self, scene: viser.SceneApi) -> None:
        """Adds the windows of the height field; `show` makes one of them visible."""
        self._windows = [
            scene.add_mesh_simple(
                f"/world/ground_{i}",
                *shapes.ground(self._model, i),
                color=GROUND_COLOR,
                visible=False,
            )
            for i in range(self._model.nhfield)
        ]

    def _put_ground(self, ground: Ground, x: float, y: float) -> float:
        """Shows the ground around x and y [m]; returns its mean height there [m]."""
        pos, quat, far = ground_lib.place(ground, x, y, np)
        for i, window in enumerate(self._windows):
            window.visible, window.position, window.wxyz = i == int(far), pos, quat
        return ground_lib.level(ground, x, y)

    def show(self, view: View) -> None:
        """Moves every body to its pose in the view."""
        qpos = np.asarray(view.qpos)
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        with self._server.atomic():
            floor = self._put_ground(view.ground, qpos[0], qpos[1]) if view.ground else 0.0
            if self.follow:
                self._world.position = (-qpos[0], -qpos[1], -floor)
            for body, frame in self._bodies.items():
                frame.position = self._data.xpos[body]
                frame.wxyz = self._data.xquat[body]


# ------------------------------------------------------------------------------------------- viewer


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
    ):
        """Loads the policy and serves the page. The robot does not move before `run`.

        With `follow`, `policy` is the run folder of a training. The viewer takes each new policy of
        this training. `terrain` is uneven ground of one kind and size.
        """
        self._terrain = terrain
        self._fidelity: Fidelity = fidelity
        self._seed = seed
        self._follower = Follower(policy) if follow else None
        folder = self._follower.wait() if self._follower else policy
        self._policies = policies(policy)
        self._given = self._name = next(iter(self._policies))
        loaded = load_policy(folder)
        self.server = serve(host, port)
        self.figure = Figure(self.server, render.shown_robot(loaded, terrain))
        self.panel = panel.Panel(self.server, list(self._policies), loaded.config.command)
        self._rng = np.random.default_rng(seed)
        self._play(loaded)

    def _play(self, policy: Policy) -> None:
        """Starts a new session with the policy, and draws its robot."""
        robot = render.shown_robot(policy, self._terrain)
        if self.figure.robot is not robot:
            self.figure.draw(robot)
        engine = trials.engine(policy, self._fidelity, self._terrain)
        self.session = Session(policy, engine, self._seed)
        self.session.advance(np.zeros(3))  # compiles
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
            self._play(load_policy(self._policies[name]))
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
            self._play(policy)
            return
        self.session.policy = policy
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
            push = self.panel.take_push(self._rng)
            self._recent.append(self.session.advance(self.panel.command, push))
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
        """Updates the plots and the status text."""
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
