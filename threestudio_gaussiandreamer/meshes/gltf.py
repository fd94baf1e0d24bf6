"""Triangle meshes and points of glTF 2.0 files (``.glb``, ``.gltf``), in the scene's axes.

Supported: the default scene with its transforms; triangles, strips, fans and points, with or
without indices; all component types, normalised, strided and sparse; morph targets with their
default weights; skins in the pose of their joints; base colours with factor, texture, sampler, any
set of texture coordinates, KHR_texture_transform, and COLOR_0. Files are rejected if they have
compressed geometry (Draco, meshopt), instances by EXT_mesh_gpu_instancing, basisu or DDS textures,
or require any other unknown extension. Lines, lights, normals and animations are ignored.

Accessors, scenes and materials are decoded here, since trimesh ignores or misreads most of these
features, and pygltflib only parses the JSON.

Everything that the JSON says is checked where it is used, so that a damaged file is one message."""

import base64
import binascii
import json
import logging
import math
import struct
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Optional

import numpy as np
from jaxtyping import Float, Integer, UInt8

from ..core.errors import UserError
from ..core.quaternions import rotation_rows
from .mesh import CLAMP, MIRROR, REPEAT, Mesh, Tile, linear_to_srgb, unit_rgb
from .side_files import Budget, SideFiles, decode_texture, fail

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
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
INDICES = ("u1", "<u2", "<u4")
READ_EXTENSIONS = {
    "EXT_texture_webp",
    "KHR_gaussian_splatting",
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
HARMLESS_EXTENSIONS = {
    "EXT_lights_image_based",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_xmp_json_ld",
} | {
    f"KHR_materials_{name}"
    for name in (
        "anisotropy clearcoat diffuse_transmission dispersion emissive_strength ior iridescence "
        "sheen specular transmission volume"
    ).split()
}
"""Extensions that are ignored, since they don't affect unlit colours or geometry."""


class Numbers(NamedTuple):
    """What an accessor holds, as it is stored."""

    values: np.ndarray
    """(count, width) of the stored type."""
    normalized: bool

    def floats(self, *, normalize: bool = False) -> Float[np.ndarray, "N W"]:
        """Return float32; integers that are normalised, or all with ``normalize``, as fractions."""
        kind = self.values.dtype
        if kind.kind == "f" or not (self.normalized or normalize):
            return self.values.astype(np.float32)
        fractions = self.values.astype(np.float32) / np.iinfo(kind).max
        return np.maximum(fractions, -1.0)  # the lowest signed integer is -1 too


class Document:
    """A parsed file; entries are looked up by kind and index.

    Args:
        path: a ``.glb`` or ``.gltf`` file.

    Raises:
        UserError: the file isn't glTF 2.0, is damaged, or requires an unsupported extension.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.budget = path, Budget(path)
        self.side_files = SideFiles(path, self.budget)
        data = path.read_bytes()
        is_glb = data[:4] == b"glTF"
        if path.suffix.lower() == ".glb" and not is_glb and data.lstrip()[:1] != b"{":
            self.fail(f"it isn't a GLB file, which begins with glTF, but with {data[:20]!r}")
        text, self._chunk = _glb_chunks(data, path) if is_glb else (data, None)
        self.json = _parsed(text, path)
        self._buffers: dict[int, memoryview] = {}
        self._check_version()
        self._check_extensions()

    def fail(self, problem: str) -> NoReturn:
        """Raise UserError with the reason why the file can't be read."""
        fail(self.path, problem)

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return the object with this index in the list ``kind`` ("nodes", "meshes", ...)."""
        entries = self.json.get(kind, [])
        if not isinstance(entries, list) or type(index) is not int:
            self.fail(f"its JSON isn't that of a glTF file: {kind} {str(index)[:40]!r}")
        if not 0 <= index < len(entries) or not isinstance(entries[index], dict):
            self.fail(f"it names number {index} of {len(entries)} {kind}")
        return entries[index]

    def numbers(self, values: Any, count: int, what: str) -> Float[np.ndarray, " count"]:
        """Convert a list of the JSON to float64.

        Raises:
            UserError: it isn't a list of ``count`` numbers; ``what`` names it in the message.
        """
        usual = isinstance(values, (list, tuple)) and len(values) == count
        if not usual or not all(type(value) in (int, float) for value in values):
            self.fail(f"{what} should be {count} numbers, not {str(values)[:80]}")
        try:
            return np.array([float(value) for value in values])
        except OverflowError:
            self.fail(f"{what} has a number beyond floating point")

    def size(self, entry: dict[str, Any], key: str, default: Optional[int] = None) -> int:
        """Return a count or an offset of an entry.

        Raises:
            UserError: it is missing and has no default, or is no integer of 0 or more.
        """
        value = entry.get(key, default)
        if type(value) is not int or value < 0:
            self.fail(f"{key} should be 0 or more, not {str(value)[:40]}")
        return value

    # -- extensions --------------------------------------------------------------------------------

    def _check_version(self) -> None:
        asset = self.json.get("asset", {})
        version = asset.get("version") if isinstance(asset, dict) else None
        if not str(version).startswith("2."):
            self.fail(f"it is glTF of version {str(version)[:20]}; version 2 was expected")

    def _check_extensions(self) -> None:
        required = self.json.get("extensionsRequired", [])
        if not isinstance(required, list):
            self.fail("its JSON isn't that of a glTF file: extensionsRequired")
        for name in required:
            if name not in READ_EXTENSIONS | HARMLESS_EXTENSIONS:
                self.fail(
                    f"it requires the glTF extension {str(name)[:80]!r}, which isn't read here: "
                    "export it without that (Draco and meshopt compression off, PNG or JPEG "
                    "textures)"
                )

    # -- binary data -------------------------------------------------------------------------------

    def view(self, index: Any) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride (0 = tightly packed)."""
        view = self.entry("bufferViews", index)
        content = self._buffer(view.get("buffer"))
        start, length = self.size(view, "byteOffset", 0), self.size(view, "byteLength")
        if start + length > len(content):
            self.fail(f"buffer view {index} ends after its buffer")
        return content[start : start + length], self.size(view, "byteStride", 0)

    def accessor(self, index: Any, kinds: tuple[str, ...]) -> Numbers:
        """Return the numbers of an accessor.

        Args:
            kinds: element types that are expected here, as "VEC3".
        """
        entry = self.entry("accessors", index)
        kind, component = entry.get("type"), entry.get("componentType")
        if kind not in kinds or component not in COMPONENTS:
            self.fail(
                f"accessor {index} is {str(kind)[:20]} of component type {str(component)[:20]}; "
                f"{' or '.join(kinds)} was expected"
            )
        shape = self.size(entry, "count"), WIDTHS[kind]
        dtype = np.dtype(COMPONENTS[component])
        values = self._dense(entry, index, shape, dtype)
        if "sparse" in entry:
            values = self._with_sparse(values, entry["sparse"], dtype)
        return Numbers(values, entry.get("normalized") is True)

    def count(self, index: Any) -> int:
        """Return how many elements an accessor announces."""
        return self.size(self.entry("accessors", index), "count")

    def _dense(
        self, entry: dict[str, Any], index: Any, shape: tuple[int, int], dtype: np.dtype
    ) -> np.ndarray:
        if "bufferView" in entry:
            place = entry["bufferView"], self.size(entry, "byteOffset", 0)
            return self._strided(*place, shape, dtype)
        if "sparse" not in entry:
            self.fail(
                f"the numbers of accessor {index} aren't in the file; if they are compressed "
                "(Draco, meshopt, SPZ), export it without that"
            )
        self.budget.spend(shape[0] * shape[1] * dtype.itemsize, f"accessor {index}")
        return np.zeros(shape, dtype)

    def _strided(
        self, view: Any, offset: int, shape: tuple[int, int], dtype: np.dtype
    ) -> np.ndarray:
        """Return rows of a buffer view without a copy."""
        content, stride = self.view(view)
        row = shape[1] * dtype.itemsize
        stride = stride or row
        if not shape[0]:
            return np.zeros(shape, dtype)
        if stride < row or offset + (shape[0] - 1) * stride + row > len(content):
            self.fail(f"an accessor reads {shape[0]} rows, which end after buffer view {view}")
        return np.ndarray(shape, dtype, content, offset, (stride, dtype.itemsize))

    def _with_sparse(self, values: np.ndarray, sparse: Any, dtype: np.dtype) -> np.ndarray:
        """Return a copy in which some rows are replaced."""
        count = self.size(sparse, "count")
        where = sparse["indices"]
        kind = COMPONENTS.get(where.get("componentType"))
        if kind not in INDICES:
            self.fail("the indices of a sparse accessor should be unsigned integers")
        offset = self.size(where, "byteOffset", 0)
        rows = self._strided(where.get("bufferView"), offset, (count, 1), np.dtype(kind))[:, 0]
        if count and rows.max() >= len(values):
            self.fail(f"a sparse accessor replaces row {rows.max()} of {len(values)}")
        entry, shape = sparse["values"], (count, values.shape[1])
        offset = self.size(entry, "byteOffset", 0)
        replacement = self._strided(entry.get("bufferView"), offset, shape, dtype)
        self.budget.spend(values.nbytes, "a sparse accessor")
        values = values.copy()
        values[rows] = replacement
        return values

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            entry = self.entry("buffers", index)
            if "uri" in entry:
                content = self.resource(entry["uri"], f"buffer {index}")
                if content is None:
                    self.fail(f"buffer {index} is missing")
            elif index == 0 and self._chunk is not None:
                content = self._chunk
            else:
                self.fail(f"buffer {index} isn't in the file")
            if len(content) < self.size(entry, "byteLength"):
                self.fail(f"buffer {index} is shorter than it should be")
            self._buffers[index] = memoryview(content)
        return self._buffers[index]

    def resource(self, uri: Any, what: str) -> Optional[bytes]:
        """Return the content of a data URI or of a file beside this one; None where it is missing.

        Raises:
            UserError: damaged, an address on the network, or not a regular file.
        """
        if not isinstance(uri, str):
            self.fail(f"the URI of {what} isn't text")
        scheme = urllib.parse.urlsplit(uri[:100]).scheme if ":" in uri[:100] else ""
        if scheme == "data":
            return self._data_uri(uri, what)
        if len(scheme) > 1:
            self.fail(f"{what} is at {uri[:80]!r}; only files beside the mesh are read")
        return self.side_files.read(urllib.parse.unquote(uri))

    def _data_uri(self, uri: str, what: str) -> bytes:
        head, _, body = uri.partition(",")
        try:
            if head.endswith(";base64"):
                return base64.b64decode(urllib.parse.unquote(body), validate=True)
            return urllib.parse.unquote_to_bytes(body)
        except (binascii.Error, ValueError) as error:
            self.fail(f"the data URI of {what} is damaged: {error}")


def _glb_chunks(data: bytes, path: Path) -> tuple[bytes, Optional[memoryview]]:
    """Return the JSON and the binary chunk of a GLB."""
    at, chunks = 12, []
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        at += 8 + size
        chunks.append((kind, memoryview(data)[at - size : at]))
    if not chunks or chunks[0][0] != b"JSON" or at > len(data):
        fail(path, "its chunks don't fill it")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return bytes(chunks[0][1]), binary


def _parsed(text: bytes, path: Path) -> dict[str, Any]:
    try:
        document = json.loads(text.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        fail(path, f"its JSON isn't valid ({str(error)[:100]})")
    if not isinstance(document, dict):
        fail(path, "its JSON isn't that of a glTF file")
    return document


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


# ---- scenes --------------------------------------------------------------------------------------


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
