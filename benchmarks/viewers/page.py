"""The page that ``view --html`` writes, in headless Chromium: dB to our own render, size, seconds.

    python -m benchmarks.viewers.page toy:toy.ply spot:spot.ply duck:duck.ply fog

Each cloud is given as name:file and drawn at 256^2 from 8 views, blended into floats as the page
does where it can, into half floats as it does while the picture moves, and into 8 bits; ``fog`` is
made of 2,000 faint Gaussians. Then clouds of many Gaussians are timed in a window of 800 x 600.
Chromium draws in software here (SwiftShader), so the times of a frame are those of the processor
and no graphics card's. Rows go to docs/charts/page.csv.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.runs import append_rows
from benchmarks.viewers.browser import chromium
from benchmarks.viewers.devtools import Page, difference_to_ours, open_page, orbit_poses
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.splatting import PRESETS
from threestudio_gaussiandreamer.view.page import PageOptions, Shown, write_page
from threestudio_gaussiandreamer.view.render import RenderSettings, first_pose
from threestudio_gaussiandreamer.view.run_files import RunFiles

SIZE, VIEWS, WINDOW = 256, 8, (800, 600)
FRAMES = 3
TARGETS = {
    "floats": "null",
    "half floats": "viewer.then(v => { v.renderer.targets.still = v.renderer.targets.moving; })",
    "8 bits": "viewer.then(v => { const { gl } = v.renderer;"
    " v.renderer.targets.still = v.renderer.target(gl.RGBA8, gl.NEAREST); })",
}
"""What the Gaussians are blended into, and how the page is told so."""
COLUMNS = (
    "cloud,gaussians,target,least_db,median_db,page_mb,write_s,first_picture_s,sort_ms,frame_ms,"
    "machine,commit"
)
TIME_FRAME = """viewer.then(async v => {
    const start = performance.now();
    v.pose = turned(v.pose, 31, 0);
    v.sort();
    while (!v.cloud.order.settled) await new Promise(done => setTimeout(done, 0));
    const sorted = performance.now();
    v.draw(v.renderer.targets.moving, 1);
    v.renderer.gl.readPixels(0, 0, 1, 1, v.renderer.gl.RGBA, v.renderer.gl.UNSIGNED_BYTE,
        new Uint8Array(4));
    return [sorted - start, performance.now() - sorted];
})"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="*", metavar="NAME:FILE|fog")
    parser.add_argument("--counts", type=int, nargs="*", default=[100_000, 1_000_000])
    arguments = parser.parse_args()
    if chromium() is None:
        parser.error("no Chromium is installed")
    for given in arguments.clouds:
        name, _, file = given.partition(":")
        record(quality_rows(name, *(cloud_and_settings(file) if file else fog())))
    for count in arguments.counts:
        record(speed_rows(ball(count)))


def record(rows: Iterator[dict[str, Any]]) -> None:
    for row in rows:
        print(row, flush=True)
        append_rows("page", COLUMNS.split(","), [row])


def cloud_and_settings(file: str) -> tuple[StoredCloud, RenderSettings]:
    """Read a cloud and how its run has drawn it."""
    run = RunFiles.around(Path(file))
    return read_cloud(file), run.settings if run else RenderSettings()


def fog(count: int = 2000) -> tuple[StoredCloud, RenderSettings]:
    """Make Gaussians of opacity 0.0038 that lie in front of each other."""
    rng = np.random.default_rng(0)
    faint = cloud_of(rng.normal(size=(count, 3)) * 0.3, 0.3, np.log(0.0038), rng)
    return faint, RenderSettings(alpha_min=PRESETS["accurate"])


def ball(count: int) -> StoredCloud:
    """Make a ball whose surface is covered by Gaussians, as a trained object's is."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return cloud_of(means, 1.5 / np.sqrt(count), 2.0, rng)


def cloud_of(
    means: np.ndarray, scale: float, logit: float, rng: np.random.Generator
) -> StoredCloud:
    count = len(means)
    arrays = Gaussians(
        means=means,
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(scale) + 0.4 * rng.normal(size=(count, 3)),
        logit_opacities=np.full(count, logit),
        sh=rng.normal(size=(count, 1, 3)),
    )
    return StoredCloud(arrays.map(lambda values: values.astype(np.float32)))


def quality_rows(
    name: str, cloud: StoredCloud, settings: RenderSettings
) -> Iterator[dict[str, Any]]:
    """Compare the page's pictures with ours, for each target of the blending."""
    options = PageOptions(name, name, settings)
    poses = orbit_poses(first_pose(cloud), VIEWS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        facts = written(path, cloud, options)
        for target, prepare in TARGETS.items():
            with open_page(path) as page:
                page.evaluate(prepare)
                found = difference_to_ours(page, cloud, options, poses, SIZE)
            decibels = {"least_db": min(found), "median_db": statistics.median(found)}
            yield {"cloud": name, "target": target, **facts, **rounded(decibels, 1)}


def speed_rows(cloud: StoredCloud) -> Iterator[dict[str, Any]]:
    """Time the page until its first picture, and sorting and drawing of later ones."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        facts = written(path, cloud, PageOptions("ball", "ball", RenderSettings()))
        start = time.perf_counter()
        with open_page(path, size=WINDOW) as page:
            page.evaluate(
                "new Promise(done => { const wait = () => "
                "document.body.classList.contains('drawn') ? done() : setTimeout(wait, 20); "
                "wait(); }).then(() => viewer).then(v => v.renderer.pixels().length)"
            )
            first = {"first_picture_s": time.perf_counter() - start}
            frames = frame_times(page)
        yield {"cloud": "ball", "target": "half floats", **facts, **rounded(first, 1), **frames}


def frame_times(page: Page) -> dict[str, float]:
    """Return the median milliseconds of sorting and drawing."""
    times: Sequence[Sequence[float]] = [page.evaluate(TIME_FRAME) for _ in range(FRAMES)]
    sorting, drawing = map(statistics.median, zip(*times, strict=True))
    return {"sort_ms": round(sorting), "frame_ms": round(drawing)}


def written(path: Path, cloud: StoredCloud, options: PageOptions) -> dict[str, Any]:
    """Write the page; return its size and the seconds that it took."""
    start = time.perf_counter()
    write_page(path, Shown(cloud, "result"), options)
    seconds = time.perf_counter() - start
    facts = {"page_mb": path.stat().st_size / 1e6, "write_s": seconds}
    return {"gaussians": len(cloud.gaussians.means), **rounded(facts, 2)}


def rounded(values: dict[str, float], digits: int) -> dict[str, float]:
    return {name: round(value, digits) for name, value in values.items()}


if __name__ == "__main__":
    main()
