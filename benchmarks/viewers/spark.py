"""Rendering in Spark of a cloud, against our own render: dB on the held-out views.

    cloud=outputs/demo/.../save/it1200-export/gaussians.ply
    python -m benchmarks.viewers.spark --modules ~/npm/node_modules bounded:toy.glb:$cloud

Each cloud is given as variant:mesh:file (the mesh is the truth; a bare name is a bundled one) and
drawn at 256^2 by Spark in headless Chromium and by our renderer, both as the demo draws (dilation
0.1) and as Spark does by default (a dilation of 0.3 square pixels that keeps a Gaussian's energy).
Rows go to docs/charts/spark.csv. ``benchmarks/viewers/browser.py`` says what to install.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from benchmarks.quality.attributes import held_out_pictures, held_out_views
from benchmarks.quality.runs import RENDERER, append_rows, object_name
from benchmarks.viewers.browser import Camera, draw_with_spark, missing
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP, rotation_between
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb
from threestudio_gaussiandreamer.metrics import psnr

SIZE = 256
SETTINGS = {
    "as the demo": (
        {
            "preBlurAmount": RENDERER["eps2d"],
            "blurAmount": 0.0,
            "maxStdDev": math.sqrt(2 * math.log(255)),  # the preset ``fast`` ends at alpha 1/255
            "sortRadial": False,
        },
        {},
    ),
    "Spark's defaults": ({}, {"eps2d": 0.3, "antialias": True}),
}
"""Options of Spark's renderer and of ours that mean the same."""
COLUMNS = "variant,drawn,object,up,gaussians,above_1,ours,spark,spark_to_ours,machine,commit"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+", metavar="VARIANT:MESH:FILE")
    parser.add_argument("--modules", type=Path, required=True, help="the folder node_modules")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    arguments = parser.parse_args()
    if lacking := missing(arguments.modules):
        parser.error(lacking)
    register_parts()
    for given in arguments.clouds:
        variant, mesh, file = given.split(":")
        for row in rows(mesh, Path(file), arguments.modules, arguments.settings):
            print(variant, row, flush=True)
            append_rows("spark", COLUMNS.split(","), [{"variant": variant, **row}])


def rows(mesh: str, file: Path, modules: Path, settings: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Measure one file with some of ``SETTINGS``."""
    stored = read_cloud(str(file))
    world = stored.in_axes(WORLD_UP).gaussians
    above = float((sh0_to_rgb(world.sh[:, 0]) > 1 + 1e-4).any(axis=1).mean())
    for name in settings:
        options, drawn = SETTINGS[name]
        # before colours were bounded, our own render didn't clamp them
        ours, truth = held_out_pictures(mesh, world, SIZE, bound_colors=False, **drawn)
        pixels = draw_with_spark(
            file,
            held_out_cameras(mesh),
            SIZE,
            modules,
            options=options,
            rotation=quaternion(rotation_between(stored.up, WORLD_UP)),
        )
        spark = torch.from_numpy(pixels / np.float32(255))
        yield {
            "drawn": name,
            "object": object_name(mesh),
            "up": stored.up,
            "gaussians": len(world.means),
            "above_1": round(above, 3),
            "ours": round(float(psnr(ours, truth).mean()), 2),
            "spark": round(float(psnr(spark, truth).mean()), 2),
            "spark_to_ours": round(float(psnr(spark, ours).mean()), 2),
        }


def held_out_cameras(mesh: str) -> list[Camera]:
    orbit = held_out_views(mesh, SIZE).orbit
    return [Camera(*view) for view in zip(orbit.c2w.numpy(), orbit.fovy.tolist(), strict=True)]


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> list[float]:
    """Return the quaternion xyzw of a rotation."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat().tolist()


if __name__ == "__main__":
    main()
