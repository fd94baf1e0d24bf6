"""What a run leaves to look at: a page that is the run's, with the first cloud, and pictures."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from benchmarks.viewers import browser, devtools
from tests.helpers.painted_ball import painted_ball
from tests.training.runs import launch, length, run_folder
from tests.view.clouds import meta
from threestudio_gaussiandreamer.exporters import files
from threestudio_gaussiandreamer.images import read
from threestudio_gaussiandreamer.training.export import discard_turntable

SHORT = [*length(2)]
MESH = "{faces: 200, texture: 64, views: 8, view_size: 64, resolution: 16}"


@pytest.fixture(scope="module")
def meshes():
    """The options with which meshes were made; each is that of a ball instead of the cloud."""
    seen, convert = [], files.mesh_from_gaussians

    def converted(gaussians, options):
        seen.append(options)
        return convert(painted_ball(200), options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "mesh_from_gaussians", converted)
        yield seen


@pytest.fixture(scope="module")
def save(tmp_path_factory, painted_box, meshes):
    folder = tmp_path_factory.mktemp("pages")
    options = ["system.prompt_processor.prompt=a <painted> box", "system.renderer.eps2d=0.2"]
    options += ["system.renderer.antialias=true", "system.exporter.formats=[ply,mesh]"]
    options += [f"system.exporter.options={{mesh: {MESH}}}"]
    assert launch(folder, painted_box, *options, *SHORT) == 0
    return run_folder(folder) / "save"


def test_a_run_ends_with_a_page_and_a_mesh_of_its_cloud(save, meshes):
    found = meta((save / "it2-export" / "view.html").read_text())
    assert found["title"] == "a <painted> box" and found["background"] == "#ffffff"
    assert found["settings"]["eps2d"] == 0.2 and found["settings"]["alphaMin"] == 1 / 255
    scores = json.loads((save / "metrics.json").read_text())
    for shown, label in zip(found["clouds"], ("result", "prior"), strict=True):
        assert shown["label"] == label and shown["count"] == 200
        assert shown["quality"] == f"{scores[label]['psnr']:.1f} dB on held-out views"
    header = found["plyHeader"].encode()
    assert (save / "it2-export" / "gaussians.ply").read_bytes().startswith(header)
    poster = np.asarray(Image.open(save / "it2-export" / "poster.png"))
    assert poster.shape == (512, 512, 4)
    assert poster[0, 0, 3] == 0 and poster[..., 3].max() > 60
    turntable = Image.open(save / "it2-test.webp")
    assert turntable.n_frames == len(list((save / "it2-test").glob("*.png"))) == 3
    expected = read(save / "it2-test" / "0.png").astype(float)
    assert np.abs(np.asarray(turntable.convert("RGB")) - expected).mean() < 8
    export = save / "it2-export"
    written = {"gaussians.ply", "mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png"}
    assert written <= {path.name for path in export.iterdir()}
    assert (meshes[0].eps2d, meshes[0].antialias, meshes[0].faces) == (0.2, True, 200)
    name = (export / "mesh.obj").read_text("utf-8").splitlines()[1].removeprefix("o ")
    assert f'"name":"{name}"' in (export / "mesh.glb").read_bytes().decode(errors="ignore")


def test_without_ffmpeg_or_a_page_the_cloud_is_exported(tmp_path, painted_box, monkeypatch, capfd):
    monkeypatch.setattr("threestudio_gaussiandreamer.view.page.MAX_GAUSSIANS", 100)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert launch(tmp_path, painted_box, "system.prompt_processor.prompt=a box", *SHORT) == 0
    save = run_folder(tmp_path) / "save"
    assert (save / "it2-export" / "gaussians.ply").is_file()
    assert not list(save.glob("*.mp4"))
    said = capfd.readouterr().err
    assert "pip install imageio-ffmpeg" in said
    assert "no view.html is written" in said and "200 Gaussians" in said


IMAGES = "[...document.images].map(image => image.decode().then(() => image.naturalWidth))"
VIDEO = (
    "new Promise((done, fail) => { const video = document.querySelector('video');"
    " video.onloadeddata = () => done(video.videoWidth); video.onerror = () => fail(video.error);"
    " video.load(); })"
)


@pytest.mark.slow
@pytest.mark.skipif(browser.chromium() is None, reason="no Chromium is installed")
def test_a_browser_and_a_phone_show_the_index_of_a_run(save):
    index = save.parent / "index.html"
    with devtools.open_page(index) as page:
        page.evaluate("document.querySelectorAll('img').forEach(image => image.loading = 'eager')")
        widths = page.evaluate(f"Promise.all({IMAGES})")
        assert len(widths) >= 3 and min(widths) > 0
        assert page.evaluate(VIDEO) == 32  # H.264 in yuv420p, which every browser plays
        phone = {"width": 320, "height": 600, "deviceScaleFactor": 1, "mobile": True}
        page.call("Emulation.setDeviceMetricsOverride", **phone)
        assert page.evaluate("document.documentElement.scrollWidth") <= 320
        assert page.problems == []
        folder = save.parent.resolve().as_uri() + "/"
        assert all(x.startswith((folder, "data:", "blob:")) for x in page.requests)
        assert index.as_uri() in page.requests


def test_export_writes_the_page_again_and_a_test_discards_old_pictures(save, painted_box):
    pictures = sorted((save / "it2-test").glob("*.png"))
    page = save / "it2-export/view.html"
    page.unlink()
    resume = [f"resume={save.parent / 'ckpts/last.ckpt'}", "system.exporter.save_video=false"]
    assert launch(save.parents[2], painted_box, *resume, stage="--export") == 0
    assert pictures and sorted((save / "it2-test").glob("*.png")) == pictures
    assert [shown["label"] for shown in meta(page.read_text())["clouds"]] == ["result", "prior"]
    discard_turntable(SimpleNamespace(get_save_dir=lambda: str(save), true_global_step=2))
    assert not any(path.exists() for path in pictures)
