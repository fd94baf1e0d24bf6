"""Bytes and dB of every format of Gaussians: each cloud is written, read back and rendered beside
its source.

    python -m benchmarks.quality.formats toy:toy.ply spot:spot.ply duck:duck.ply

Each cloud is given as object:file; a ball with random harmonics of degree 3 is added. Rows go to
docs/charts/formats.csv; ``python -m benchmarks.tables`` makes the table of docs/formats.md.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from benchmarks.markdown import markdown, read
from benchmarks.quality.runs import CHARTS, append_rows
from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.convert.losses import compare, reference
from threestudio_gaussiandreamer.formats.gaussian_files import (
    StoredCloud,
    read_cloud,
    write_cloud,
)
from threestudio_gaussiandreamer.formats.producers import PRODUCERS, Axes

SIZE, BALL, BALL_COUNT = 256, "ball", 5000
COLUMNS = "object,degree,gaussians,format,bytes,psnr,worst,write_s,read_s,machine,commit".split(",")


class Format(NamedTuple):
    """A row of the table."""

    name: str
    file: str
    version: int
    """Of SPZ; 3 for other formats, which ignore it."""
    writes: bool
    reads: bool
    keeps: str
    readers: str


FORMATS = (
    Format("3DGS PLY", "a.ply", 3, True, True, "everything, to the bit", "all viewers and editors"),
    Format(
        "compressed PLY",
        "a.compressed.ply",
        3,
        True,
        True,
        "all attributes, rounded; the notes",
        "SuperSplat, PlayCanvas, Spark, Babylon.js",
    ),
    Format(
        "SPZ 3",
        "3.spz",
        3,
        True,
        True,
        "all attributes, rounded; the notes",
        "Niantic, Spark, Babylon.js, NVIDIA's converter, splat-transform 3",
    ),
    Format(
        "SPZ 4",
        "4.spz",
        4,
        True,
        True,
        "all attributes, rounded; antialiasing",
        "Niantic, Babylon.js, splat-transform 3",
    ),
    Format(
        "SOG 2",
        "a.sog",
        3,
        True,
        True,
        "all attributes, rounded; harmonics from a palette; the notes",
        "PlayCanvas, SuperSplat, Spark, Babylon.js",
    ),
    Format(
        "GLB, KHR_gaussian_splatting",
        "a.glb",
        3,
        True,
        True,
        "all attributes in float32; the notes as extras",
        "Babylon.js, PlayCanvas; others as points; Cesium only SPZ inside",
    ),
    Format(
        "USDA, ParticleField3DGaussianSplat",
        "a.usda",
        3,
        True,
        True,
        "all attributes with 9 digits; the notes as layer data",
        "OpenUSD 26.03 on: Omniverse, Houdini",
    ),
    Format(".splat", "", 3, False, True, "no harmonics, 8 bits", "read only"),
    Format(".ksplat", "", 3, False, True, "levels 0 to 2, harmonics up to degree 2", "read only"),
    Format("SOG folder, `meta.json`", "", 3, False, True, "versions 1 and 2", "read only"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+", metavar="OBJECT:FILE")
    given = [cloud.split(":", 1) for cloud in parser.parse_args().clouds]
    clouds = {name: read_cloud(file) for name, file in given}
    clouds[BALL] = StoredCloud(ball(BALL_COUNT, 3))
    for name, cloud in clouds.items():
        for row in rows(name, cloud):
            print(row, flush=True)
            append_rows("formats", COLUMNS, [row])


def rows(name: str, cloud: StoredCloud) -> Iterator[dict[str, Any]]:
    """Measure one cloud in every format that is written."""
    with tempfile.TemporaryDirectory() as folder:
        for known in FORMATS:
            if not known.writes:
                continue
            path = Path(folder, known.file)
            started = time.process_time()
            write_cloud(str(path), cloud, spz_version=known.version)
            written = time.process_time()
            after = read_cloud(str(path))
            done = time.process_time()
            mean, worst = compare(reference(cloud, SIZE), after)
            yield {
                "object": name,
                "degree": cloud.gaussians.sh_degree,
                "gaussians": len(cloud.gaussians.means),
                "format": known.name,
                "bytes": path.stat().st_size,
                "psnr": round(mean, 2),
                "worst": round(worst, 2),
                "write_s": round(written - started, 3),
                "read_s": round(done - written, 3),
            }


# ---- the table of docs/formats.md ----------------------------------------------------------------


def table() -> str:
    """Return the formats with the medians of the trained objects, and the ball of degree 3."""
    last = {(row["object"], row["format"]): row for row in read(CHARTS / "formats.csv")}
    head = ["format", "written", "read", "keeps", "bytes a Gaussian", "dB", "read by"]
    return markdown(head, (table_row(known, list(last.values())) for known in FORMATS))


def producers() -> str:
    """Return the axes of each producer's files."""
    rows = (
        (f"`{name}`", axes_cell(known.gaussians), axes_cell(known.mesh), known.note)
        for name, known in PRODUCERS.items()
    )
    return markdown(["producer", "Gaussians: up, front", "mesh: up, front", "why"], rows)


def axes_cell(axes: Optional[Axes]) -> str:
    return ", ".join(axes or ())


def table_row(known: Format, measured: list[dict[str, str]]) -> list[str]:
    ours = [row for row in measured if row["format"] == known.name]
    trained = [row for row in ours if row["object"] != BALL]
    synthetic = [row for row in ours if row["object"] == BALL]
    if ours:
        sizes, quality = ((cell(trained), cell(synthetic)) for cell in (size, decibels))
    else:
        sizes, quality = ("32" if known.name == ".splat" else "",), ("",)
    yes = {True: "yes", False: "no"}
    name = f"`{known.name}`" if known.name.startswith(".") else known.name
    figures = ["; ".join(sizes), "; ".join(quality)]
    return [name, yes[known.writes], yes[known.reads], known.keeps, *figures, known.readers]


def size(measured: list[dict[str, str]]) -> str:
    return f"{statistics.median(int(r['bytes']) / int(r['gaussians']) for r in measured):.1f}"


def decibels(measured: list[dict[str, str]]) -> str:
    found = statistics.median(float(row["psnr"]) for row in measured)
    return "exact" if found >= 99.9 else f"{found:.1f}"


if __name__ == "__main__":
    main()
