"""Shapes of an MJCF: points on their surfaces, and copies of them in another spec."""

import itertools

import mujoco
import numpy as np

from kslc_jax.robots.skeleton import Source

_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
NEAR = 0.001
"""Distance [m] up to which two shapes are measured."""

SHOWN_GROUP = 2
"""Highest geom group that MuJoCo's own viewer shows."""

_KINDS = (_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)


def of_bodies(source: Source, bodies: list[int]) -> list[int]:
    """Ids of the geoms that these bodies carry: those that collide; if none does, all."""
    model = source.model
    own = np.isin(source.carrier[model.geom_bodyid], bodies) & np.isin(model.geom_type, _KINDS)
    colliding = own & collides(model)
    return np.flatnonzero(colliding if colliding.any() else own).tolist()


def of_each(source: Source, bodies: list[int]) -> set[int]:
    """Ids of the geoms of these bodies; of each, those that collide; if none does, all."""
    return {geom for body in bodies for geom in of_bodies(source, [body])}


def collides(model: mujoco.MjModel) -> np.ndarray:
    """[ngeom] bool: the MJCF lets this geom touch something."""
    touching = (model.geom_contype | model.geom_conaffinity) > 0
    touching[np.union1d(model.pair_geom1, model.pair_geom2).astype(int)] = True
    return touching


def drawn(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms that pictures show.

    They are those that MuJoCo's own viewer shows. A link without such a geom shows all of its own:
    many MJCFs have shapes for collisions only, in a group that is hidden.
    """
    visible = model.geom_rgba[:, 3] > 0
    shown = visible & (model.geom_group <= SHOWN_GROUP)
    bare = ~np.isin(model.geom_bodyid, model.geom_bodyid[shown]) & (model.geom_bodyid > 0)
    return np.flatnonzero(shown | (bare & visible)).tolist()


def surface(source: Source, geoms: list[int]) -> np.ndarray:
    """[k, 3] points on the surfaces of these geoms, world at home [m]."""
    data = source.data
    clouds = [
        points(source.model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        for geom in geoms
    ]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


def points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """[k, 3] points on one geom's surface, in its frame; corners and vertices are among them."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == _MESH:
        return _mesh_points(model, int(model.geom_dataid[geom]))
    if kind == _BOX:
        return _box() * size
    if kind == _CYLINDER:
        return _cylinder() * size[[0, 0, 1]]
    if kind == _ELLIPSOID:
        return _sphere() * size
    heights = [0.0] if kind == _SPHERE else np.linspace(-size[1], size[1], 13)
    return np.concatenate([_sphere() * size[0] + _up(z) for z in heights])


def _up(z: float) -> np.ndarray:
    return np.array([0.0, 0.0, z])


def _sphere(count: int = 300) -> np.ndarray:
    """Points on the unit sphere: a spiral, and the six ends of the axes."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    spiral = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return np.concatenate([spiral, np.eye(3), -np.eye(3)])


def _box(count: int = 13) -> np.ndarray:
    """Points on the faces of the cube from -1 to 1."""
    line = np.linspace(-1, 1, count)
    grid = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    return grid[np.abs(grid).max(axis=1) == 1]


def _cylinder(count: int = 48) -> np.ndarray:
    """Points on the cylinder of radius 1 from z = -1 to 1."""
    angle = 2 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    side = [ring + _up(z) for z in np.linspace(-1, 1, 13)]
    caps = [ring * share + _up(z) for share in (0, 0.25, 0.5, 0.75) for z in (-1, 1)]
    return np.concatenate(side + caps)


def mesh_data(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3, m] and faces [F, 3] of a mesh of the model."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]


def _mesh_points(model: mujoco.MjModel, mesh: int, count: int = 2000) -> np.ndarray:
    """A mesh's vertices, and points that are spread over its area."""
    vertices, faces = mesh_data(model, mesh)
    vertices = vertices.astype(float)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(0)
    chosen = random.choice(len(area), count, p=area / area.sum())
    u, v = np.sort(random.random((2, count)), axis=0)[..., None]
    return np.concatenate([vertices, u * a[chosen] + (v - u) * b[chosen] + (1 - v) * c[chosen]])


def excluded(source: Source) -> set[tuple[int, int]]:
    """Pairs of bodies that the MJCF excludes from collision."""
    signatures = source.model.exclude_signature
    pairs = source.carrier[np.stack([signatures >> 16, signatures & 0xFFFF], axis=1)]
    return {(min(a, b), max(a, b)) for a, b in pairs.tolist() if a and b and a != b}


def touching(source: Source, geoms: set[int]) -> set[tuple[int, int]]:
    """Pairs of bodies with shapes among `geoms` that overlap at home, without parent and child."""
    model, carrier = source.model, source.carrier
    parent = carrier[model.body_parentid]
    found = set()
    for geom, other in itertools.combinations(sorted(geoms), 2):
        a, b = sorted(carrier[model.geom_bodyid[[geom, other]]].tolist())
        if not a or a == b or parent[b] == a or (a, b) in found:
            continue
        if mujoco.mj_geomDistance(model, source.data, geom, other, NEAR, None) < 0:
            found.add((a, b))
    return found


def copy(spec: mujoco.MjSpec, body: mujoco.MjsBody, source: Source, geom: int) -> mujoco.MjsGeom:
    """Adds a geom of the MJCF to the body that carries it; it has no mass and touches nothing.

    It keeps its place, its colour and its group. Textures are left out.
    """
    model, data = source.model, source.data
    carrier = int(source.carrier[model.geom_bodyid[geom]])
    new = body.add_geom(
        type=model.geom_type[geom],
        size=model.geom_size[geom],
        pos=source.local(carrier, data.geom_xpos[geom]),
        quat=source.turn(carrier, data.geom_xmat[geom]),
        group=model.geom_group[geom],
        rgba=model.geom_rgba[geom],
        mass=0,
        contype=0,
        conaffinity=0,
    )
    if model.geom_type[geom] == _MESH:
        new.meshname = _mesh(spec, model, int(model.geom_dataid[geom]))
    if (material := int(model.geom_matid[geom])) >= 0:
        new.material = _material(spec, model, material)
    return new


def _mesh(spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: int) -> str:
    """Name of the copy of a mesh; it is made at its first use."""
    name = f"mesh{mesh}"
    if spec.mesh(name) is None:
        vertices, faces = mesh_data(model, mesh)
        spec.add_mesh(
            name=name,
            uservert=vertices.flatten(),
            userface=faces.flatten(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # also for open surfaces
        )
    return name


def _material(spec: mujoco.MjSpec, model: mujoco.MjModel, material: int) -> str:
    """Name of the copy of a material; it is made at its first use."""
    name = f"material{material}"
    if spec.material(name) is None:
        spec.add_material(
            name=name,
            rgba=model.mat_rgba[material],
            specular=model.mat_specular[material],
            shininess=model.mat_shininess[material],
        )
    return name
