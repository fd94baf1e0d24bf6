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
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float, Integer, UInt8

from ..core.errors import UserError
from ..core.quaternions import rotation_rows
from .gltf_document import INDICES, Document
from .mesh import CLAMP, MIRROR, REPEAT, Mesh, Tile, linear_to_srgb, unit_rgb
from .side_files import decode_texture, fail

POINTS, LINES, TRIANGLES, STRIP, FAN = 0, (1, 2, 3), 4, 5, 6
LARGEST_UV = 2.0**20
"""Texture coordinates are clamped to this: the resolution of larger float32 numbers is too low to
distinguish texels, and sums of very large ones overflow.
"""
WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
NEAREST = 9728
UNREAD_IMAGES = ("KHR_texture_basisu", "MSFT_texture_dds")
UNSET_FACTOR = [0.4, 0.4, 0.4]
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""
MALFORMED = (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError)

World = Float[np.ndarray, "4 4"]

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


# ---- materials -----------------------------------------------------------------------------------


class Surface(NamedTuple):
    """The base colour of a material."""

    factor: Optional[Float[np.ndarray, "3"]] = None
    """Display values in [0, 1]; None where the material names none."""
    texture: Optional[UInt8[np.ndarray, "H W 3"]] = None
    tile: Optional[Tile] = None
    coordinates: int = 0
    """The texture's set of coordinates, TEXCOORD_n."""
    transform: Optional[Float[np.ndarray, "2 3"]] = None
    """Applied to them, v downwards."""


class Materials:
    """The materials of a document; each image is decoded once."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._surfaces: dict[int, Surface] = {}
        self._textures: dict[int, Optional[np.ndarray]] = {}

    def surface(self, index: Any) -> Surface:
        """Return the base colour of the material of this index; None = the default material."""
        if index is None:
            return Surface()
        if index not in self._surfaces:
            self._surfaces[index] = self._read(self.document.entry("materials", index))
        return self._surfaces[index]

    def _read(self, material: dict[str, Any]) -> Surface:
        old = _extension(material, "KHR_materials_pbrSpecularGlossiness")
        model = material.get("pbrMetallicRoughness", {}) if old is None else old
        names = ("baseColorTexture", "baseColorFactor")
        if old is not None:
            names = ("diffuseTexture", "diffuseFactor")
        surface = Surface(factor=self._factor(model.get(names[1]), textured=names[0] in model))
        info = model.get(names[0])
        texture = None if info is None else self._image(self._texture(info))
        if texture is None:
            return surface
        transform = _extension(info, "KHR_texture_transform") or {}
        return surface._replace(
            texture=texture,
            tile=self._tile(self._texture(info), texture),
            coordinates=transform.get("texCoord", info.get("texCoord", 0)),
            transform=self._transform(transform) if transform else None,
        )

    def _factor(self, factor: Any, textured: bool) -> Optional[np.ndarray]:
        if factor is None:
            return None
        rgb = self.document.numbers(factor, 4, "the colour of a material")[:3]
        by_trimesh = "trimesh" in str(self.document.json["asset"].get("generator"))
        if (by_trimesh and rgb.tolist() == UNSET_FACTOR) or (textured and (rgb == 1).all()):
            return None
        return linear_to_srgb(unit_rgb(rgb[None])[0])

    def _texture(self, info: dict[str, Any]) -> dict[str, Any]:
        return self.document.entry("textures", info.get("index"))

    def _image(self, texture: dict[str, Any]) -> Optional[np.ndarray]:
        """Return the picture of a texture; None, with a warning, where its file is missing."""
        source = (_extension(texture, "EXT_texture_webp") or texture).get("source")
        if source is None:
            source = texture.get("source")
        if source is None:
            kinds = [name for name in UNREAD_IMAGES if _extension(texture, name) is not None]
            self.document.fail(f"a texture has no PNG, JPEG or WebP image, only {kinds or 'none'}")
        if source not in self._textures:
            self._textures[source] = self._decoded(source)
        return self._textures[source]

    def _decoded(self, index: Any) -> Optional[np.ndarray]:
        image = self.document.entry("images", index)
        if "bufferView" in image:
            data = bytes(self.document.view(image["bufferView"])[0])
        else:
            data = self.document.resource(image.get("uri"), f"image {index}")
        if data is None:
            return None
        return decode_texture(data, str(image.get("name", index))[:80], self.document.budget)

    def _tile(self, texture: dict[str, Any], picture: np.ndarray) -> Tile:
        height, width = picture.shape[:2]
        sampler = {}
        if "sampler" in texture:
            sampler = self.document.entry("samplers", texture["sampler"])
        wraps = [sampler.get(key, 10497) for key in ("wrapS", "wrapT")]
        if not all(wrap in WRAPS for wrap in wraps):
            self.document.fail(f"a texture wraps by {str(wraps)[:60]}; {list(WRAPS)} are known")
        return Tile(
            0, width, height, *(WRAPS[w] for w in wraps), sampler.get("magFilter") == NEAREST
        )

    def _transform(self, transform: dict[str, Any]) -> np.ndarray:
        """Return KHR_texture_transform as a matrix: scale, then rotate, then move.

        The rotation is counter-clockwise as seen in the texture, whose v grows downwards.
        """
        numbers = self.document.numbers
        offset = numbers(transform.get("offset", [0, 0]), 2, "a texture's offset")
        scale = numbers(transform.get("scale", [1, 1]), 2, "a texture's scale")
        (angle,) = numbers([transform.get("rotation", 0)], 1, "a texture's rotation")
        c, s = math.cos(angle), math.sin(angle)
        return np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])


def _extension(entry: dict[str, Any], name: str) -> Optional[dict[str, Any]]:
    return entry.get("extensions", {}).get(name)


def _texture_coordinates(
    uv: Float[np.ndarray, "V 2"], surface: Surface
) -> Float[np.ndarray, "V 2"]:
    """Return coordinates as ``Mesh`` has them: transformed, and v upwards."""
    uv = np.nan_to_num(uv).clip(-LARGEST_UV, LARGEST_UV)
    if surface.transform is not None:
        moved = uv @ surface.transform[:, :2].T + surface.transform[:, 2]
        uv = np.nan_to_num(moved).clip(-LARGEST_UV, LARGEST_UV).astype(np.float32)
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


# ---- poses ---------------------------------------------------------------------------------------


def world_matrices(document: Document) -> dict[int, World]:
    """Return the matrix from each node of the default scene to the world, parents first.

    Without scenes, the nodes that are no children are the roots.

    Raises:
        UserError: a node is shown twice, which would be a cycle or no tree.
    """
    worlds: dict[int, World] = {}
    waiting = [(root, np.eye(4)) for root in reversed(_roots(document))]
    while waiting:
        index, above = waiting.pop()
        node = document.entry("nodes", index)
        if index in worlds:
            document.fail(f"node {index} has two parents")
        worlds[index] = above @ local_matrix(document, node)
        waiting += [(child, worlds[index]) for child in reversed(node.get("children", []))]
    return worlds


def _roots(document: Document) -> list[Any]:
    if document.json.get("scenes"):
        return document.entry("scenes", document.json.get("scene", 0)).get("nodes", [])
    nodes = document.json.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def local_matrix(document: Document, node: dict[str, Any]) -> World:
    """Return a node's matrix to its parent: its own, or T R S."""
    if "matrix" in node:
        return document.numbers(node["matrix"], 16, "the matrix of a node").reshape(4, 4).T
    matrix = np.eye(4)
    rotation = document.numbers(node.get("rotation", [0, 0, 0, 1]), 4, "the rotation of a node")
    scale = document.numbers(node.get("scale", [1, 1, 1]), 3, "the scale of a node")
    matrix[:3, :3] = rotation_matrix(rotation) * scale
    matrix[:3, 3] = document.numbers(node.get("translation", [0] * 3), 3, "the place of a node")
    return matrix


def rotation_matrix(xyzw: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion; zero is the identity."""
    if not xyzw.any():
        return np.eye(3)
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(rotation_rows(w, x, y, z))


def skinned(
    document: Document,
    skin: Any,
    attributes: dict[str, Any],
    positions: Float[np.ndarray, "V 3"],
    worlds: dict[int, World],
) -> Float[np.ndarray, "V 3"]:
    """Return the vertices of a skinned mesh in the pose of its joints.

    The mesh's own node doesn't move it (glTF 2.0, 3.7.3.3); each vertex is moved by the weighted
    mean of its joints' matrices.
    """
    matrices = _joint_matrices(document, document.entry("skins", skin), worlds)
    blended, total = np.zeros((len(positions), 4, 4)), np.zeros(len(positions))
    document.budget.spend(blended.nbytes, "a skinned mesh")
    for joints, weights in _influences(document, attributes, len(positions)):
        if joints.size and joints.max() >= len(matrices):
            document.fail(f"a vertex follows joint {joints.max()} of {len(matrices)}")
        for column in range(4):
            blended += weights[:, column, None, None] * matrices[joints[:, column]]
            total += weights[:, column]
    blended /= np.where(total > 0, total, 1)[:, None, None]
    return np.einsum("vij,vj->vi", blended[:, :3, :3], positions) + blended[:, :3, 3]


def _joint_matrices(
    document: Document, skin: dict[str, Any], worlds: dict[int, World]
) -> Float[np.ndarray, "J 4 4"]:
    joints = skin["joints"]
    if any(joint not in worlds for joint in joints):
        document.fail("a joint of a skin isn't in the scene")
    matrices = np.stack([worlds[joint] for joint in joints])
    if "inverseBindMatrices" not in skin:
        return matrices
    inverse = document.accessor(skin["inverseBindMatrices"], ("MAT4",)).floats()
    if len(inverse) < len(joints):
        document.fail(f"a skin has {len(inverse)} matrices for {len(joints)} joints")
    return matrices @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)


def _influences(document: Document, attributes: dict[str, Any], count: int):
    """Yield the joints (V, 4) and their weights (V, 4) of each set of attributes."""
    sets = sum(name.startswith("JOINTS_") for name in attributes)
    for number in range(sets):
        joints = document.accessor(attributes[f"JOINTS_{number}"], ("VEC4",)).values
        weights = document.accessor(attributes[f"WEIGHTS_{number}"], ("VEC4",))
        if joints.dtype.kind != "u" or not len(joints) == len(weights.values) == count:
            document.fail("the joints of a skinned mesh don't fit its vertices")
        yield joints, weights.floats(normalize=True)


# ---- scenes --------------------------------------------------------------------------------------


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
