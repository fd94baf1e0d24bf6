"""Exports of runs: the cloud as trained and pruned, from training and from a checkpoint."""

import json
import shutil

import numpy as np
import pytest

from tests.training.runs import cloud_of, launch, length, run_folder
from threestudio_gaussiandreamer.formats import gaussian_files, ply
from threestudio_gaussiandreamer.host import Exporter, ExporterOutput, register


def test_formats_note_training_and_pruning_and_stages_read_no_prior(tmp_path, painted_box, capsys):
    mesh = tmp_path / "box.glb"
    mesh.write_bytes(painted_box.read_bytes())
    options = ["system.renderer.antialias=true", "system.prune.psnr=25", "system.prune.size=32"]
    options += ["system.prune.steps=3", "system.exporter.save_video=false", *length(3)]
    options += ["system.exporter.formats=[ply,compressed-ply,spz,sog,glb,usda]"]
    assert launch(tmp_path, mesh, *options) == 0
    save, said = run_folder(tmp_path) / "save", capsys.readouterr().out
    export, last = save / "it3-export", run_folder(tmp_path) / "ckpts" / "last.ckpt"
    suffixes = ["ply", "compressed.ply", "spz", "sog", "glb"]
    stored = [gaussian_files.read_cloud(str(export / f"gaussians.{suffix}")) for suffix in suffixes]
    assert [cloud.antialiased for cloud in stored] == [True] * 5
    assert [len(cloud.gaussians.means) for cloud in stored] == [200] * 5
    assert "SplatRenderMode: mip" in (export / "gaussians.usda").read_text()
    pruned = [export / "pruned" / f"gaussians.{suffix}" for suffix in ("ply", "spz")]
    report = json.loads((export / "pruned" / "report.json").read_text())
    for path in pruned:
        cloud = gaussian_files.read_cloud(str(path))
        assert str(path) in said and cloud.pruned_to == 25
        assert len(cloud.gaussians.means) == report["after"]["gaussians"] < 200
    # as the demo draws
    assert report["options"]["eps2d"] == 0.03 and report["options"]["antialias"]
    assert (export / "pruned" / "report.png").stat().st_size > 0
    kept = [save / "it3-test" / "1.png", export / "gaussians.ply", *pruned]
    before = [path.read_bytes() for path in kept]
    for path in (*kept, save / "it3-0.png"):
        path.unlink()
    mesh.unlink()  # neither prior nor target is needed any more
    for stage in ("--test", "--validate", "--export"):
        assert launch(tmp_path, mesh, *options, f"resume={last}", stage=stage) == 0
    assert [path.read_bytes() for path in kept] == before and (save / "it3-0.png").is_file()
    means = cloud_of(last)["geometry.means"].numpy()[:, [1, 2, 0]] * np.float32([1, -1, -1])
    assert np.array_equal(ply.read_gaussians(export / "gaussians.ply").means, means)


@register("test-raising-exporter")
class Raising(Exporter):
    def __call__(self):
        raise RuntimeError("no memory for that")


@register("test-unbuildable-exporter")
class Unbuildable(Raising):
    def configure(self, *args, **kwargs):
        raise RuntimeError("not installed")


class Returning(Exporter):
    name = "numbers.json"

    def __call__(self):
        return [ExporterOutput(self.name, "json", {"payload": 1})]


@register("test-same-name-exporter")
class SameName(Returning):
    name = "Gaussians.ply"


@register("test-page-name-exporter")
class PageName(Returning):
    name = "view.html"


FAILING = ("raising", "unbuildable", "same-name", "page-name")


def test_formats_that_fail_leave_the_others(tmp_path, painted_box, capsys):
    formats = ["ply", *(f"test-{name}" for name in FAILING), "points"]
    options = [f"system.exporter.formats=[{','.join(formats)}]", "trainer.max_steps=1"]
    options += ["trainer.val_check_interval=1", "system.prune.count=100"]
    options += ["system.prune.size=32", "system.prune.steps=3"]
    with pytest.raises(RuntimeError, match="no memory for that"):
        launch(tmp_path, painted_box, *options)
    said, export = capsys.readouterr().err, run_folder(tmp_path) / "save" / "it1-export"
    assert "test-raising failed; the other files are written before" in said
    # the launcher prints the error that ends the run; here it is only that of the pruned cloud
    assert said.count("no memory") == said.count("system.prune failed: RuntimeError") == 1
    assert "test-unbuildable failed: RuntimeError: not installed" in said
    assert "save_name 'Gaussians.ply': another file of the export" in said
    assert len(ply.read_gaussians(export / "pruned" / "gaussians.ply").means) == 100
    wanted = {"gaussians.ply", "points.ply"}
    for folder in (export, export / "pruned"):
        assert {path.name for path in folder.iterdir()} >= wanted
    assert (export / "view.html").read_text().startswith("<!")
    last = run_folder(tmp_path) / "ckpts" / "last.ckpt"
    shutil.rmtree(export)
    with pytest.raises(RuntimeError, match="no memory for that"):
        launch(tmp_path, painted_box, options[0], f"resume={last}", stage="--export")
    assert {path.name for path in export.iterdir()} >= wanted
