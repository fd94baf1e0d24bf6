"""The effect of a viewer's dilation: clouds trained with one screen-space dilation and rendered
with another, at the training size and larger.

    python -m benchmarks.quality.viewers                                       # the toy
    python -m benchmarks.quality.viewers --objects toy.glb spot.glb duck.glb

The demo at its own 256^2 with dilations of 0.1 and of 0.3 square pixels; each result is rendered
with both at 256^2 and at 512^2; dB to the ray-cast ground truth on 24 held-out views. Results go to
docs/charts/viewers.csv; runs that it contains are skipped."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.quality.attributes import score
from benchmarks.quality.runs import argument_parser, measure_missing, object_name, train
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP

DILATIONS = (0.1, 0.3)
SIZES = (256, 512)
COLUMNS = "variant,x,size,object,seed,psnr,machine,commit".split(",")


def main() -> None:
    arguments = argument_parser(__doc__).parse_args()
    register_parts()
    measure_missing("viewers", COLUMNS, arguments, rows)


def rows(mesh: str, seed: int) -> Iterator[dict[str, Any]]:
    own = {"data.width": SIZES[0], "data.height": SIZES[0], "system.evaluation.size": SIZES[0]}
    for trained in DILATIONS:
        with tempfile.TemporaryDirectory() as folder:
            save = train(Path(folder), mesh, seed, own | {"system.renderer.eps2d": trained})
            exported = read_cloud(str(next(save.glob("it*-export/gaussians.ply"))))
            arrays = exported.in_axes(WORLD_UP).gaussians
        for size in SIZES:
            for drawn in DILATIONS:
                found = score(mesh, arrays, size, eps2d=drawn)
                print(
                    f"{object_name(mesh)}: trained with {trained:g}, drawn with {drawn:g} at "
                    f"{size}^2: {found:.2f} dB",
                    flush=True,
                )
                yield {
                    "variant": f"trained with {trained:g}",
                    "x": drawn,
                    "size": size,
                    "object": object_name(mesh),
                    "seed": seed,
                    "psnr": found,
                }


if __name__ == "__main__":
    main()
