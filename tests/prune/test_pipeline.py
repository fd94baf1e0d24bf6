"""Files and checkpoints of Gaussians are read and pruned as their formats store them."""

import numpy as np
import pytest
import torch

from tests.helpers.ply_files import write_raw_gaussians
from tests.helpers.pruning import ball, run
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.ply import write_gaussians
from threestudio_gaussiandreamer.formats.spz import COLOR_REACH
from threestudio_gaussiandreamer.gaussians.sh import C0, sh_to_colors
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
from threestudio_gaussiandreamer.host import get_device
from threestudio_gaussiandreamer.prune import PruneOptions, command
from threestudio_gaussiandreamer.prune.pipeline import constant_sh_limit, views_of
from threestudio_gaussiandreamer.splatting import rasterize


def test_the_rounding_of_the_format_counts_towards_the_budget(tmp_path):
    """Also if the budget is already used up, and if a count removes nothing."""
    bright = ball()
    bright.sh[:] *= 6
    write_gaussians(tmp_path / "in.ply", bright.arrays())
    assert run(tmp_path / "in.ply", tmp_path / "once.ply", "--psnr", "35")["met"]
    assert not run(tmp_path / "once.ply", tmp_path / "twice.spz", "--psnr", "35")["met"]
    run(tmp_path / "once.ply", tmp_path / "count.spz", "--count", "600")
    first = read_cloud(str(tmp_path / "in.ply"))
    views = views_of(first, PruneOptions(size=48))[-1]
    pictures = render_all(first.gaussians.tensors(get_device()), views)
    for name in ("twice.spz", "count.spz"):
        found = read_cloud(str(tmp_path / name))
        turned = found.in_axes(first.up).gaussians.tensors(get_device())
        assert found.pruned_to < 34.9
        assert psnr_to_original(turned, views, pictures) > found.pruned_to - 0.5


@pytest.mark.parametrize(
    ("drawn", "eps2d"), [({}, 0.3), ({"eps2d": 0.05}, 0.05), ({"antialias": True}, 0.3)]
)
def test_a_cloud_is_judged_as_the_viewer_draws_it(source, drawn, eps2d):
    cloud, size = ball(), (48, 48)
    shape = (cloud.means, cloud.quats, cloud.log_scales.exp(), cloud.logit_opacities.sigmoid())
    for views in views_of(read_cloud(str(source)), PruneOptions(size=48, **drawn)):
        camera = (sh_to_colors(cloud.sh, cloud.means), views.viewmats[:1], views.Ks[:1], *size)
        options = {"background": views.backgrounds[:1], "near": views.near, "eps2d": eps2d}
        expected = rasterize(*shape, *camera, **options, antialias="antialias" in drawn).image[0]
        assert torch.equal(render_all(cloud, views)[0], expected)


def gsplats_names(cloud):
    """Return the values of ``cloud`` under the names of gsplat's checkpoints."""
    names = "means", "quats", "scales", "opacities", "sh0"
    return dict(zip(names, cloud, strict=True)) | {"shN": torch.zeros(len(cloud.means), 0, 3)}


def test_gsplats_checkpoints_are_read(source, tmp_path):
    cloud = ball()
    torch.save({"step": 7, "splats": gsplats_names(cloud)}, tmp_path / "ckpt.pt")
    write_cloud(str(tmp_path / "in.ply"), StoredCloud(cloud.arrays()).in_axes("-y"))
    for name in ("ckpt.pt", "in.ply"):
        run(tmp_path / name, tmp_path / f"{name}.ply", "--count", "550")
    from_checkpoint, from_ply = (tmp_path / f"{name}.ply" for name in ("ckpt.pt", "in.ply"))
    assert from_checkpoint.read_bytes() == from_ply.read_bytes()
    assert read_cloud(str(from_ply)).up == "-y"


def test_a_cloud_of_one_gaussian_is_copied(tmp_path):
    write_gaussians(tmp_path / "in.ply", ball(1).arrays())
    for budget in (("--count", "1"), ("--psnr", "30")):
        assert run(tmp_path / "in.ply", tmp_path / "out.ply", *budget)["met"]
        assert len(read_cloud(str(tmp_path / "out.ply")).gaussians.means) == 1


@pytest.mark.parametrize(("notes", "written"), [(["up: z"], "z"), ([], "-y")])
def test_pruning_a_ply_does_not_rotate_it(tmp_path, notes, written):
    write_gaussians(tmp_path / "in.ply", ball(9).arrays(), notes)
    run(tmp_path / "in.ply", tmp_path / "out.ply", "--count", "9")
    read = read_cloud(str(tmp_path / "out.ply"))
    np.testing.assert_array_equal(read.gaussians.means, ball(9).means)
    assert read.up == written


def test_what_cannot_be_drawn_is_left_out(tmp_path, caplog):
    """Harmonics above degree 3, and rows of a file or a checkpoint that aren't finite."""
    cloud = ball(bands=25)
    cloud.means[3], cloud.sh[5] = float("nan"), float("inf")
    write_raw_gaussians(tmp_path / "in.ply", cloud.arrays())
    torch.save({"splats": gsplats_names(cloud._replace(sh=cloud.sh[:, :1]))}, tmp_path / "in.pt")
    for name in ("in.ply", "in.pt"):
        report = run(tmp_path / name, tmp_path / "out.ply", "--count", "550", "--up", "z")
        assert report["before"]["gaussians"] == 598
        degree = read_cloud(str(tmp_path / "out.ply")).gaussians.sh_degree
        assert degree == (3 if name == "in.ply" else 0)
    assert caplog.text.count("2 of 600 Gaussians hold NaN or infinity: left out") == 2
    assert "in.ply: of harmonics of degree 4 a part is left out" in caplog.text


def test_a_compact_file_is_written_within_its_size_and_read_again(source, tmp_path):
    found = run(source, tmp_path / "out.spz", "--bytes", "7kB")["after"]
    assert 6_600 < (tmp_path / "out.spz").stat().st_size == found["bytes"] <= 7_000
    assert found["gaussians"] > 300
    found = run(tmp_path / "out.spz", tmp_path / "again.spz", "--count", "200")["after"]
    assert found["gaussians"] == 200
    assert read_cloud(str(tmp_path / "again.spz")).up == "y"


def test_colours_beyond_the_compact_formats_reach_are_fitted_within_it(tmp_path):
    cloud, path = ball(), str(tmp_path / "in.ply")
    cloud.sh[::7] *= 12  # thin ones, which others hide in part
    cloud.logit_opacities[::7] = -1
    write_gaussians(tmp_path / "in.ply", cloud.arrays())
    assert float(cloud.sh.abs().max()) > 2 * COLOR_REACH
    options = [path, str(tmp_path / "out.spz"), "--count", "600", "--size", "48", "--steps"]
    few, many = (command.run(command.parse([*options, steps])) for steps in ("1", "60"))
    assert many["after"]["gaussians"] == 600
    assert many["psnr_on_unseen_views"] > few["psnr_on_unseen_views"] + 1


def test_views_turn_with_the_axes_of_the_file(source):
    heights = []
    for up, axis, sign in (("z", 2, 1), ("y", 1, 1), ("-y", 1, -1)):
        views = views_of(read_cloud(str(source), up=up), PruneOptions(size=48))[0]
        heights.append(views.positions[:, axis] * sign)
    assert all(torch.allclose(heights[0], other, atol=0.05) for other in heights[1:])
    assert heights[0].max() > 1 > -1 > heights[0].min()


def test_recovered_colours_stay_in_the_range_that_viewers_show():
    """In [0, 1], in the input's range if that is larger, and in the format's range."""
    shown = 0.5 / C0
    cloud = ball()._replace(sh=torch.full((2, 1, 3), 0.3))
    assert constant_sh_limit(cloud, ".ply") == pytest.approx(shown)
    assert constant_sh_limit(cloud, ".spz") == pytest.approx(shown)
    bright = cloud._replace(sh=torch.tensor([2.0, -4.0]).view(2, 1, 1).expand(2, 1, 3))
    assert constant_sh_limit(bright, ".ply") == 4
    assert constant_sh_limit(bright, ".spz") == COLOR_REACH
