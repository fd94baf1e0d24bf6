"""Fuzz targets: meshes."""

from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz import gltf_features, oracles
from tests.fuzz.target import require, require_points, strictly
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.priors.mesh import MeshPrior


def exercise_mesh(path: Path) -> None:
    """A prior from the vertices, one from the surface, and a picture by ray casting."""
    mesh = load_mesh(path)
    require(
        bool(np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() < 1 + 1e-6),
        "vertices outside of the box",
    )
    require(
        mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices),
        "a face names a vertex that isn't there",
    )
    require_points(MeshPrior({"path": str(path)})("a fox"))
    require_points(MeshPrior({"path": str(path), "num_points": 50})("a fox"))
    c2w = np.array([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    image = MeshCaster(mesh).render(c2w, 0.8, 8, 8, supersample=1)
    require(
        bool(np.isfinite(image).all() and image.min() >= 0 and image.max() < 1 + 1e-5),
        "a pixel isn't in [0, 1]",
    )


def exercise_obj(path: Path) -> None:
    exercise_mesh(path)
    require_same_surface(load_mesh(path), strictly(oracles.obj_triangles, path))


def exercise_ply_mesh(path: Path) -> None:
    exercise_mesh(path)
    strictly(oracles.ply_vertices, path)


def exercise_glb(path: Path) -> None:
    exercise_mesh(path)
    corners = strictly(oracles.glb_triangles, path)
    if corners is not None:
        require_same_surface(load_mesh(path), corners)


def exercise_gltf_features(path: Path) -> None:
    problem = gltf_features.exercise(path, exercise_mesh)
    require(problem is None, str(problem))


def require_same_surface(mesh: Any, corners: np.ndarray) -> None:
    """The triangles that a file says, in the package's pose: y up and z in front become z up and x
    in front, the box is [-1, 1].
    """
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    require(
        len(corners) == len(mesh.faces),
        f"{len(mesh.faces)} faces, but the file says {len(corners)}",
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    expected = ((corners - (low + high) / 2) / ((high - low).max() / 2))[..., [2, 0, 1]].mean(
        axis=1
    )
    ours = mesh.vertices[mesh.faces].mean(axis=1)
    distance = [
        np.abs(np.sort(a @ axis) - np.sort(b @ axis)).max()
        for a, b in [(ours, expected)]
        for axis in np.eye(3)
    ]
    require(max(distance) < 1e-4, f"faces are up to {max(distance):.3g} from where the file says")


def meshes(kind: str) -> list[bytes]:
    """A box with a texture, with colours of the vertices, of the faces, and as two objects of a
    scene.
    """
    import trimesh
    from PIL import Image

    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (4, 4, 3), dtype=np.uint8))
    textured, by_vertex, by_face = (trimesh.creation.box((1, 0.7, 0.5)) for _ in range(3))
    material = (
        trimesh.visual.material.PBRMaterial(baseColorTexture=image) if kind == "glb" else None
    )
    textured.visual = trimesh.visual.TextureVisuals(
        uv=textured.vertices[:, :2] + 0.5, image=image, material=material
    )
    by_vertex.visual.vertex_colors = np.random.default_rng(1).integers(0, 255, (8, 4))
    by_face.visual.face_colors = np.random.default_rng(2).integers(0, 255, (12, 4))
    moved = trimesh.transformations.translation_matrix([0, 2, 0])
    scene = trimesh.Scene([by_vertex])
    scene.add_geometry(textured, transform=moved)
    sources = {
        "glb": [textured, by_vertex, scene],
        "obj": [textured, by_vertex],
        "ply": [by_vertex, by_face],
    }
    seeds = [source.export(file_type=kind) for source in sources.get(kind, [by_vertex])]
    return [seed.encode() if isinstance(seed, str) else seed for seed in seeds]
