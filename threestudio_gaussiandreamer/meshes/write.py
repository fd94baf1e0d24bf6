"""Write a textured mesh as GLB, or as OBJ with its MTL and PNG; both are y up, front +z.

Bytes of textures are stored as they are, display values. An OBJ names a position once however often
a seam repeats it, so the file is as closed as the mesh; a GLB repeats it, as glTF requires."""

import io
import json
import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from ..core.errors import UserError
from ..core.files import atomic_file, write_file
from ..gaussians.surface import Surface
from .mesh import Mesh

UNLIT = "KHR_materials_unlit"
COMPONENTS = {"u1": 5121, "u4": 5125, "f4": 5126}
LINEAR, CLAMP_TO_EDGE = 9729, 33071
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
NAME_BYTES = 63
"""Longest name that Blender keeps."""
MTL = """# threestudio-gaussiandreamer
newmtl {name}
Ka 0 0 0
Kd 1 1 1
Ks 0 0 0
Ns 0
Pr 1
Pm 0
illum {illum}
map_Kd {texture}
"""


class Welded(NamedTuple):
    positions: Float[np.ndarray, "W 3"]
    normals: Float[np.ndarray, "W 3"]
    rows: Int[np.ndarray, " V"]
    """The position of each vertex."""


def welded(mesh: Mesh) -> Welded:
    """Join the vertices of equal position, with normals weighted by the faces' areas."""
    positions, rows = np.unique(mesh.vertices, axis=0, return_inverse=True)
    rows = rows.reshape(-1)
    faces = rows[mesh.faces]
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    across = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(x, 3), len(positions)) for x in across.T]
    normals = np.stack(sums, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.maximum(length, 1e-300), [0, 1, 0])
    return Welded(positions, normals, rows)


def write_textured_mesh(
    path: str | os.PathLike, mesh: Mesh, *, unlit: bool = False, name: str = ""
) -> None:
    """Write a mesh with ``uv`` and ``texture`` as GLB or OBJ, by the extension.

    Args:
        unlit: ask viewers to show the texture without lighting.
        name: of the object, its material and its texture; by default the file's.

    Raises:
        UserError: the extension is another one, a value isn't finite, or the file can't be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise UserError(f"expected the name of a {' or '.join(WRITERS)} file, got {str(path)!r}")
    # some readers of OBJ end a name at a space
    printable = "".join(c if c.isprintable() else " " for c in name or Path(path).stem)
    name = "_".join(printable.split()).encode(errors="ignore")[:NAME_BYTES]
    WRITERS[suffix](path, mesh, unlit, name.decode(errors="ignore"))


def write_glb_file(
    path: str | os.PathLike, document: Mapping[str, Any], blocks: Sequence[bytes]
) -> None:
    """Write a GLB atomically.

    Args:
        document: the JSON, without buffers, and with one of ``bufferViews`` for each block, without
            buffer, offset and length.
        blocks: the binary content; padded to multiples of 4 bytes.
    """
    padded = [block + b"\0" * (-len(block) % 4) for block in blocks]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(block), **view}
        for start, block, view in zip(starts, blocks, document.get("bufferViews", ()), strict=False)
    ]
    content = {"bufferViews": views, "buffers": [{"byteLength": starts[-1]}]} if views else {}
    text = json.dumps({**document, **content}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + starts[-1]))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", starts[-1], b"BIN\0"))
        file.writelines(padded)


def write_textured_glb(
    path: str | os.PathLike, mesh: Mesh, unlit: bool = False, name: str = "mesh"
) -> None:
    """Write a mesh with ``uv`` and ``texture`` as GLB: its texture as base colour, metallic 0,
    roughness 1; ``unlit`` by KHR_materials_unlit.

    Raises:
        UserError: a value isn't finite, or the file can't be written.
    """
    _require_finite(path, mesh.vertices, mesh.uv)
    joined = welded(mesh)
    arrays = {
        "indices": mesh.faces.reshape(-1, 1).astype("<u4"),
        "POSITION": mesh.vertices.astype("<f4"),
        "NORMAL": joined.normals[joined.rows].astype("<f4"),
        "TEXCOORD_0": (mesh.uv * [1, -1] + [0, 1]).astype("<f4"),
    }
    blocks = [values.tobytes() for values in arrays.values()]
    write_glb_file(path, _document(arrays, unlit, name), [*blocks, png_bytes(mesh.texture)])


def _document(arrays: Mapping[str, np.ndarray], unlit: bool, name: str) -> dict[str, Any]:
    """Return the JSON of a GLB with one mesh; the arrays and the picture are its buffer views."""
    targets = [ELEMENT_ARRAY_BUFFER] + [ARRAY_BUFFER] * (len(arrays) - 1)
    accessors = [accessor(view, values) for view, values in enumerate(arrays.values())]
    places = arrays["POSITION"]
    accessors[1] |= {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    color = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": color}
    attributes = {name: view for view, name in enumerate(arrays) if name != "indices"}
    primitive = {"attributes": attributes, "indices": 0, "material": 0}
    # without mipmaps, which would mix parts of the texture that are far apart on the surface
    sampler = {"magFilter": LINEAR, "minFilter": LINEAR}
    sampler |= {"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
    return {
        "asset": {"version": "2.0", "generator": "threestudio-gaussiandreamer"},
        **({"extensionsUsed": [UNLIT]} if unlit else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [material | ({"extensions": {UNLIT: {}}} if unlit else {})],
        "textures": [{"name": name, "sampler": 0, "source": 0}],
        "samplers": [sampler],
        "images": [{"name": name, "bufferView": len(arrays), "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": [*({"target": target} for target in targets), {}],
    }


def accessor(view: int, values: np.ndarray) -> dict[str, Any]:
    """Return the JSON of an array (N, C) that fills a buffer view; bytes stand for fractions."""
    return {
        "bufferView": view,
        "componentType": COMPONENTS[values.dtype.str[1:]],
        "count": len(values),
        "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[values.shape[1]],
        **({"normalized": True} if values.dtype == np.uint8 else {}),
    }


def write_textured_obj(
    path: str | os.PathLike, mesh: Mesh, unlit: bool = False, name: str = "mesh"
) -> None:
    """Write a mesh with ``uv`` and ``texture`` as OBJ, and MTL and PNG of the same name beside it.

    Raises:
        UserError: a value isn't finite, or a file can't be written.
    """
    _require_finite(path, mesh.vertices, mesh.uv)
    texture, material = companions(path)
    write_file(texture, png_bytes(mesh.texture))
    write_file(material, MTL.format(name=name, illum=0 if unlit else 1, texture=texture.name))
    joined = welded(mesh)
    position, coordinate = joined.rows[mesh.faces] + 1, mesh.faces + 1
    corners = np.stack([position, coordinate, position], axis=2).reshape(-1, 9)
    with atomic_file(path) as file:
        head = f"mtllib {material.name}\no {name}\nusemtl {name}\n"
        file.write(head.encode(errors="surrogateescape"))
        np.savetxt(file, joined.positions, fmt="v %.7g %.7g %.7g")
        np.savetxt(file, mesh.uv, fmt="vt %.6f %.6f")
        np.savetxt(file, joined.normals, fmt="vn %.4f %.4f %.4f")
        np.savetxt(file, corners, fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")


def write_obj(path: str | os.PathLike, surface: Surface) -> None:
    """Write an OBJ with colours after the positions ("v x y z r g b"), without a material, which
    MeshLab, Blender and trimesh can read.

    Raises:
        UserError: vertices or colours aren't finite, or the file can't be written.
    """
    _require_finite(path, surface.vertices, surface.colors)
    rows = np.concatenate([surface.vertices, surface.colors], axis=1)
    with atomic_file(path) as file:
        np.savetxt(file, rows, fmt="v %.6g %.6g %.6g %.4f %.4f %.4f")
        np.savetxt(file, surface.faces + 1, fmt="f %d %d %d")


def companions(path: str | os.PathLike) -> tuple[Path, ...]:
    """Return the PNG and the MTL beside an OBJ, with ``_`` for spaces, which end some names."""
    path = Path(path)
    beside = path.suffix.lower() == ".obj"
    path = path.with_name("_".join(path.name.split()))
    return (path.with_suffix(".png"), path.with_suffix(".mtl")) if beside else ()


def _require_finite(path: str | os.PathLike, *values: Any) -> None:
    if not all(np.isfinite(each).all() for each in values):
        raise UserError(f"{str(path)!r} isn't written: some of its vertices hold NaN or infinity")


def png_bytes(picture: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Encode an RGB picture."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


WRITERS = {".glb": write_textured_glb, ".obj": write_textured_obj}
"""By extension."""
