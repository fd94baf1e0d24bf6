"""Objects whose need of Gaussians rises: a box, and balls with more and more stripes, as PLY files.

python -m benchmarks.quality.shapes FOLDER
python -m benchmarks.quality.runs --charts needed --seeds 0 --objects FOLDER/*.ply toy.glb
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

STRIPES = (0, 2, 8, 32)
BLUE, RED, YELLOW = (40, 70, 200), (200, 40, 40), (240, 200, 60)


def box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((1.0, 0.7, 0.8))
    mesh.visual.vertex_colors = np.tile((*BLUE, 255), (len(mesh.vertices), 1))
    return mesh


def ball(stripes: int) -> trimesh.Trimesh:
    """Return a ball of diameter 1 with ``stripes`` pairs of meridian stripes; their edges are those
    of faces.
    """
    around, down = max(96, 12 * stripes), 48
    theta = np.linspace(0, 2 * np.pi, around + 1)
    phi = np.linspace(0, np.pi, down + 1)[:, None]
    sphere = (np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi) + 0 * theta)
    corners = 0.5 * np.stack(sphere, -1)
    quads = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], 2)
    odd = (np.arange(around) * 2 * stripes // around) % 2 == 1
    colors = np.where(odd[:, None], YELLOW, RED)
    first = 4 * np.arange(around * down)[:, None]
    faces = np.concatenate([first + (0, 1, 2), first + (0, 2, 3)])
    faces = faces[trimesh.triangles.area(quads.reshape(-1, 3)[faces]) > 1e-9]  # at the poles
    colors = np.repeat(np.tile(colors, (down, 1)), 4, 0)
    return trimesh.Trimesh(quads.reshape(-1, 3), faces, vertex_colors=colors, process=False)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    box().export(folder / "box.ply")
    for count in STRIPES:
        ball(count).export(folder / f"ball-{count}.ply")
