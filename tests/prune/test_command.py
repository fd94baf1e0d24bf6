"""The prune command: budgets are met on unseen views, and wrong options refused."""

import json

import pytest
import torch

from tests.helpers.ply_files import write_raw_gaussians
from tests.helpers.pruning import FAST, ball, run
from threestudio_gaussiandreamer.formats.gaussian_files import PRUNED, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.ply import read_comments, write_gaussians
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
from threestudio_gaussiandreamer.host import get_device
from threestudio_gaussiandreamer.prune import PruneOptions
from threestudio_gaussiandreamer.prune import command as prune
from threestudio_gaussiandreamer.prune.pipeline import views_of


def test_antialiasing_is_kept_and_the_same_call_gives_the_same_bits(source, tmp_path):
    stored = read_cloud(str(source))._replace(antialiased=True)
    write_cloud(str(tmp_path / "mip.ply"), stored)
    run(tmp_path / "mip.ply", tmp_path / "out.spz", "--count", "550")
    assert json.loads((tmp_path / "out.spz.json").read_text())["options"]["antialias"] is True
    assert read_cloud(str(tmp_path / "out.spz")).antialiased
    for name in ("plain.ply", "again.ply"):
        run(source, tmp_path / name, "--count", "550")
    assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "again.ply").read_bytes()
    assert json.loads((tmp_path / "plain.ply.json").read_text())["options"]["antialias"] is False


def test_what_pruning_to_a_size_has_lost_counts_towards_a_later_quality(source, tmp_path):
    """Against the original, which the later runs don't see."""
    run(source, tmp_path / "fewer.ply", "--bytes", "12kB")
    assert 9_000 < (tmp_path / "fewer.ply").stat().st_size <= 12_000
    lost = read_cloud(str(tmp_path / "fewer.ply")).pruned_to
    run(tmp_path / "fewer.ply", tmp_path / "again.ply", "--psnr", str(lost - 1))
    first = read_cloud(str(source))
    views = views_of(first, PruneOptions(size=48))[-1]
    pictures = render_all(first.gaussians.tensors(get_device()), views)
    for name, least in (("fewer.ply", lost), ("again.ply", lost - 1)):
        found = read_cloud(str(tmp_path / name))
        assert found.pruned_to == pytest.approx(least)
        cloud = found.gaussians.tensors(get_device())
        assert psnr_to_original(cloud, views, pictures) > least - 0.5
    assert not run(tmp_path / "fewer.ply", tmp_path / "more.ply", "--psnr", str(lost + 1))["met"]


def test_a_quality_that_the_format_cannot_give_is_not_said_to_be_met(source, tmp_path, caplog):
    report = run(source, tmp_path / "out.spz", "--psnr", "90")
    assert not report["met"] and report["after"]["gaussians"] == 600
    assert "the budget isn't met" in caplog.text
    assert 30 < read_cloud(str(tmp_path / "out.spz")).pruned_to < 80  # what the format has cost
    assert run(source, tmp_path / "out.ply", "--psnr", "120")["met"]


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """A cloud that has been pruned to 32 dB: its file, its source and the report."""
    folder = tmp_path_factory.mktemp("once")
    write_gaussians(folder / "in.ply", ball().arrays())
    source, path = folder / "in.ply", folder / "once.ply"
    return path, source, run(source, path, "--psnr", "32dB")


def test_a_quality_holds_on_views_that_nothing_was_fitted_to(once):
    path, _, report = once
    assert report["after"]["gaussians"] < 420 and report["psnr_on_unseen_views"] > 31.5
    assert f"{PRUNED} 32" in read_comments(path)


def test_a_second_run_counts_from_the_original(once, tmp_path, capsys):
    path, source, report = once
    count, out = report["after"]["gaussians"], tmp_path / "out.ply"
    run(path, out, "--psnr", "32")  # removes nothing
    assert path.read_bytes() == out.read_bytes()
    assert run(path, out, "--psnr", "31.999")["after"]["gaussians"] >= 0.98 * count
    assert read_cloud(str(out)).pruned_to == 31.999
    run(path, out, "--count", str(count))
    assert read_cloud(str(out)).pruned_to == 32
    capsys.readouterr()
    assert not run(path, out, "--psnr", "45")["met"]
    said = capsys.readouterr().out
    assert "has been pruned to 32 dB before" in said and read_cloud(str(out)).pruned_to == 32
    assert "dB to the input, which had been pruned before" in said


def test_a_count_above_what_is_there_changes_nothing(source, tmp_path, capsys):
    """The report replaces a link and doesn't follow it."""
    (tmp_path / "precious").write_text("precious")
    for ending in (".json", ".png"):
        (tmp_path / f"a.ply{ending}").symlink_to(tmp_path / "precious")
    assert run(source, tmp_path / "a.ply", "--count", "1000")["after"]["gaussians"] == 600
    assert "dB to the original, on the test views" in capsys.readouterr().out
    assert read_cloud(str(tmp_path / "a.ply")).pruned_to is None
    assert (tmp_path / "precious").read_text() == "precious"
    assert json.loads((tmp_path / "a.ply.json").read_text())["after"]["gaussians"] == 600


COUNT = ["--count", "9"]


@pytest.mark.parametrize(
    ("files", "options", "said"),
    [
        ("in.ply out.ply", ["--bytes", "1"], "--bytes: 1 are too few for one Gaussian, which"),
        ("in.ply out.ply", [*COUNT, "--quality", "35"], "--quality: has no effect without the"),
        ("in.ply out.ply", ["--within", "1", "--quality", "nan"], "--quality: expected a finite"),
        ("in.ply out.ply", [], "one of the arguments"),
        ("in.ply out.ply", [*COUNT, "--psnr", "40"], "not allowed with"),
        ("in.ply in.ply", COUNT, "OUT is IN"),
        ("a.ckpt out.ply", COUNT, "holds no cloud of Gaussians"),
        ("im.ply out.ply", COUNT, "in.ply"),  # the near name
        ("in.ply out.obj", COUNT, "expected the name of a .ply or .spz file"),
        ("in.ply folder.ply", COUNT, "folder.ply' can't be written"),
        ("in.ply report.ply", COUNT, "error: OUT.json:"),
        ("in.ply picture.ply", COUNT, "error: OUT.png:"),
        ("in.ply a\0b.ply", COUNT, "error: OUT: "),
        (f"in.ply {'x' * 249}.ply", COUNT, "error: OUT.json: "),
        ("dim.ply out.ply", ["--psnr", "40", *FAST], "none of the 600 Gaussians is visible in any"),
        ("huge.ply out.ply", COUNT, "the largest scale is"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_written(
    source, tmp_path, capsys, monkeypatch, files, options, said
):
    monkeypatch.chdir(tmp_path)
    first = files.split()[0]
    if first == "dim.ply":
        dim = ball()._replace(logit_opacities=torch.full((600,), -20.0))
        write_gaussians(tmp_path / first, dim.arrays())
    if first == "huge.ply":
        cloud = ball()
        cloud.log_scales[:] = 40.0
        write_raw_gaussians(tmp_path / first, cloud.arrays())
    torch.save({"state_dict": {"weight": torch.zeros(3)}}, "a.ckpt")
    for folder in ("folder.ply", "report.ply.json", "picture.ply.png"):
        (tmp_path / folder).mkdir()
    before, content = sorted(tmp_path.iterdir()), source.read_bytes()
    assert prune.main([*files.split(), *options]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error and len(error) < 4000
    assert sorted(tmp_path.iterdir()) == before and source.read_bytes() == content
