"""Write results for T3Bench's scripts: meshes, and pictures of their views, in the folders where
the scripts look for them (docs/evaluation.md).

``run_eval_quality.py`` and ``run_caption.py`` look for ``outputs_mesh_t3/<method>_<group>/<prompt
with _ for spaces>*/save/it*-export/model.obj``, have ``render/meshrender.py`` or
``render/meshrender_cap.py`` render it, and score ``<vertex>_<camera>.png`` and ``<vertex>.png``.
The mesh is the surface of the Gaussians; the scripts written to ``render_gaussians`` copy pictures
of the Gaussians instead, rendered with the same cameras.

Cameras for quality: the 162 vertices of an icosphere of radius 2.2, with five fields of view each.
Cameras for captions: the 12 vertices of an icosahedron of radius 2.2^2 (T3Bench's script multiplies
by the radius twice), with 60 degrees. Pictures have 512 pixels each way and a black background.
The object is centred at the mean of its points and scaled to [-1, 1]; the points are the vertices
of a mesh, or the centres of Gaussians with an opacity of at least ``MIN_OPACITY``.
"""

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from ..cameras import look_at
from ..core import images as picture_files
from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.options import shown
from ..gaussians.gaussians import Gaussians, opaque
from ..gaussians.surface import gaussian_surface
from ..meshes.write import write_obj
from .results import Pictures, Result, read_result

RADIUS = 2.2


class Kind(NamedTuple):
    """The pictures that one of T3Bench's scripts renders."""

    script: str
    subdivisions: int
    """Of the icosphere whose vertices are the places of the cameras."""
    radius: float
    fovy: tuple[float, ...]
    """Radians."""

    @property
    def names(self) -> list[str]:
        count = 10 * 4**self.subdivisions + 2
        if len(self.fovy) == 1:
            return [f"{vertex:03d}.png" for vertex in range(count)]
        return [f"{vertex:03d}_{i}.png" for vertex in range(count) for i in range(len(self.fovy))]


QUALITY = Kind("meshrender.py", 2, RADIUS, tuple(math.pi / x for x in (3.0, 4.0, 5.0, 6.0, 7.5)))
CAPTION = Kind("meshrender_cap.py", 0, RADIUS * RADIUS, (math.pi / 3,))
KINDS = {"quality": QUALITY, "caption": CAPTION}
MIN_OPACITY = 0.1
NEAR_POLE = 0.99
SIZE, SMOOTHINGS = 512, 3
LONGEST_NAME = 240
"""Bytes of a folder's name; file systems allow 255, of which the group's name needs some."""
STAND_IN = '''"""Copy pictures rendered beforehand, black ones where there are none."""

import argparse
import shutil
from pathlib import Path

from PIL import Image

parser = argparse.ArgumentParser()
parser.add_argument("--path", type=str, required=True)
parser.add_argument("--name", type=str)
args = parser.parse_args()
found = sorted((Path(args.path).parent.parent / "t3bench" / "{kind}").glob("*.png"))
for picture in found:
    shutil.copy(picture, args.name)
if not found:
    for name in {names}:
        Image.new("RGB", ({size}, {size})).save(Path(args.name) / name)
'''


def write_t3bench(
    folder: Path,
    name: str,
    results: Sequence[Result],
    prompts: Sequence[str],
) -> None:
    """Write meshes, pictures and scripts into ``folder``, a checkout of T3Bench, without changing
    its own files; the results into a folder of this ``name``.

    Raises:
        UserError: a file can't be written.
    """
    try:
        _write_stand_ins(folder / "render_gaussians")
        for result, prompt in zip(results, prompts, strict=True):
            save = folder / "outputs_mesh_t3" / name / folder_name(prompt) / "save"
            _write_result(save, normalized(read_result(result)), result.antialiased)
            print(f"T3Bench: {save}", flush=True)
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"--t3bench {folder} can't be written: {why}") from error


def require_folder_names(method: str, prompts: Sequence[str]) -> None:
    """Raise UserError unless each prompt, and the method, names a folder of its own."""
    for text in (method, *prompts):
        if set(text) & set("/\0") or text in ("", os.curdir, os.pardir):
            raise UserError(
                f"T3Bench names folders after prompts and --t3bench-method, and {shown(text)} is "
                "empty, dots, or has a slash or NUL: reword it"
            )
        if len(os.fsencode(text)) > LONGEST_NAME:
            raise UserError(
                f"T3Bench names folders after prompts and --t3bench-method: {shown(text)} has more "
                f"than {LONGEST_NAME} bytes"
            )
    twice = [prompt for prompt, count in Counter(map(folder_name, prompts)).items() if count > 1]
    if twice:
        raise UserError(
            f"T3Bench names folders after prompts: the results of {shown(twice[0])} would replace "
            "each other; give one of them"
        )


def folder_name(prompt: str) -> str:
    return prompt.replace(" ", "_")


def _write_stand_ins(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind in KINDS.items():
        with atomic_file(folder / kind.script, durable=False) as file:
            file.write(STAND_IN.format(kind=name, names=kind.names, size=SIZE).encode())


def _write_result(save: Path, arrays: Gaussians, antialias: bool) -> None:
    for kind in KINDS:
        folder = save / "t3bench" / kind
        folder.mkdir(parents=True, exist_ok=True)
        images = (image for chunk in pictures(arrays, KINDS[kind], antialias) for image in chunk)
        for name, image in zip(KINDS[kind].names, images, strict=True):
            picture_files.write(folder / name, (image * 255).round().astype(np.uint8))
    export = save / "it0-export"
    export.mkdir(parents=True, exist_ok=True)
    write_obj(export / "model.obj", gaussian_surface(arrays))


def pictures(
    arrays: Gaussians, kind: Kind, antialias: bool = False
) -> Iterator[Float[np.ndarray, "B size size 3"]]:
    """Render the views of a kind of a normalised cloud, in the order of its names."""
    positions = np.repeat(icosphere(kind.subdivisions, kind.radius), len(kind.fovy), 0)
    angles = torch.tensor(kind.fovy).repeat(len(positions) // len(kind.fovy))
    drawn = Pictures(arrays, antialias=antialias)
    return drawn.render(towards_origin(positions), angles, SIZE, chunk=8)


def quality(rewards: Float[np.ndarray, "162 5"]) -> float:
    """Compute T3Bench's quality from the rewards of its views: the best camera of each vertex,
    averaged three times with the vertex's neighbours, then the best vertex, as 20 x + 50.
    """
    import trimesh

    near = trimesh.creation.icosphere(subdivisions=2).vertex_neighbors
    scores = rewards.max(axis=1)
    for _ in range(SMOOTHINGS):
        scores = np.array([scores[[i, *near[i]]].mean() for i in range(len(scores))])
    return float(20 * scores.max() + 50)


def icosphere(subdivisions: int, radius: float) -> Float[np.ndarray, "V 3"]:
    """Return the vertices of an icosphere in trimesh's order, on which T3Bench's script relies."""
    import trimesh

    return np.asarray(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).vertices)


def towards_origin(positions: Float[np.ndarray, "V 3"]) -> Float[torch.Tensor, "V 4 4"]:
    """Return OpenGL ``c2w`` matrices of cameras that look at the origin, with +z up, or +y near the
    poles, as in T3Bench.
    """
    place = torch.from_numpy(positions).float()
    at_pole = (place[:, 2] / place.norm(dim=1)).abs() >= NEAR_POLE
    up = torch.where(at_pole[:, None], torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    return look_at(place, torch.zeros_like(place), up)


def normalized(arrays: Gaussians) -> Gaussians:
    """Translate and scale a cloud so that the centres of its visible Gaussians have mean 0 and lie
    in [-1, 1]^3.
    """
    visible = opaque(arrays, MIN_OPACITY)
    means = arrays.means[visible] if visible.any() else arrays.means
    centre = means.mean(axis=0)
    half_side = np.abs(means - centre).max() or 1.0
    return arrays._replace(
        means=(arrays.means - centre) / half_side, log_scales=arrays.log_scales - np.log(half_side)
    )
