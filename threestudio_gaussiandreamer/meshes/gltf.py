"""Triangle meshes and points of glTF 2.0 files (``.glb``, ``.gltf``), in the scene's axes, with
what trimesh ignores or misreads: strips, fans, normalised, strided and sparse accessors, morph
targets with their default weights, skins in the pose of their joints, samplers, any set of texture
coordinates, KHR_texture_transform, and COLOR_0. Files with compressed geometry (Draco, meshopt),
instances, basisu or DDS textures, or that require an unknown extension are rejected; lines, lights,
normals and animations are ignored."""

import base64
import json
import logging
import math
import struct
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float, Integer, UInt8

from ..core.tensors import rotation_rows
from ..formats.reading import reading, require, whole_number
from .mesh import CLAMP, MIRROR, REPEAT, Mesh, Tile, linear_to_srgb, unit_rgb
from .side_files import Budget, SideFiles, decode_texture

POINTS, LINES, TRIANGLES, STRIP, FAN = 0, (1, 2, 3), 4, 5, 6
LARGEST_UV = 2.0**20
"""Texture coordinates are clamped to this; larger float32 numbers don't tell texels apart."""
WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
NEAREST = 9728
UNREAD_IMAGES = ("KHR_texture_basisu", "MSFT_texture_dds")
UNSET_FACTOR = [0.4, 0.4, 0.4]
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""

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
MATERIALS = (
    "anisotropy clearcoat diffuse_transmission dispersion emissive_strength ior iridescence sheen "
    "specular transmission unlit variants volume"
)
HARMLESS_EXTENSIONS = {
    "EXT_lights_image_based",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_xmp_json_ld",
    *(f"KHR_materials_{name}" for name in MATERIALS.split()),
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
    """A parsed ``.glb`` or ``.gltf`` file, in which entries are looked up by kind and index. Opened
    and read inside :func:`reading`, since what is damaged raises errors of many types.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.budget = path, Budget(path)
        self.side_files = SideFiles(path, self.budget)
        data = path.read_bytes()
        is_glb = data[:4] == b"glTF"
        usual = is_glb or path.suffix.lower() != ".glb" or data.lstrip()[:1] == b"{"
        require(usual, f"it isn't a GLB file, which begins with glTF, but with {data[:20]!r}")
        text, self._chunk = _glb_chunks(data) if is_glb else (data, None)
        self.json = json.loads(text.decode("utf-8"), parse_constant=int)  # refuses NaN
        self._buffers: dict[int, memoryview] = {}
        version = str(self.json["asset"]["version"])
        said = f"it is glTF of version {version[:20]}; version 2 was expected"
        require(version.startswith("2."), said)
        for name in self.json.get("extensionsRequired", []):
            require(
                name in READ_EXTENSIONS | HARMLESS_EXTENSIONS,
                f"it requires the glTF extension {str(name)[:80]!r}, which isn't read here: export "
                "it without that (Draco and meshopt compression off, PNG or JPEG textures)",
            )

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return the object with this index in the list ``kind`` ("nodes", "meshes", ...)."""
        entries = self.json.get(kind, [])
        known = type(index) is int and 0 <= index < len(entries)
        require(known, f"it names number {str(index)[:40]} of {len(entries)} {kind}")
        return entries[index]

    def numbers(self, values: Any, count: int) -> Float[np.ndarray, " count"]:
        """Convert a list of the JSON, which must have ``count`` numbers, to float64."""
        require(len(values) == count, f"{count} numbers were expected, not {str(values)[:80]}")
        return np.array([float(value) for value in values])

    def view(self, index: Any) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride (0 = tightly packed)."""
        view = self.entry("bufferViews", index)
        content = self._buffer(view.get("buffer"))
        start, length = whole_number(view, "byteOffset", 0), whole_number(view, "byteLength")
        require(start + length <= len(content), f"buffer view {index} ends after its buffer")
        return content[start : start + length], whole_number(view, "byteStride", 0)

    def accessor(self, index: Any, kinds: tuple[str, ...]) -> Numbers:
        """Return the numbers of an accessor of one of these element types, as "VEC3"."""
        entry = self.entry("accessors", index)
        kind, component = entry.get("type"), entry.get("componentType")
        said = f"accessor {index} is {str(kind)[:20]} of component type {str(component)[:20]}"
        usual = kind in kinds and component in COMPONENTS
        require(usual, f"{said}; {' or '.join(kinds)} was expected")
        shape = whole_number(entry, "count"), WIDTHS[kind]
        dtype = np.dtype(COMPONENTS[component])
        if "bufferView" in entry:
            values = self._strided(entry, shape, dtype)
        else:
            require(
                "sparse" in entry,
                f"the numbers of accessor {index} aren't in the file; if they are compressed "
                "(Draco, meshopt, SPZ), export it without that",
            )
            self.budget.spend(shape[0] * shape[1] * dtype.itemsize, f"accessor {index}")
            values = np.zeros(shape, dtype)
        if "sparse" in entry:
            values = self._with_sparse(values, entry["sparse"], dtype)
        return Numbers(values, entry.get("normalized") is True)

    def count(self, index: Any) -> int:
        """Return how many elements an accessor announces."""
        return whole_number(self.entry("accessors", index), "count")

    def _strided(
        self, entry: dict[str, Any], shape: tuple[int, int], dtype: np.dtype
    ) -> np.ndarray:
        """Return rows of an entry's buffer view without a copy."""
        content, stride = self.view(entry.get("bufferView"))
        row = shape[1] * dtype.itemsize
        if not shape[0]:
            return np.zeros(shape, dtype)
        start, stride = whole_number(entry, "byteOffset", 0), stride or row
        require(stride >= row, f"rows of {row} bytes can't be {stride} bytes apart")
        end = start + (shape[0] - 1) * stride + row  # NumPy doesn't check it where it overflows
        require(end <= len(content), "an accessor ends after its buffer view: it is damaged")
        return np.ndarray(shape, dtype, content, start, (stride, dtype.itemsize))

    def _with_sparse(self, values: np.ndarray, sparse: Any, dtype: np.dtype) -> np.ndarray:
        """Return a copy in which some rows are replaced."""
        count, where = whole_number(sparse, "count"), sparse["indices"]
        kind = COMPONENTS.get(where.get("componentType"))
        require(kind in INDICES, "the indices of a sparse accessor should be unsigned integers")
        rows = self._strided(where, (count, 1), np.dtype(kind))[:, 0]
        replacement = self._strided(sparse["values"], (count, values.shape[1]), dtype)
        self.budget.spend(values.nbytes, "a sparse accessor")
        values = values.copy()
        values[rows] = replacement
        return values

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            entry = self.entry("buffers", index)
            content = self._chunk if index == 0 else None
            if "uri" in entry:
                content = self.resource(entry["uri"], f"buffer {index}")
            require(content is not None, f"buffer {index} is missing: a file, or a GLB's BIN chunk")
            whole = len(content) >= whole_number(entry, "byteLength")
            require(whole, f"buffer {index} is shorter than it should be: it is truncated")
            self._buffers[index] = memoryview(content)
        return self._buffers[index]

    def resource(self, uri: str, what: str) -> Optional[bytes]:
        """Return the content of a data URI or of a file beside this one; None where it is missing.
        Other addresses are Unreadable.
        """
        scheme = urllib.parse.urlsplit(uri[:100]).scheme if ":" in uri[:100] else ""
        if scheme == "data":
            head, _, body = uri.partition(",")
            if head.endswith(";base64"):
                return base64.b64decode(urllib.parse.unquote(body), validate=True)
            return urllib.parse.unquote_to_bytes(body)
        said = f"{what} is at {uri[:80]!r}; only files beside the mesh are read"
        require(len(scheme) <= 1, said)
        return self.side_files.read(urllib.parse.unquote(uri))


def _glb_chunks(data: bytes) -> tuple[bytes, Optional[memoryview]]:
    """Return the JSON and the binary chunk of a GLB."""
    at, chunks = 12, []
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        at += 8 + size
        chunks.append((kind, memoryview(data)[at - size : at]))
    usual = bool(chunks) and chunks[0][0] == b"JSON" and at <= len(data)
    require(usual, "its chunks don't fill it: it is truncated or damaged")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return bytes(chunks[0][1]), binary


def read_gltf(path: Path) -> list[Mesh]:
    """Read the parts of the default scene; parts that consist of points have no faces.

    Raises:
        UserError: the file is damaged, exceeds its budget, or has content that isn't supported.
    """
    with reading(path, "mesh") as file:
        return list(_Scene(Document(file)).parts())


class Surface(NamedTuple):
    """The base colour of a material."""

    factor: Optional[Float[np.ndarray, "3"]] = None
    """Display values in [0, 1]."""
    texture: Optional[UInt8[np.ndarray, "H W 3"]] = None
    tile: Optional[Tile] = None
    coordinates: int = 0
    """The texture's set of coordinates, TEXCOORD_n."""
    transform: Optional[Float[np.ndarray, "2 3"]] = None
    """Applied to them, v downwards."""


def _extension(entry: dict[str, Any], name: str) -> Optional[dict[str, Any]]:
    return entry.get("extensions", {}).get(name)


def world_matrices(document: Document) -> dict[int, World]:
    """Return the matrix from each node of the default scene to the world, parents first. Without
    scenes, the nodes that are no children are the roots.
    """
    if document.json.get("scenes"):
        roots = document.entry("scenes", document.json.get("scene", 0)).get("nodes", [])
    else:
        nodes = document.json.get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    worlds: dict[int, World] = {}
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = document.entry("nodes", index)
        require(index not in worlds, f"node {index} has two parents")  # or is in a cycle
        worlds[index] = above @ _local_matrix(document, node)
        waiting += [(child, worlds[index]) for child in reversed(node.get("children", []))]
    return worlds


def _local_matrix(document: Document, node: dict[str, Any]) -> World:
    """Return a node's matrix to its parent: its own, or T R S."""
    if "matrix" in node:
        return document.numbers(node["matrix"], 16).reshape(4, 4).T
    matrix = np.eye(4)
    xyzw = document.numbers(node.get("rotation", [0, 0, 0, 1]), 4)
    if xyzw.any():  # zero is the identity
        x, y, z, w = xyzw / np.linalg.norm(xyzw)
        matrix[:3, :3] = rotation_rows(w, x, y, z)
    matrix[:3, :3] *= document.numbers(node.get("scale", [1, 1, 1]), 3)
    matrix[:3, 3] = document.numbers(node.get("translation", [0] * 3), 3)
    return matrix


class _Scene:
    """The transformed meshes of a document's default scene, and materials; decodes images once."""

    def __init__(self, document: Document) -> None:
        self.document, self.worlds = document, world_matrices(document)
        self._surfaces: dict[Any, Surface] = {None: Surface()}
        self._pictures: dict[Any, Optional[np.ndarray]] = {}

    def _surface(self, index: Any) -> Surface:
        """Return the base colour of the material of this index; None = the default material."""
        if index not in self._surfaces:
            self._surfaces[index] = self._read(self.document.entry("materials", index))
        return self._surfaces[index]

    def _read(self, material: dict[str, Any]) -> Surface:
        old = _extension(material, "KHR_materials_pbrSpecularGlossiness")
        model = material.get("pbrMetallicRoughness", {}) if old is None else old
        kind = "baseColor" if old is None else "diffuse"
        info, factor = model.get(f"{kind}Texture"), model.get(f"{kind}Factor")
        if factor is not None:
            rgb = self.document.numbers(factor, 4)[:3]
            by_trimesh = "trimesh" in str(self.document.json["asset"].get("generator"))
            unset = by_trimesh and rgb.tolist() == UNSET_FACTOR
            unset = unset or f"{kind}Texture" in model and (rgb == 1).all()
            factor = None if unset else linear_to_srgb(unit_rgb(rgb[None])[0])
        if info is None:
            return Surface(factor)
        texture = self.document.entry("textures", info.get("index"))
        source = (_extension(texture, "EXT_texture_webp") or texture).get("source")
        source = texture.get("source") if source is None else source
        kinds = [name for name in UNREAD_IMAGES if _extension(texture, name) is not None]
        said = f"a texture has no PNG, JPEG or WebP image, only {kinds or 'none'}"
        require(source is not None, said)
        if source not in self._pictures:
            self._pictures[source] = self._decoded(source)
        if (picture := self._pictures[source]) is None:
            return Surface(factor)
        moved = _extension(info, "KHR_texture_transform") or {}
        coordinates = moved.get("texCoord", info.get("texCoord", 0))
        matrix = self._transform(moved) if moved else None
        known = "sampler" in texture
        sampler = self.document.entry("samplers", texture["sampler"]) if known else {}
        wraps = [WRAPS[sampler.get(key, 10497)] for key in ("wrapS", "wrapT")]
        height, width = picture.shape[:2]
        tile = Tile(0, width, height, *wraps, sampler.get("magFilter") == NEAREST)
        return Surface(factor, picture, tile, coordinates, matrix)

    def _decoded(self, source: Any) -> Optional[np.ndarray]:
        """Return an image; None, with a warning, where its file is missing."""
        image = self.document.entry("images", source)
        if "bufferView" in image:
            data = bytes(self.document.view(image["bufferView"])[0])
        else:
            data = self.document.resource(image.get("uri"), f"image {source}")
        name = str(image.get("name", source))[:80]
        return None if data is None else decode_texture(data, name, self.document.budget)

    def _transform(self, transform: dict[str, Any]) -> np.ndarray:
        """Return KHR_texture_transform as a matrix: scale, rotate (v grows downwards), move."""
        numbers = self.document.numbers
        offset = numbers(transform.get("offset", [0, 0]), 2)
        scale = numbers(transform.get("scale", [1, 1]), 2)
        (angle,) = numbers([transform.get("rotation", 0)], 1)
        c, s = math.cos(angle), math.sin(angle)
        return np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])

    def parts(self) -> Iterator[Mesh]:
        """Yield each primitive of triangles or points."""
        for index in self.worlds:
            node = self.document.entry("nodes", index)
            instanced = "EXT_mesh_gpu_instancing" in node.get("extensions", {})
            said = "it has instances by EXT_mesh_gpu_instancing, which isn't read here"
            require(not instanced, said)
            if "mesh" not in node:
                continue
            mesh = self.document.entry("meshes", node["mesh"])
            weights = node.get("weights", mesh.get("weights", []))
            weights = self.document.numbers(weights, len(weights))
            for primitive in mesh["primitives"]:  # lines are ignored
                if "POSITION" in primitive["attributes"] and primitive.get("mode") not in LINES:
                    yield self._part(index, node, primitive, weights)

    def _part(
        self, index: int, node: dict[str, Any], primitive: dict[str, Any], weights: np.ndarray
    ) -> Mesh:
        """Return one primitive, transformed to the world."""
        mode, attributes = primitive.get("mode", TRIANGLES), primitive["attributes"]
        count = self.document.count(attributes["POSITION"])
        self.document.budget.spend_geometry(count, 0)
        corners = np.arange(count)
        if "indices" in primitive:
            corners = self.document.accessor(primitive["indices"], ("SCALAR",)).values[:, 0]
            require(corners.dtype.kind == "u", "the indices of a mesh should be unsigned integers")
            known = not len(corners) or corners.max() < count
            require(known, f"a face names a vertex beyond the last of {count}")
        self.document.budget.spend_geometry(0, len(corners) // (3 if mode == TRIANGLES else 1))
        faces = _faces(mode, corners.astype(np.int64))
        positions = self._attribute(primitive, "POSITION", count, weights)
        world, colors = self.worlds[index], None
        if "skin" in node:
            vertices = self._skinned(node["skin"], attributes, positions)
        else:
            vertices = positions.astype(np.float64)
            if not np.array_equal(world, np.eye(4)):
                vertices = vertices @ world[:3, :3].T + world[:3, 3]
            if np.linalg.det(world[:3, :3]) < 0:
                faces = faces[:, ::-1]  # glTF: a mirrored node reverses the winding of its faces
        if "COLOR_0" in attributes:
            colors = unit_rgb(self._attribute(primitive, "COLOR_0", count, weights))
        surface = self._surface(primitive.get("material"))
        if surface.factor is not None:  # times COLOR_0
            own = 1 if colors is None else colors
            colors = np.broadcast_to(surface.factor * own, vertices.shape)
        part = Mesh(vertices, faces, vertex_colors=colors)
        if surface.texture is None or not len(faces):
            return part
        name = f"TEXCOORD_{surface.coordinates}"
        if name not in attributes:
            log.warning("%s has a texture for %s, which is missing", self.document.path, name)
            return part
        uv = self._attribute(primitive, name, count, weights)
        uv = np.nan_to_num(uv).clip(-LARGEST_UV, LARGEST_UV)
        if surface.transform is not None:
            moved = uv @ surface.transform[:, :2].T + surface.transform[:, 2]
            uv = np.nan_to_num(moved).clip(-LARGEST_UV, LARGEST_UV).astype(np.float32)
        upwards = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)
        return part._replace(uv=upwards, texture=surface.texture, tiles=(surface.tile,))

    def _attribute(
        self, primitive: dict[str, Any], name: str, count: int, weights: Float[np.ndarray, " T"]
    ) -> Float[np.ndarray, "V W"]:
        """Return an attribute of the vertices with its morph targets added (float32)."""
        kinds = {"POSITION": ("VEC3",), "COLOR_0": ("VEC3", "VEC4")}.get(name, ("VEC2",))

        def rows(index: Any) -> np.ndarray:
            values = self.document.accessor(index, kinds).floats(normalize=name == "COLOR_0")
            require(len(values) == count, f"{name} has {len(values)} rows for {count} vertices")
            return values

        values = rows(primitive["attributes"][name])
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if name in target and weight:
                offsets = rows(target[name])
                width = min(offsets.shape[1], values.shape[1])
                values[:, :width] += np.float32(weight) * offsets[:, :width]
        return values

    def _skinned(
        self, skin: Any, attributes: dict[str, Any], positions: Float[np.ndarray, "V 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """Return vertices moved by their weighted joints, not by the node (glTF 2.0, 3.7.3.3)."""
        entry, count = self.document.entry("skins", skin), len(positions)
        matrices = np.stack([self.worlds[joint] for joint in entry["joints"]])
        if "inverseBindMatrices" in entry:
            inverse = self.document.accessor(entry["inverseBindMatrices"], ("MAT4",)).floats()
            inverse = inverse[: len(matrices)].reshape(len(matrices), 4, 4)
            matrices = matrices @ inverse.transpose(0, 2, 1)
        blended, total = np.zeros((count, 4, 4)), np.zeros(count)
        self.document.budget.spend(blended.nbytes, "a skinned mesh")
        for number in range(sum(name.startswith("JOINTS_") for name in attributes)):
            joints = self.document.accessor(attributes[f"JOINTS_{number}"], ("VEC4",)).values
            weights = self.document.accessor(attributes[f"WEIGHTS_{number}"], ("VEC4",))
            fit = joints.dtype.kind == "u" and len(joints) == len(weights.values) == count
            require(fit, "the joints of a skinned mesh don't fit its vertices")
            for joint, weight in zip(joints.T, weights.floats(normalize=True).T, strict=True):
                blended += weight[:, None, None] * matrices[joint]
                total += weight
        blended /= np.where(total > 0, total, 1)[:, None, None]
        return np.einsum("vij,vj->vi", blended[:, :3, :3], positions) + blended[:, :3, 3]


def _faces(mode: Any, corners: Integer[np.ndarray, " C"]) -> Integer[np.ndarray, "F 3"]:
    first = np.arange(max(len(corners) - 2, 0))
    if mode == TRIANGLES:
        return corners.reshape(-1, 3)
    if mode == STRIP:  # every second triangle has the opposite winding
        odd = first % 2
        return np.stack([corners[first + i] for i in (0, 1 + odd, 2 - odd)], axis=1)
    if mode == FAN:
        hub = np.broadcast_to(corners[:1], first.shape) if len(first) else first
        return np.stack([corners[first + 1], corners[first + 2], hub], axis=1)
    require(mode == POINTS, f"a primitive of mode {str(mode)[:20]} is unknown")
    return np.zeros((0, 3), np.int64)
