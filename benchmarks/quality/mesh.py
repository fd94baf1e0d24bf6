"""Measure textured meshes of trained clouds: docs/charts/mesh.csv and .png.

    python -m benchmarks.quality.mesh                                     # the toy: some minutes
    python -m benchmarks.quality.mesh --objects toy.glb spot.glb duck.glb
    python -m benchmarks.quality.mesh --objects                           # the chart only

The demo's cloud at 128^2, trained for 600 steps and kept in outputs/mesh, is converted with one
option changed at a time. PSNR is between the mesh, ray-cast without lighting, and the cloud, on 24
held-out views of 256^2 over white, which the texture wasn't baked from. Seconds are the
processor's, of all threads, for the whole conversion without files. What the CSV has isn't measured
again."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.figures import pyplot
from benchmarks.markdown import markdown
from benchmarks.quality.chart_runs import COLOURS, Row, caption, objects_of, saved
from benchmarks.quality.runs import (
    RENDERER,
    ROOT,
    argument_parser,
    measure_missing,
    object_name,
    require_kernel,
    rows_of,
    train,
)
from benchmarks.quality.tables import medians
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.cameras import held_out_orbit, to_opencv
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.views import Views, rasterize_views, row_batches
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, over_background
from threestudio_gaussiandreamer.meshes.write import welded
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.surface.closed import is_closed
from threestudio_gaussiandreamer.surface.textured import MeshOptions, mesh_from_gaussians

CLOUDS = ROOT / "outputs/mesh"
STEPS, SIZE, VIEWS = 600, 256, 24
COLUMNS = "variant,x,object,seed,psnr,cpu_seconds,faces,closed,machine,commit".split(",")
VARIANTS = {
    "faces": (1000, 2000, 5000, 10_000, 20_000),
    "texture": (256, 512, 2048),
    "resolution": (144,),
}
"""Options, and values beside the default; with faces the default is measured."""
DENSITY = (96,)
"""Resolutions of the summed density."""


def main() -> None:
    arguments = argument_parser(__doc__).parse_args()
    require_kernel()
    register_parts()
    measure_missing("mesh", COLUMNS, arguments, rows)
    print(draw(rows_of("mesh")))


def rows(mesh: str, seed: int) -> Iterator[dict[str, Any]]:
    """Yield the measurements of one object."""
    cloud = trained(mesh, seed)
    truth = cloud_views(cloud)
    for variant, x, options in jobs():
        place = {"variant": variant, "x": x, "object": object_name(mesh), "seed": seed}
        yield place | measured(cloud, options, truth)


def jobs() -> Iterator[tuple[str, int, MeshOptions]]:
    default = MeshOptions(eps2d=RENDERER["eps2d"], resolution=96)
    for option, values in VARIANTS.items():
        yield from ((option, value, replace(default, **{option: value})) for value in values)
    for value in DENSITY:
        yield "density", value, replace(default, method="density", resolution=value)


def trained(mesh: str, seed: int) -> Gaussians:
    """Return the demo's cloud of an object, in the world's axes."""
    folder = CLOUDS / f"{object_name(mesh)}-{seed}"
    if not list(folder.rglob("gaussians.ply")):
        folder.mkdir(parents=True, exist_ok=True)
        train(folder, mesh, seed, {"trainer.max_steps": STEPS})
    return read_cloud(str(next(folder.rglob("gaussians.ply")))).in_axes(WORLD_UP).gaussians


def measured(
    cloud: Gaussians, options: MeshOptions, truth: Float[Tensor, "V H W 3"]
) -> dict[str, Any]:
    started = time.process_time()
    mesh = mesh_from_gaussians(cloud, options)
    seconds = time.process_time() - started
    found = {
        "psnr": float(psnr(mesh_views(mesh), truth)),
        "cpu_seconds": seconds,
        "faces": len(mesh.faces),
        "closed": is_closed(welded(mesh).rows[mesh.faces]),
    }
    print(options, found, flush=True)
    return found


def cloud_views(cloud: Gaussians) -> Float[Tensor, "V H W 3"]:
    """Return the cloud's held-out views over white, as the demo draws them."""
    orbit = held_out_orbit(VIEWS)
    c2w = orbit.c2w
    cameras = to_opencv(c2w, orbit.fovy, SIZE, SIZE)
    views = Views(*cameras, c2w[:, :3, 3], SIZE, eps2d=RENDERER["eps2d"])
    tensors, white = cloud.tensors(), torch.ones(3)
    with torch.no_grad():
        batches = row_batches(views, len(tensors.means))
        parts = [rasterize_views(tensors, views, some, white).image for some in batches]
    return torch.cat(parts)


def mesh_views(mesh: Mesh) -> Float[Tensor, "V H W 3"]:
    """Return the mesh's held-out views over white."""
    orbit = held_out_orbit(VIEWS)
    cameras = zip(orbit.c2w.double().numpy(), orbit.fovy.tolist(), strict=True)
    images = MeshCaster(mesh).render_views(cameras, SIZE, SIZE)
    return torch.from_numpy(over_background(images, np.ones(3, np.float32)))


# ---- the table -----------------------------------------------------------------------------------

NAMES = {
    "faces": "{} faces",
    "texture": "texture of {}²",
    "resolution": "{} cells",
    "density": "density instead of fusion, {} cells",
}
"""How the table calls a variant."""


def front() -> str:
    """Return the table of reports/exports.md."""
    found = rows_of("mesh")
    names = list(dict.fromkeys((row["variant"], row["x"]) for row in found))
    lines = []
    for variant, x in names:
        same = [row for row in found if (row["variant"], row["x"]) == (variant, x)]
        closed = "yes" if all(row["closed"] == "True" for row in same) else "no"
        name = NAMES[variant].format(f"{int(x):,}")
        lines.append(
            (name, medians(same, "psnr", 1, 1), medians(same, "cpu_seconds", 1, 1), closed)
        )
    return markdown(("option", "PSNR, dB", "CPU seconds", "closed"), lines)


# ---- the chart -----------------------------------------------------------------------------------

MARKERS = {"faces": "o", "texture": "s", "resolution": "^", "density": "x"}
"""Of the variants, where all are in one panel."""


def draw(measured_rows: list[Row]) -> Path:
    """Draw PSNR against faces, texture size and seconds; return the path."""
    plt = pyplot()

    figure, panels = plt.subplots(1, 3, figsize=(13.8, 4.6), sharey=True)
    for index, name in enumerate(objects_of(measured_rows)):
        own = [row for row in measured_rows if row["object"] == name]
        style = {"color": COLOURS[index]}
        for panel, variant in zip(panels, ("faces", "texture"), strict=False):
            panel.plot(*line(own, variant), marker="o", label=name, **style)
        for variant, marker in MARKERS.items():
            some = [row for row in own if row["variant"] == variant]
            label = variant if index == 0 else None
            panels[2].scatter(*columns(some, "cpu_seconds"), marker=marker, label=label, **style)
    labels = ("faces", "texels each way", "CPU seconds of the conversion, one thread's worth")
    for panel, label in zip(panels, labels, strict=True):
        panel.set_xscale("log")
        panel.set_xlabel(label)
        panel.grid(alpha=0.25)
        panel.legend(frameon=False)
    panels[0].set_ylabel("PSNR to the cloud, held-out views, dB")
    figure.suptitle("Textured meshes of a cloud", x=0.01, ha="left", fontweight="bold")
    figure.text(0.01, 0.905, caption(measured_rows), fontsize=8, color="0.35")
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    return saved(figure, "mesh")


def line(rows_of_object: list[Row], variant: str) -> tuple[list[float], list[float]]:
    """Return positions and PSNR of a variant, in order; the default counts as one of its values."""
    default = getattr(MeshOptions, variant)
    some = [row | {"x": str(default)} for row in rows_of_object if is_default(row)]
    some += [row for row in rows_of_object if row["variant"] == variant and not is_default(row)]
    return columns(sorted(some, key=lambda row: float(row["x"])), "x")


def is_default(row: Row) -> bool:
    """Return whether a row was measured with the default options."""
    return (row["variant"], row["x"]) == ("faces", str(MeshOptions.faces))


def columns(some: list[Row], x: str) -> tuple[list[float], list[float]]:
    return [float(row[x]) for row in some], [float(row["psnr"]) for row in some]


if __name__ == "__main__":
    main()
