"""Triangle meshes and points of glTF 2.0 files (``.glb``, ``.gltf``), in the scene's axes.

Supported: the default scene with its transforms; triangles, strips, fans and points, with or
without indices; all component types, normalised, strided and sparse; morph targets with their
default weights; skins in the pose of their joints; base colours with factor, texture, sampler, any
set of texture coordinates, KHR_texture_transform, and COLOR_0. Files are rejected if they have
compressed geometry (Draco, meshopt), instances by EXT_mesh_gpu_instancing, basisu or DDS textures,
or require any other unknown extension. Lines, lights, normals and animations are ignored.

Accessors, scenes and materials are decoded here, since trimesh ignores or misreads most of these
features, and pygltflib only parses the JSON."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Optional

import numpy as np
from jaxtyping import Float, Integer

from ..core.errors import UserError
from .budget import fail
from .colors import unit_rgb
from .gltf_document import INDICES, Document
from .gltf_materials import Materials, Surface
from .gltf_poses import skinned, world_matrices
from .mesh import Mesh

POINTS, LINES, TRIANGLES, STRIP, FAN = 0, (1, 2, 3), 4, 5, 6
LARGEST_UV = 2.0**20
"""Texture coordinates are clamped to this: the resolution of larger float32 numbers is too low to
distinguish texels, and sums of very large ones overflow.
"""
MALFORMED = (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError)

log = logging.getLogger(__name__)


def read_gltf(path: Path) -> list[Mesh]:
    """Read the parts of the default scene; parts that consist of points have no faces.

    Raises:
        UserError: the file is damaged, exceeds its budget, or has content that isn't supported.
    """
    with parse_errors(path):
        return _Scene(Document(path)).parts()


@contextmanager
def parse_errors(path: Path) -> Iterator[None]:
    """Turn the errors that the damaged glTF file ``path`` causes in the block into UserError."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # dropped later
            yield
    except UserError:
        raise
    except OSError as error:
        fail(path, error.strerror or str(error))
    except MALFORMED as error:
        fail(path, f"its JSON isn't that of a glTF file ({type(error).__name__}: {error})")


class _Scene:
    """The meshes of a document, transformed by the nodes of its default scene."""

    def __init__(self, document: Document) -> None:
        self.document, self.materials = document, Materials(document)
        self.worlds = world_matrices(document)

    def parts(self) -> list[Mesh]:
        found = [part for node in self.worlds for part in self._parts_of(node)]
        return [part for part in found if part is not None]

    def _parts_of(self, index: int) -> list[Optional[Mesh]]:
        node = self.document.entry("nodes", index)
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            self.document.fail("it has instances by EXT_mesh_gpu_instancing, which isn't read here")
        if "mesh" not in node:
            return []
        mesh = self.document.entry("meshes", node["mesh"])
        weights = node.get("weights", mesh.get("weights", []))
        weights = self.document.numbers(weights, len(weights), "the weights of a mesh")
        return [self._part(index, node, primitive, weights) for primitive in mesh["primitives"]]

    def _part(
        self, index: int, node: dict[str, Any], primitive: dict[str, Any], weights: np.ndarray
    ) -> Optional[Mesh]:
        """Return one primitive, transformed to the world; None for lines or without positions."""
        mode, attributes = primitive.get("mode", TRIANGLES), primitive["attributes"]
        if mode in LINES or "POSITION" not in attributes:
            return None
        count = self.document.count(attributes["POSITION"])
        self.document.budget.spend_geometry(count, 0)
        corners = self._corners(primitive, count)
        self.document.budget.spend_geometry(0, len(corners) // (3 if mode == TRIANGLES else 1))
        faces = self._faces(mode, corners)
        positions = self._attribute(primitive, "POSITION", ("VEC3",), count, weights)
        world = self.worlds[index]
        if "skin" in node:
            vertices = skinned(self.document, node["skin"], attributes, positions, self.worlds)
        else:
            vertices = positions.astype(np.float64)
            if not np.array_equal(world, np.eye(4)):
                vertices = vertices @ world[:3, :3].T + world[:3, 3]
            if np.linalg.det(world[:3, :3]) < 0:
                faces = faces[:, ::-1]  # glTF: a mirrored node reverses the winding of its faces
        part = Mesh(vertices, faces, vertex_colors=self._colors(primitive, count, weights))
        return self._with_material(part, primitive, weights)

    # -- faces -------------------------------------------------------------------------------------

    def _corners(self, primitive: dict[str, Any], count: int) -> Integer[np.ndarray, " C"]:
        """Return the vertices in the order in which faces take them."""
        if "indices" not in primitive:
            return np.arange(count)
        values = self.document.accessor(primitive["indices"], ("SCALAR",)).values[:, 0]
        if values.dtype not in [np.dtype(kind) for kind in INDICES]:
            self.document.fail("the indices of a mesh should be unsigned integers")
        if len(values) and values.max() >= count:
            self.document.fail(f"a face names vertex {values.max()} of {count}")
        return values

    def _faces(self, mode: Any, corners: np.ndarray) -> Integer[np.ndarray, "F 3"]:
        corners = corners.astype(np.int64)
        first = np.arange(max(len(corners) - 2, 0))
        if mode == TRIANGLES:
            if len(corners) % 3:
                self.document.fail(f"{len(corners)} corners don't make triangles")
            return corners.reshape(-1, 3)
        if mode == STRIP:  # every second triangle has the opposite winding
            odd = first % 2
            return np.stack([corners[first + i] for i in (0, 1 + odd, 2 - odd)], axis=1)
        if mode == FAN:
            hub = np.broadcast_to(corners[:1], first.shape) if len(first) else first
            return np.stack([corners[first + 1], corners[first + 2], hub], axis=1)
        if mode == POINTS:
            return np.zeros((0, 3), np.int64)
        self.document.fail(f"a primitive of mode {str(mode)[:20]} is unknown")

    # -- attributes --------------------------------------------------------------------------------

    def _attribute(
        self,
        primitive: dict[str, Any],
        name: str,
        kinds: tuple[str, ...],
        count: int,
        weights: Float[np.ndarray, " T"],
        *,
        normalize: bool = False,
    ) -> Float[np.ndarray, "V W"]:
        """Return an attribute of the vertices with its morph targets added (float32)."""
        values = self._rows(primitive["attributes"][name], name, kinds, count, normalize)
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if name in target and weight:
                offsets = self._rows(target[name], name, kinds, count, normalize)
                width = min(offsets.shape[1], values.shape[1])
                values[:, :width] += np.float32(weight) * offsets[:, :width]
        return values

    def _rows(
        self, index: Any, name: str, kinds: tuple[str, ...], count: int, normalize: bool
    ) -> np.ndarray:
        values = self.document.accessor(index, kinds).floats(normalize=normalize)
        if len(values) != count:
            self.document.fail(f"{name} has {len(values)} rows for {count} vertices")
        return values

    def _colors(
        self, primitive: dict[str, Any], count: int, weights: np.ndarray
    ) -> Optional[np.ndarray]:
        if "COLOR_0" not in primitive["attributes"]:
            return None
        kinds = ("VEC3", "VEC4")
        colors = self._attribute(primitive, "COLOR_0", kinds, count, weights, normalize=True)
        return unit_rgb(colors)

    def _with_material(self, part: Mesh, primitive: dict[str, Any], weights: np.ndarray) -> Mesh:
        """Return the part with factor times COLOR_0 as vertex colours, and the texture."""
        surface = self.materials.surface(primitive.get("material"))
        if surface.factor is not None:
            own = 1 if part.vertex_colors is None else part.vertex_colors
            colors = np.broadcast_to(surface.factor * own, part.vertices.shape)
            part = part._replace(vertex_colors=colors)
        if surface.texture is None or not len(part.faces):
            return part
        name = f"TEXCOORD_{surface.coordinates}"
        if name not in primitive["attributes"]:
            log.warning("%s has a texture for %s, which is missing", self.document.path, name)
            return part
        uv = self._attribute(primitive, name, ("VEC2",), len(part.vertices), weights)
        return part._replace(
            uv=_texture_coordinates(uv, surface), texture=surface.texture, tiles=(surface.tile,)
        )


def _texture_coordinates(
    uv: Float[np.ndarray, "V 2"], surface: Surface
) -> Float[np.ndarray, "V 2"]:
    """Return coordinates as ``Mesh`` has them: transformed, and v upwards."""
    uv = np.nan_to_num(uv).clip(-LARGEST_UV, LARGEST_UV)
    if surface.transform is not None:
        moved = uv @ surface.transform[:, :2].T + surface.transform[:, 2]
        uv = np.nan_to_num(moved).clip(-LARGEST_UV, LARGEST_UV).astype(np.float32)
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)
