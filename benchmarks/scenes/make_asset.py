"""Make the bundled mesh: a painted wind-up toy fox, sitting, 1 unit = half its height.
Deterministic; no input.

    python -m benchmarks.scenes.make_asset [threestudio_gaussiandreamer/assets/toy.glb]

It is a test object as well as a picture: a face, a bib and a scarf's end in front, stripes and a
wind-up key behind (so that front and back differ), a tail on its left only, thin parts
(ears, key, tail's tip), paint with edges and fine grain.

Every part is a grid over (u, v), u once around and v along, in world coordinates (z up, front =
+x), with a rectangle of the texture to itself; the paint is a function of the place in space. Faces
inside another part are left out."""

import io
import json
import struct
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np

from benchmarks.scenes import paint
from benchmarks.scenes.shapes import ellipsoid, tube

TEXTURE = 512
# texels between a part's uv and the border of its rectangle, so that bilinear lookups stay inside
MARGIN = 1.5
DEFAULT = Path(__file__).resolve().parents[2] / "threestudio_gaussiandreamer/assets/toy.glb"


class Part(NamedTuple):
    """A closed surface, its parameters and its paint."""

    place: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(u, v) in [0, 1] to points (..., 3)."""
    inside: Callable[[np.ndarray], np.ndarray]
    paint: Callable[[np.ndarray], np.ndarray]
    """Points (n, 3) to colours (n, 3) in [0, 1]."""
    grid: tuple[int, int]
    """Faces around and along."""
    texels: tuple[int, int]


# The fox
# --------------------------------------------------------------------------------------------------


def fox() -> list[Part]:
    """Return all parts, the largest first."""
    return [*trunk(), *limbs(-1), *limbs(1)]


def trunk() -> list[Part]:
    """Return head, body, tail, scarf and its end, snout, nose, and the key's shaft."""
    end = [(0.30, -0.15, 0.02), (0.385, -0.19, -0.14), (0.40, -0.21, -0.40)]
    head = ellipsoid((0.06, 0, 0.40), (0.37, 0.43, 0.34))
    body = ellipsoid((0, 0, -0.40), (0.36, 0.37, 0.50), taper=0.22)
    tail = tube(TAIL, (0.07, 0.13, 0.19, 0.19, 0.13, 0.02))
    scarf = tube(NECK, [0.088] * 8, closed=True, side=(0, 0, 1))
    scarf_end = tube(end, (0.075, 0.085, 0.095), flat=0.3)
    snout = ellipsoid((0.43, 0, 0.28), (0.21, 0.17, 0.13), tilt=-6)
    nose = ellipsoid((0.625, 0, 0.335), (0.05, 0.06, 0.045))
    shaft = tube([(-0.30, 0, -0.22), (-0.56, 0, -0.22)], (0.03, 0.03))
    return [
        Part(*head, paint.head, (40, 26), (300, 190)),
        Part(*body, paint.body, (40, 26), (210, 190)),
        Part(*tail, paint.tail, (20, 30), (120, 130)),
        Part(*scarf, paint.scarf, (10, 48), (44, 130)),
        Part(*scarf_end, paint.scarf_end, (14, 12), (96, 84)),
        Part(*snout, paint.snout, (24, 16), (120, 76)),
        Part(*nose, paint.nose, (12, 8), (28, 20)),
        Part(*shaft, paint.brass, (10, 6), (16, 16)),
    ]


def limbs(sign: int) -> list[Part]:
    """Return ear, arm, thigh, foot and the key's loop of one side, +1 for y > 0."""
    hand = np.array([0.40, 0.19 * sign, -0.50])
    ear = [(0.02, 0.25 * sign, 0.60), (0.0, 0.30 * sign, 0.78), (-0.03, 0.37 * sign, 1.0)]
    arm = [(0.12, 0.27 * sign, -0.12), (0.30, 0.33 * sign, -0.34), hand]
    loop = [
        (-0.60, sign * (0.085 + 0.075 * np.cos(a)), -0.22 + 0.085 * np.sin(a))
        for a in np.arange(8) * np.pi / 4
    ]
    thigh = ellipsoid((0.06, 0.26 * sign, -0.66), (0.27, 0.17, 0.25))
    foot = ellipsoid((0.30, 0.25 * sign, -0.84), (0.23, 0.13, 0.13))
    key = tube(loop, [0.024] * 8, closed=True, side=(1, 0, 0))
    glove = partial(paint.limb, end=hand, reach=0.14)
    return [
        Part(*tube(ear, (0.15, 0.125, 0.02), flat=0.4), paint.ear, (18, 14), (90, 70)),
        Part(*tube(arm, (0.10, 0.09, 0.10)), glove, (16, 14), (76, 72)),
        Part(*thigh, paint.thigh, (22, 14), (90, 66)),
        Part(*foot, paint.foot, (20, 14), (90, 56)),
        Part(*key, paint.brass, (8, 20), (12, 40)),
    ]


TAIL = [
    (-0.22, 0.05, -0.80),
    (-0.42, 0.28, -0.84),
    (-0.52, 0.56, -0.66),
    (-0.50, 0.70, -0.32),
    (-0.40, 0.70, 0.02),
    (-0.30, 0.62, 0.30),
]
NECK = [
    (0.05 + 0.29 * np.cos(a), 0.31 * np.sin(a), 0.07 - 0.04 * np.cos(a))
    for a in np.arange(8) * np.pi / 4
]


# Assembly
# --------------------------------------------------------------------------------------------------


def build(parts: list[Part]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (V, 3), texture coordinates (V, 2) with v downwards, faces (F, 3) and the
    texture (512, 512, 3) in [0, 1].
    """
    texture = np.full((TEXTURE, TEXTURE, 3), 0.5)
    vertices, uvs, faces, count = [], [], [], 0
    for index, (part, corner) in enumerate(
        zip(parts, pack([part.texels for part in parts]), strict=True)
    ):
        points, uv, triangles = surface(part, corner)
        hidden = np.any(
            [other.inside(points) for i, other in enumerate(parts) if i != index], axis=0
        )
        triangles = triangles[~hidden[triangles].all(axis=1)]
        used, triangles = np.unique(triangles, return_inverse=True)
        vertices.append(points[used])
        uvs.append(uv[used])
        faces.append(triangles.reshape(-1, 3) + count)
        count += len(used)
        paint_part(part, corner, texture)
    return np.concatenate(vertices), np.concatenate(uvs), np.concatenate(faces), texture


def surface(part: Part, corner: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a part's grid: points, texture coordinates and faces oriented outwards."""
    around, along = part.grid
    v, u = np.meshgrid(np.arange(along + 1) / along, np.arange(around + 1) / around, indexing="ij")
    points = part.place(u, v).reshape(-1, 3)
    texels = np.array(part.texels)
    uv = (
        np.array(corner) + MARGIN + np.stack([u, v], axis=-1).reshape(-1, 2) * (texels - 2 * MARGIN)
    ) / TEXTURE
    start = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).reshape(-1)
    quads = np.stack([start, start + 1, start + around + 2, start + around + 1], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    solid = np.linalg.norm(normals, axis=1) > 1e-9  # not the empty ones at the poles
    outwards = (normals * (a - points.mean(axis=0))).sum() > 0
    return points, uv, triangles[solid] if outwards else triangles[solid][:, ::-1]


def paint_part(part: Part, corner: tuple[int, int], texture: np.ndarray) -> None:
    """Fill a part's rectangle: each texel by the position that it covers."""
    (width, height), (left, top) = part.texels, corner
    rows, columns = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    u = (columns - MARGIN) / (width - 2 * MARGIN)
    v = np.clip((rows - MARGIN) / (height - 2 * MARGIN), 0, 1)
    colors = part.paint(part.place(u, v).reshape(-1, 3))
    texture[top : top + height, left : left + width] = colors.reshape(height, width, 3)


def pack(sizes: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return corners (left, top) of rectangles placed on shelves, the highest first."""
    corners: list[Optional[tuple[int, int]]] = [None] * len(sizes)
    left = top = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: -sizes[i][1]):
        width, height = sizes[index]
        if left + width > TEXTURE:
            left, top, shelf = 0, top + shelf, 0
        corners[index] = (left, top)
        left, shelf = left + width, max(shelf, height)
    if top + shelf > TEXTURE:
        raise ValueError(f"the parts need {top + shelf} rows of texels, there are {TEXTURE}")
    return corners


# The file
# --------------------------------------------------------------------------------------------------


def write_glb(
    path: Path, vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray, texture: np.ndarray
) -> None:
    """Write a minimal glTF 2.0 binary: one textured primitive; y up, front +z."""
    positions = vertices[:, [1, 2, 0]].astype("<f4")  # x, y, z of the file are the world's y, z, x
    chunks = [
        positions.tobytes(),
        uv.astype("<f4").tobytes(),
        faces.astype("<u2").tobytes(),
        png(texture),
    ]
    document = scene_description() | {
        "accessors": accessors(positions, len(uv), faces.size),
        **buffers(chunks),
    }
    text = padded(json.dumps(document, separators=(",", ":")).encode(), b" ")
    data = b"".join(map(padded, chunks))
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        header
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(data), b"BIN\0")
        + data
    )


def png(texture: np.ndarray) -> bytes:
    """Return the texture, (H, W, 3) in [0, 1], as a PNG of 256 colours."""
    from PIL import Image

    file = io.BytesIO()
    colors = Image.fromarray((texture * 255).round().astype(np.uint8)).quantize(
        256, kmeans=2, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
    )
    colors.save(file, "PNG", optimize=True)
    return file.getvalue()


def scene_description() -> dict[str, Any]:
    """Return the description of the file without its numbers: one node, its material and
    its image.
    """
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    roughness = {
        "baseColorTexture": {"index": 0},
        "metallicFactor": 0,
        "roughnessFactor": 0.9,
    }
    return {
        "asset": {"version": "2.0", "generator": "make_asset.py", "copyright": "Apache-2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "toy fox"}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": roughness}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
    }


def accessors(positions: np.ndarray, uv_count: int, corner_count: int) -> list[dict[str, Any]]:
    """Describe positions (with their box), texture coordinates and indices of the faces."""
    float32, uint16 = 5126, 5123
    box = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    place = {"bufferView": 0, "componentType": float32, "count": len(positions), "type": "VEC3"}
    return [
        place | box,
        {"bufferView": 1, "componentType": float32, "count": uv_count, "type": "VEC2"},
        {"bufferView": 2, "componentType": uint16, "count": corner_count, "type": "SCALAR"},
    ]


def buffers(chunks: list[bytes]) -> dict[str, Any]:
    """Describe the positions of the chunks in the one buffer of the file."""
    offsets = np.cumsum([0] + [len(padded(chunk)) for chunk in chunks])
    views = [
        {"buffer": 0, "byteOffset": int(offset), "byteLength": len(chunk)}
        for offset, chunk in zip(offsets[:-1], chunks, strict=True)
    ]
    return {"bufferViews": views, "buffers": [{"byteLength": int(offsets[-1])}]}


def padded(chunk: bytes, fill: bytes = b"\0") -> bytes:
    """Pad to a multiple of four bytes, as glTF aligns its parts."""
    return chunk + fill * (-len(chunk) % 4)


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    vertices, uv, faces, texture = build(fox())
    write_glb(path, vertices, uv, faces, texture)
    print(
        f"{path}: {len(vertices)} vertices, {len(faces)} triangles, "
        f"{path.stat().st_size / 1000:.0f} kB"
    )


if __name__ == "__main__":
    main()
