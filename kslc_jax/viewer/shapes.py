"""Shapes of a model as meshes that a browser can draw."""

import mujoco
import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from kslc_jax.robots.shapes import mesh_data

GAMMA = 2.2
"""Exponent that turns MuJoCo's colours into the linear colours of glTF."""

COARSER = 2
"""Distance of the points of the drawn ground by that of the height field."""

SQUARE = 0.5
"""Side [m] of the squares on uneven ground."""


def mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """The mesh of a geom, in the frame of its body and the colour of its material."""
    kinds, create = mujoco.mjtGeom, trimesh.creation
    size = model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == kinds.mjGEOM_BOX:
        shape = create.box(extents=2.0 * size)
    elif kind == kinds.mjGEOM_CAPSULE:
        shape = create.capsule(radius=size[0], height=2.0 * size[1])
    elif kind == kinds.mjGEOM_CYLINDER:
        shape = create.cylinder(radius=size[0], height=2.0 * size[1])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        shape = create.icosphere(subdivisions=3).apply_scale(size)
    elif kind == kinds.mjGEOM_SPHERE:
        shape = create.icosphere(subdivisions=3, radius=size[0])
    elif kind == kinds.mjGEOM_MESH:
        shape = trimesh.Trimesh(*mesh_data(model, int(model.geom_dataid[geom])), process=False)
    else:
        raise ValueError(f"geom {model.geom(geom).name}: no picture of a {kinds(kind).name}")
    placed = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
    placed[:3, 3] = model.geom_pos[geom]
    shape = trimesh.graph.smooth_shade(shape.apply_transform(placed))
    material = model.geom_matid[geom]
    rgba = (model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]).copy()
    rgba[:3] **= GAMMA
    paint = PBRMaterial(baseColorFactor=rgba, metallicFactor=0.0, roughnessFactor=0.7)
    shape.visual = TextureVisuals(material=paint)
    return shape


def ground(model: mujoco.MjModel, field: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3, m] and faces [F, 3] of a height field, with every `COARSER`th point."""
    rows, columns = model.hfield_nrow[field], model.hfield_ncol[field]
    first, (along, across, top, _) = model.hfield_adr[field], model.hfield_size[field]
    data = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    heights = top * data[::COARSER, ::COARSER]
    y, x = (np.linspace(-h, h, n) for h, n in zip((across, along), heights.shape, strict=True))
    vertices = np.stack([*np.meshgrid(x, y), heights], -1).reshape(-1, 3)
    index = np.arange(heights.size).reshape(heights.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([a, b, d, a, d, c], -1).reshape(-1, 3)
    return vertices.astype(np.float32), faces.astype(np.uint32)


def checkered(vertices: np.ndarray, faces: np.ndarray, colors) -> trimesh.Trimesh:
    """A ground with squares of two colours. On ground of one colour nobody would see the waves."""
    column, row = np.floor(vertices[:, :2].T / SQUARE).astype(int)
    painted = np.asarray(colors, np.uint8)[(column + row) % 2]
    return trimesh.Trimesh(vertices, faces, vertex_colors=painted, process=False)
