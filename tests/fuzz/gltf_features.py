"""Generator of glTF files that combine what the standard offers, with what they show.

A file carries its truth in ``asset.extras``: the corners of each triangle in the world and the
colour at its centre, computed here vertex by vertex; or the name of a feature that isn't read and
has to be refused by name. A fifth of the files has one value of its JSON replaced, and no
truth."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Optional

import numpy as np
from scipy.spatial.transform import Rotation

from tests.fuzz.mutations import GLB, json_value
from tests.helpers.gltf_builder import Gltf
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes.gltf import read_gltf
from threestudio_gaussiandreamer.meshes.mesh import surface_colors

Rng = np.random.Generator
WRAPS = {10497: lambda t: t % 1, 33071: lambda t: min(max(t, 0), 1), 33648: lambda t: _mirrored(t)}
NOT_READ = [
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_texture_basisu",
    "EXT_mesh_gpu_instancing",
    "ACME_unheard_of",
]
CLAMP = 33071
CLEARANCE = 0.05
"""Share of a texel by which a centre keeps off the texel's edges, where rounding would decide."""


def seeds() -> list[bytes]:
    return [_file(np.random.default_rng(number), damage=False) for number in range(4)]


def other_file(data: bytes, rng: Rng) -> bytes:
    """Another file in the place of ``data``."""
    return _file(rng, damage=True)


def exercise(path: Path, exercise_mesh: Callable[[Path], None]) -> Optional[str]:
    """Return what is wrong with what was read; None where it is what the file says."""
    truth = _truth_of(path)
    try:
        exercise_mesh(path)
    except UserError as error:
        if isinstance(truth, str) and truth not in str(error):
            return f"refused without a word of {truth}: {error}"
        if isinstance(truth, list):
            return f"a good file was refused: {error}"
        raise
    if isinstance(truth, str):
        return f"{truth} was read"
    return None if truth is None else _difference(_triangles(path), truth)


def _truth_of(path: Path) -> Any:
    try:
        return json.loads(dict(GLB.unpack(path.read_bytes()))["JSON"])["asset"]["extras"]["truth"]
    except (ValueError, KeyError, TypeError):  # damaged
        return None


def _triangles(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    found = []
    for part in read_gltf(path):
        colors = surface_colors(
            part, np.arange(len(part.faces)), np.full((len(part.faces), 3), 1 / 3)
        )
        found += zip(part.vertices[part.faces], colors, strict=True)
    return found


def _difference(found: list[tuple[np.ndarray, np.ndarray]], truth: list[Any]) -> Optional[str]:
    if len(found) != len(truth):
        return f"{len(found)} triangles, {len(truth)} were written"
    for (corners, color), (expected, shown) in zip(found, truth, strict=True):
        size = 1 + np.abs(expected).max()
        if np.abs(corners - expected).max() > 1e-4 * size:
            return f"a triangle is at {corners.round(4).tolist()} in place of {expected}"
        if np.abs(color - shown).max() > 3e-3:
            return f"a colour is {color.round(4).tolist()} in place of {shown}"
    return None


# ---- files ---------------------------------------------------------------------------------------


def _file(rng: Rng, damage: bool) -> bytes:
    made = Gltf(nodes=[])
    truth: Any = []
    roots = [_node(made, rng, np.eye(4), truth, depth=0) for _ in range(rng.integers(1, 3))]
    made.document["scenes"] = [{"nodes": [10**6]}, {"nodes": roots}]
    made.document["scene"] = 1
    fate = rng.random() if damage else 1.0
    if fate < 0.2:
        truth = _with_unread(made, rng)
    elif fate < 0.4:
        truth = None
    made.document["asset"]["extras"] = {"truth": truth}
    data = made.glb()
    if truth is not None:
        return data
    pieces = [
        (name, json_value(part, rng) if name == "JSON" else part) for name, part in GLB.unpack(data)
    ]
    return GLB.pack(pieces)


def _with_unread(made: Gltf, rng: Rng) -> str:
    name = NOT_READ[rng.integers(len(NOT_READ))]
    if name == "EXT_mesh_gpu_instancing" and rng.random() < 0.5:  # also where it isn't required
        node = made.document["scenes"][1]["nodes"][0]
        made.document["nodes"][node]["extensions"] = {name: {"attributes": {}}}
    else:
        made.document["extensionsRequired"] = [name]
    return name


def _node(made: Gltf, rng: Rng, above: np.ndarray, truth: list, depth: int) -> int:
    """Add a node with a mesh or children; triangles are found in the order of the nodes."""
    entry, local = _placement(rng)
    index = made.add("nodes", **entry)
    world, node = above @ local, made.document["nodes"][index]
    if depth == 2 or rng.random() < 0.7:
        node["mesh"] = _mesh(made, rng, node, world, truth)
    if depth < 2 and rng.random() < 0.4:
        node["children"] = [_node(made, rng, world, truth, depth + 1)]
    if "mesh" not in node and "children" not in node:
        node["mesh"] = _mesh(made, rng, node, world, truth)
    return index


def _placement(rng: Rng) -> tuple[dict[str, Any], np.ndarray]:
    """Nothing, a matrix, or some of translation, rotation and scale."""
    matrix = np.eye(4)
    if rng.random() < 0.3:
        return {}, matrix
    turn, scale = Rotation.random(rng=rng), rng.uniform(0.5, 2, 3) * rng.choice([1, 1, 1, -1], 3)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix() * scale, rng.normal(size=3)
    if rng.random() < 0.5:
        return {"matrix": matrix.T.ravel().tolist()}, matrix
    place = {"translation": matrix[:3, 3].tolist(), "rotation": turn.as_quat().tolist()}
    return place | {"scale": scale.tolist()}, matrix


def _mesh(made: Gltf, rng: Rng, node: dict, world: np.ndarray, truth: list) -> int:
    """Add a mesh of one or two primitives, whose triangles go into ``truth``."""
    primitives = []
    weights = rng.uniform(-1, 1, rng.integers(0, 3)).round(3).tolist()
    entry = {"weights": weights} if weights else {}
    if weights and rng.random() < 0.5:  # the node's weights come before those of the mesh
        node["weights"], entry = weights, {"weights": [9.0] * len(weights)}
    for _ in range(rng.integers(1, 3)):
        count = int(rng.integers(4, 9))
        primitive: dict[str, Any] = {"attributes": {}}
        faces = _faces(made, rng, primitive, count)
        positions = _positions(made, rng, primitive, count, weights)
        colors = _colors(made, rng, primitive, count, faces)
        primitives.append(primitive)
        placed = positions @ world[:3, :3].T + world[:3, 3]
        turned = np.linalg.det(world[:3, :3]) < 0
        for face, color in zip(faces, colors, strict=True):
            shown = placed[face[::-1] if turned else face]
            truth.append([shown.tolist(), [float(value) for value in color]])
    return made.add("meshes", primitives=primitives, **entry)


# ---- geometry ------------------------------------------------------------------------------------


def _faces(made: Gltf, rng: Rng, primitive: dict, count: int) -> list[list[int]]:
    """Choose how triangles are listed; return their corners."""
    mode = int(rng.choice([4, 4, 5, 6]))
    order = np.arange(count)
    if rng.random() < 0.7 or (mode == 4 and count % 3):
        order = rng.integers(0, count, 3 * rng.integers(1, 4))
        order[:3] = rng.permutation(count)[:3]  # one triangle at least has an area
        primitive["indices"] = made.accessor(order.astype(str(rng.choice(["u1", "u2", "u4"]))))
    if mode != 4 or rng.random() < 0.5:
        primitive["mode"] = mode
    corners, last = order.tolist(), len(order) - 2
    if mode == 4:
        return [corners[i : i + 3] for i in range(0, len(corners), 3)]
    if mode == 6:
        return [[corners[i + 1], corners[i + 2], corners[0]] for i in range(last)]
    return [[corners[i + k] for k in (0, 1 + i % 2, 2 - i % 2)] for i in range(last)]


def _positions(
    made: Gltf, rng: Rng, primitive: dict, count: int, weights: list[float]
) -> np.ndarray:
    """Store positions in some way, and morph targets; return where they end."""
    way = [_plain, _sparse, _quantised][rng.integers(3)]
    primitive["attributes"]["POSITION"], positions = way(made, rng, count)
    targets = [rng.normal(size=(count, 3)).astype(np.float32) for _ in weights]
    if targets:
        primitive["targets"] = [{"POSITION": made.accessor(target)} for target in targets]
    for weight, target in zip(weights, targets, strict=True):
        positions = positions + weight * target.astype(np.float64)
    return np.asarray(positions, np.float64)


def _plain(made: Gltf, rng: Rng, count: int) -> tuple[int, np.ndarray]:
    positions = rng.normal(size=(count, 3)).astype(np.float32)
    return made.accessor(positions, stride=int(rng.choice([0, 12, 16, 20]))), positions


def _sparse(made: Gltf, rng: Rng, count: int) -> tuple[int, np.ndarray]:
    positions = rng.normal(size=(count, 3)).astype(np.float32)
    if rng.random() < 0.5:
        return made.sparse(count, np.arange(count), positions), positions
    rows, base = np.arange(0, count, 2), positions.copy()
    base[rows] = 99
    return made.sparse(count, rows, positions[rows], base), positions


def _quantised(made: Gltf, rng: Rng, count: int) -> tuple[int, np.ndarray]:
    """Integers, normalised or not (KHR_mesh_quantization)."""
    made.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    kind = np.dtype(str(rng.choice(["i1", "u1", "i2", "u2"])))
    limits = np.iinfo(kind)
    stored = rng.integers(limits.min, limits.max, (count, 3), dtype=kind, endpoint=True)
    normalized = bool(rng.random() < 0.5)
    index = made.accessor(stored, stride=4 * kind.itemsize, normalized=normalized)
    return index, np.maximum(stored / limits.max, -1) if normalized else stored.astype(float)


# ---- colours -------------------------------------------------------------------------------------


def _colors(
    made: Gltf, rng: Rng, primitive: dict, count: int, faces: list[list[int]]
) -> list[np.ndarray]:
    """Choose a material and vertex colours; return what is shown at the centre of each face."""
    shown, known = np.ones((len(faces), 3)), False
    if rng.random() < 0.4:
        stored, colors = _fractions(made, rng, rng.random((count, int(rng.choice([3, 4])))))
        primitive["attributes"]["COLOR_0"], known = stored, True
        shown = shown * [colors[face, :3].mean(axis=0) for face in faces]
    if rng.random() < 0.75:
        factor = rng.random(4).round(4).tolist() if rng.random() < 0.5 else None
        texture, info = None, {}
        if factor is not None:
            shown, known = shown * [_srgb(value) for value in factor[:3]], True
        if rng.random() < 0.7:
            texture, info, texels = _texture(made, rng, primitive, count, faces)
            shown, known = shown * texels, True
        primitive["material"] = made.material(texture, factor, info)
    return list(shown) if known else [np.full(3, 0.5)] * len(faces)


def _fractions(made: Gltf, rng: Rng, values: np.ndarray) -> tuple[int, np.ndarray]:
    """Store numbers in [0, 1] as floats or normalised integers; return the accessor and them."""
    kind = str(rng.choice(["f4", "u1", "u2"]))
    if kind == "f4":
        return made.accessor(values.astype(np.float32)), values
    stored = (values * np.iinfo(kind).max).round().astype(kind)
    row = stored.itemsize * values.shape[1]
    index = made.accessor(stored, stride=row + -row % 4, normalized=True)
    return index, stored / np.iinfo(kind).max


def _texture(
    made: Gltf, rng: Rng, primitive: dict, count: int, faces: list[list[int]]
) -> tuple[int, dict, np.ndarray]:
    """Add a texture with coordinates; return its index, its info, and the texel of each face."""
    deep = rng.random() < 0.2
    size = rng.integers(1, 6, 2)
    picture = rng.integers(0, 65536 if deep else 256, size if deep else (*size, 3))
    picture = picture.astype(np.uint16 if deep else np.uint8)
    wraps = [int(rng.choice(list(WRAPS))) for _ in range(2)]
    index = made.texture(picture, dict(wrapS=wraps[0], wrapT=wraps[1], magFilter=9728))
    info, place = _transform(rng)
    number = (
        info.get("extensions", {})
        .get("KHR_texture_transform", {})
        .get("texCoord", info.get("texCoord", 0))
    )
    while True:
        stored, uv = _coordinates(made, rng, count)
        centers = [np.mean([place(*uv[corner]) for corner in face], axis=0) for face in faces]
        places = np.array([_wrapped(wraps, center) for center in centers]) * size[::-1]
        clear = np.abs(places - places.round()) > CLEARANCE
        clamped = (np.array(wraps) == CLAMP) & ((places == 0) | (places == size[::-1]))
        if (clear | clamped).all():
            break
    primitive["attributes"][f"TEXCOORD_{number}"] = stored
    if number:
        primitive["attributes"]["TEXCOORD_0"] = made.accessor(np.zeros((count, 2), np.float32))
    columns, rows = np.minimum(places.astype(int), size[::-1] - 1).T
    texels = picture[rows, columns] / np.iinfo(picture.dtype).max
    return index, info, texels[:, None] if deep else texels


def _wrapped(wraps: list[int], uv: np.ndarray) -> list[float]:
    return [WRAPS[wrap](t) for wrap, t in zip(wraps, uv, strict=True)]


def _coordinates(made: Gltf, rng: Rng, count: int) -> tuple[int, np.ndarray]:
    if rng.random() < 0.5:
        return _fractions(made, rng, rng.random((count, 2)))
    uv = rng.uniform(-2, 3, (count, 2)).astype(np.float32)
    return made.accessor(uv), uv.astype(np.float64)


def _transform(rng: Rng) -> tuple[dict[str, Any], Callable[[float, float], tuple[float, float]]]:
    """Choose a set of coordinates and perhaps KHR_texture_transform, also as a function."""
    info: dict[str, Any] = {"texCoord": 1} if rng.random() < 0.3 else {}
    if rng.random() < 0.5:
        return info, lambda u, v: (u, v)
    offset, scale = rng.uniform(-1, 1, 2).tolist(), rng.uniform(0.3, 2, 2).tolist()
    angle = float(rng.uniform(-4, 4))
    transform = {"offset": offset, "scale": scale, "rotation": angle}
    if rng.random() < 0.3:
        transform["texCoord"] = 1

    def place(u: float, v: float) -> tuple[float, float]:
        u, v = u * scale[0], v * scale[1]
        turned = (
            u * math.cos(angle) + v * math.sin(angle),
            v * math.cos(angle) - u * math.sin(angle),
        )
        return turned[0] + offset[0], turned[1] + offset[1]

    return info | {"extensions": {"KHR_texture_transform": transform}}, place


def _mirrored(t: float) -> float:
    whole = math.floor(t)
    return t - whole if whole % 2 == 0 else 1 - (t - whole)


def _srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
