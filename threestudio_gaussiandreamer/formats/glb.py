"""Gaussians in GLB files by the glTF extension KHR_gaussian_splatting, plain or as SPZ.

Scales and opacities are linear, quaternions xyzw, harmonics with the Condon-Shortley phase as in a
PLY, all float32; axes are y up, front +z. ``COLOR_0`` lets programs without the extension show
coloured points. ``extras`` of the asset hold antialiasing and notes.

Files with an SPZ in a buffer view are written as CesiumJS reads them, which takes SPZ's coordinates
for glTF's. The draft of that extension wants them half a turn apart; files of programs that follow
it are known by the ``kernel`` that Cesium's lack. Other compressions and kernels aren't read."""

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..gaussians.axes import placed, rotate
from ..gaussians.gaussians import Gaussians, finite, joined
from ..gaussians.sh import COEFFICIENTS, sh0_colors
from ..meshes.gltf import Document, World, world_matrices
from ..meshes.mesh import srgb_to_linear
from ..meshes.write import accessor, write_glb_file
from . import packing
from .reading import reading, require, require_file_memory
from .spz import spz_arrays, spz_bytes

logger = logging.getLogger(__name__)
GLB_UP = "y"
EXTENSION = "KHR_gaussian_splatting"
SPZ = f"{EXTENSION}_compression_spz_2"
SPLATTING = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
POINTS, ARRAY_BUFFER = 0, 34962
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 300, 72
"""Upper bounds of the memory that reading takes, per Gaussian and per harmonic of a Gaussian."""
HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""About the y axis."""


def write_glb(path: str | os.PathLike, gaussians: Gaussians, notes: Sequence[str] = ()) -> None:
    """Write a GLB atomically, without Gaussians that can't be drawn.

    Args:
        gaussians: with y up.
        notes: ASCII lines for the asset's ``extras``, which other readers ignore.

    Raises:
        UserError: harmonics above degree 3, or the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    attributes = _attributes(gaussians)
    blocks = [values.tobytes() for values in attributes.values()]
    write_glb_file(path, _document(attributes, gaussians.means, notes), blocks)


def write_spz_glb(path: str | os.PathLike, gaussians: Gaussians, notes: Sequence[str] = ()) -> None:
    """Write a GLB with an SPZ file inside; arguments and errors are those of :func:`write_glb`."""
    gaussians = finite(gaussians, str(path))
    # arrays without content stand for what the SPZ holds; CesiumJS knows no OPACITY and DEGREE_0
    zero = np.broadcast_to(np.float32(0), (len(gaussians.means), 4))
    attributes = {
        "POSITION": zero[:, :3],
        "COLOR_0": zero.astype(np.uint8),
        f"{EXTENSION}:ROTATION": zero,
        f"{EXTENSION}:SCALE": zero[:, :3],
        **dict.fromkeys(_semantics(gaussians.sh.shape[1])[1:], zero[:, :3]),
    }
    document = _document(attributes, gaussians.means, notes)
    if len(gaussians.means):
        (primitive,) = document["meshes"][0]["primitives"]
        primitive["extensions"] = {EXTENSION: {"extensions": {SPZ: {"bufferView": 0}}}}
        document["extensionsUsed"] = document["extensionsRequired"] = [EXTENSION, SPZ]
        document["bufferViews"] = [{}]
        # CesiumJS needs the matrix even where it is the identity
        document["nodes"] = [{"mesh": 0, "matrix": np.eye(4).ravel().tolist()}]
        for entry in document["accessors"]:
            del entry["bufferView"]
    blocks = [spz_bytes(gaussians)] if len(gaussians.means) else []
    write_glb_file(path, document, blocks)


def read_glb(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read the Gaussians of all nodes of the default scene, with y up, and the notes of our writer.

    Raises:
        UserError: there is no such file, it is damaged, or holds no Gaussians that are supported.
    """
    with reading(path, "GLB file") as file:
        document = Document(file)
        found, total, needed = list(_primitives(document)), 0, 0
        for attributes in (primitive["attributes"] for primitive, _ in found):
            count = document.count(attributes["POSITION"])
            each = DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * _harmonics(attributes)
            total, needed = total + count, needed + count * each
        require_file_memory(needed, file.stat().st_size, f"{total} Gaussians")
        parts = [
            placed(_read_primitive(document, primitive), world, f"GLB file {str(path)!r}")
            for primitive, world in found
        ]
        known = bool(parts) or EXTENSION in document.json.get("extensionsUsed", [])
        require(known, f"no primitive has the extension {EXTENSION}: it holds no Gaussians")
        asset, gaussians = document.json["asset"], joined(parts)
        extras = asset.get("extras")
        notes = extras.get("notes") if isinstance(extras, dict) else None
    # it turns the axes of a PLY by half a turn about z, so that the front of its files is -z
    if str(asset.get("generator")).startswith("splat-transform"):
        gaussians = rotate(gaussians, HALF_TURN)
    return gaussians, [str(note) for note in notes] if isinstance(notes, list) else []


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the attributes by semantic; their rows have multiples of 4 bytes, as glTF requires."""
    opacity = packing.opacities(gaussians.logit_opacities)[:, None]
    fallback = np.concatenate([srgb_to_linear(sh0_colors(gaussians.sh[:, 0])), opacity], axis=1)
    named = {
        "POSITION": gaussians.means,
        "COLOR_0": packing.to_byte(255 * fallback),
        f"{EXTENSION}:ROTATION": packing.unit_quats(gaussians.quats)[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(gaussians.log_scales),
        f"{EXTENSION}:OPACITY": opacity,
    }
    harmonics = gaussians.sh.transpose(1, 0, 2)
    named |= dict(zip(_semantics(len(harmonics)), harmonics, strict=True))
    return {
        name: np.ascontiguousarray(values, None if values.dtype == np.uint8 else "<f4")
        for name, values in named.items()
    }


def _semantics(harmonics: int) -> list[str]:
    """Name the attributes of (degree + 1)^2 harmonics, in their order."""
    degrees = range(COEFFICIENTS.index(harmonics) + 1)
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in degrees for n in range(2 * d + 1)]


def _document(
    attributes: dict[str, np.ndarray], means: Float[np.ndarray, "N 3"], notes: Sequence[str]
) -> dict[str, Any]:
    """Return the JSON; an empty cloud is a scene without nodes, since accessors can't be empty."""
    asset: dict[str, Any] = {"version": "2.0", "generator": "threestudio-gaussiandreamer"}
    asset |= {"extras": {"notes": list(notes)}} if notes else {}
    head = {"asset": asset, "extensionsUsed": [EXTENSION], "scene": 0}
    if not len(means):
        return head | {"scenes": [{"name": "no Gaussians"}]}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {EXTENSION: SPLATTING},
    }
    accessors = [accessor(index, values) for index, values in enumerate(attributes.values())]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    return head | {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "bufferViews": [{"target": ARRAY_BUFFER} for _ in attributes],
        "accessors": accessors,
    }


def _primitives(document: Document) -> Iterator[tuple[dict[str, Any], World]]:
    """Yield each primitive that holds Gaussians, and its node's matrix to world coordinates."""
    for node, world in world_matrices(document).items():
        entry = document.entry("nodes", node)
        if "mesh" in entry:
            for primitive in document.entry("meshes", entry["mesh"])["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, world


def _harmonics(attributes: dict[str, int]) -> int:
    """Return the number of harmonics, by the highest degree whose last coefficient is present."""
    found = [k for k in COEFFICIENTS if _semantics(k)[-1] in attributes]
    return max(found, default=COEFFICIENTS[0])


def _read_primitive(document: Document, primitive: dict[str, Any]) -> Gaussians:
    extension = primitive["extensions"][EXTENSION]
    kernel = extension.get("kernel", SPLATTING["kernel"])
    said = f"its Gaussians have the kernel {str(kernel)[:40]!r}; 'ellipse' was expected"
    require(kernel == SPLATTING["kernel"], said)
    if SPZ in (inner := extension.get("extensions", {})):
        view, _ = document.view(inner[SPZ].get("bufferView"))
        gaussians, _ = spz_arrays(bytes(view))
        count = document.count(primitive["attributes"]["POSITION"])
        said = f"its SPZ has {len(gaussians.means)} rows for {count} Gaussians"
        require(len(gaussians.means) == count, said)
        gaussians = rotate(gaussians, HALF_TURN) if "kernel" in extension else gaussians
    else:
        gaussians = _read_plain(document, primitive["attributes"], inner)
    space = extension.get("colorSpace", SPLATTING["colorSpace"])
    if packing.is_linear(space):
        return packing.displayed(gaussians, str(document.path))
    if "709" not in str(space):
        logger.warning("%s: colours of %r are read as sRGB", document.path, str(space)[:40])
    return gaussians


def _read_plain(document: Document, attributes: dict[str, int], inner: dict[str, Any]) -> Gaussians:
    count = document.count(attributes["POSITION"])
    stored = document.entry("accessors", attributes["POSITION"])
    packed = inner and not {"bufferView", "sparse"} & stored.keys()
    require(not packed, f"its Gaussians are compressed by {str([*inner])[:80]}, which isn't read")

    def rows(semantic: str, kind: str) -> np.ndarray:
        require(semantic in attributes, f"its Gaussians lack the attribute {semantic}")
        values = document.accessor(attributes[semantic], (kind,)).floats()
        said = f"{semantic} has {len(values)} rows for {count} Gaussians"
        require(len(values) == count, said)
        return values

    opacity = rows(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0]
    scales = rows(f"{EXTENSION}:SCALE", "VEC3")
    if count and np.median(scales) < 0:
        logger.warning("%s: scales are read as logarithms, as drafts of 2026 had", document.path)
    else:
        require(not (scales < 0).any(), "some of its scales are below 0")
        scales = np.log(scales)
    return Gaussians(
        means=rows("POSITION", "VEC3"),
        quats=rows(f"{EXTENSION}:ROTATION", "VEC4")[:, [3, 0, 1, 2]],
        log_scales=scales,
        logit_opacities=packing.logits(opacity, packing.FLOAT_OPACITY_MARGIN),
        sh=np.stack([rows(name, "VEC3") for name in _semantics(_harmonics(attributes))], axis=1),
    )
