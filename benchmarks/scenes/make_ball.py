"""Make benchmarks/scenes/ball.ply: a sphere with a face in front and stripes behind, whose shape
alone does not distinguish its sides.

    python -m benchmarks.scenes.make_ball

The paper names such objects as a limit of the method. Front = +x, z up, radius 1. Deterministic; no
input."""

from pathlib import Path

import numpy as np
import trimesh

PATH = Path(__file__).with_name("ball.ply")
SKIN, EYE, MOUTH, STRIPE, CAP = (
    (240, 200, 120),
    (25, 25, 40),
    (200, 50, 60),
    (50, 90, 190),
    (60, 140, 80),
)


def main() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    colors = paint(np.asarray(ball.vertices))
    painted = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=colors, process=False)
    PATH.write_bytes(painted.export(file_type="ply"))
    print(f"{PATH.name}: {len(painted.vertices)} vertices, {PATH.stat().st_size} bytes")


def paint(points: np.ndarray) -> np.ndarray:
    """Return RGB of points (N, 3) on the unit sphere as bytes."""
    x, y, z = points.T
    colors = np.tile(np.array(SKIN, np.uint8), (len(points), 1))
    colors[(x < 0) & (np.floor(y * 5) % 2 == 0)] = STRIPE
    colors[z > 0.75] = CAP
    eyes = np.minimum((y - 0.35) ** 2, (y + 0.35) ** 2) + (z - 0.25) ** 2 < 0.15**2
    mouth = (np.abs(y) < 0.4) & (np.abs(z + 0.35 - 0.5 * y**2) < 0.08)
    colors[(x > 0) & eyes] = EYE
    colors[(x > 0) & mouth] = MOUTH
    return colors


if __name__ == "__main__":
    main()
