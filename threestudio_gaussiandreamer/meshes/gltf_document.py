"""The document of a glTF 2.0 file: its JSON, its buffers, and the numbers of its accessors.

Everything that the JSON says is checked where it is used, so that a damaged file is one message."""

import base64
import binascii
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Optional

import numpy as np
from jaxtyping import Float

from .side_files import Budget, SideFiles, fail

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
