"""The robot and the floor as a scene in the browser."""

from collections.abc import Callable

import mujoco
import numpy as np
import viser
from trimesh.exchange.gltf import export_glb

from kslc_jax import ground as ground_lib
from kslc_jax.ground import Ground
from kslc_jax.robot import Robot
from kslc_jax.robots.shapes import drawn
from kslc_jax.viewer import shapes
from kslc_jax.viewer.session import View

CAMERA, LOOK_AT, FOV = (2.2, -3.0, 1.5), (0.4, 0.3, 0.75), 45.0
"""Start position and target of the camera, relative to the robot [m], for XBot-L; field of view
[degrees]."""

GROUND_COLORS = ((226, 229, 233), (178, 184, 194))
"""The two colours of uneven ground: red, green, blue."""


class Figure:
    """The robot and the floor in a viser scene.

    With `follow` the robot stays in the picture and the world moves under it. Without `follow` the
    world stays and the robot moves. The user's camera never moves by itself.
    """

    def __init__(self, server: viser.ViserServer, robot: Robot, choose: Callable[[str], None]):
        """Draws the robot. A click on one of its links calls `choose` with the link's name."""
        self.follow = True
        self._server, self._choose = server, choose
        self.draw(robot)

    def draw(self, robot: Robot) -> None:
        """Clears the scene and draws this robot, which must have high fidelity."""
        self.robot, model = robot, robot.mj_model
        self._model, self._data = model, mujoco.MjData(model)
        server, scene = self._server, self._server.scene
        scene.reset()
        scene.configure_environment_map("studio", environment_intensity=0.4)
        size, camera = robot.length_ratio, server.initial_camera
        camera.position, camera.look_at = size * np.array(CAMERA), size * np.array(LOOK_AT)
        camera.fov = np.radians(FOV)
        self._world = scene.add_frame("/world", show_axes=False)
        self._bodies = {}
        self._windows: list[viser.GlbHandle] = []
        for geom in drawn(model):
            body = int(model.geom_bodyid[geom])
            link = model.body(body).name
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._add_floor(scene)
                continue
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
                self._add_ground(scene)
                continue
            name = f"/world/{link}"
            if body not in self._bodies:
                self._bodies[body] = scene.add_frame(name, show_axes=False)
            glb = export_glb(shapes.mesh(model, geom), include_normals=True)
            handle = scene.add_glb(f"{name}/{geom}", glb)
            handle.on_click(lambda _, link=link: self._choose(link))

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
            scene.add_mesh_trimesh(
                f"/world/ground_{i}",
                shapes.checkered(*shapes.ground(self._model, i), GROUND_COLORS),
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
