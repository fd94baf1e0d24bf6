"""T3Bench: its quality of Gaussians, and meshes where its scripts look for them, which is
``outputs_mesh_t3/<method>_<group>/<prompt with _ for spaces>*/save/it*-export/model.obj``. The
cameras for quality are at the 162 vertices of an icosphere, with five fields of view each, and the
background is black. The object is centred at the mean of the centres of its Gaussians of at least
``MIN_OPACITY`` and scaled to [-1, 1]. A mesh is the surface of the Gaussians."""

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ..cameras import look_at
from ..core.errors import UserError
from ..core.files import output_folder
from ..core.options import shown
from ..gaussians.gaussians import Gaussians, opaque
from ..gaussians.surface import gaussian_surface
from ..meshes.write import write_obj
from .results import Result, read_result, render_views

RADIUS = 2.2
FOVY = tuple(math.pi / x for x in (3.0, 4.0, 5.0, 6.0, 7.5))
"""Radians."""
MIN_OPACITY = 0.1
NEAR_POLE = 0.99
SIZE, SMOOTHINGS = 512, 3
LONGEST_NAME = 240
"""Bytes of a folder's name; file systems allow 255, of which the group's name needs some."""


def write_meshes(
    folder: Path, name: str, results: Sequence[Result], prompts: Sequence[str]
) -> None:
    """Write meshes into ``folder``, a checkout of T3Bench; the results into a folder ``name``."""
    for result, prompt in zip(results, prompts, strict=True):
        export = folder / "outputs_mesh_t3" / name / folder_name(prompt) / "save/it0-export"
        output_folder(export, "--t3bench", ["model.obj"])
        write_obj(export / "model.obj", gaussian_surface(normalized(read_result(result))))
        print(f"T3Bench: {export}", flush=True)


def require_folder_names(method: str, prompts: Sequence[str]) -> None:
    """Raise UserError unless each prompt, and the method, names a folder of its own."""
    names = list(map(folder_name, prompts))
    for text in (method, *names):
        invalid = set(text) & set("/\0") or text in ("", os.curdir, os.pardir)
        if invalid or len(os.fsencode(text)) > LONGEST_NAME or names.count(text) > 1:
            raise UserError(
                f"T3Bench names folders after prompts and --t3bench-method, and {shown(text)} is "
                f"empty, dots, longer than {LONGEST_NAME} bytes, given twice, or has a slash or "
                "NUL: reword it"
            )


def folder_name(prompt: str) -> str:
    return prompt.replace(" ", "_")


def pictures(
    arrays: Gaussians, antialias: bool = False
) -> Iterator[Float[np.ndarray, "B size size 3"]]:
    """Render the views for quality of a normalised cloud: those of each vertex together."""
    positions = np.repeat(_icosphere().vertices, len(FOVY), 0)
    angles = torch.tensor(FOVY).repeat(len(positions) // len(FOVY))
    place = torch.from_numpy(positions).float()
    at_pole = (place[:, 2] / place.norm(dim=1)).abs() >= NEAR_POLE  # where +y is up, not +z
    up = torch.where(at_pole[:, None], torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    c2w = look_at(place, torch.zeros_like(place), up)
    return render_views(arrays, c2w, angles, SIZE, antialias=antialias, chunk=8)


def quality(rewards: Float[np.ndarray, "162 5"]) -> float:
    """Compute T3Bench's quality from the rewards of its views: the best camera of each vertex,
    averaged three times with the vertex's neighbours, then the best vertex, as 20 x + 50.
    """
    near, scores = _icosphere().vertex_neighbors, rewards.max(axis=1)
    for _ in range(SMOOTHINGS):
        scores = np.array([scores[[i, *near[i]]].mean() for i in range(len(scores))])
    return float(20 * scores.max() + 50)


def _icosphere():
    import trimesh

    return trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)


def normalized(arrays: Gaussians) -> Gaussians:
    """Translate and scale a cloud: its visible centres have mean 0 and lie in [-1, 1]^3."""
    visible = opaque(arrays, MIN_OPACITY)
    means = arrays.means[visible] if visible.any() else arrays.means
    centre = means.mean(axis=0)
    half_side = np.abs(means - centre).max() or 1.0
    return arrays._replace(
        means=(arrays.means - centre) / half_side, log_scales=arrays.log_scales - np.log(half_side)
    )
