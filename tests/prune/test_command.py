"""The prune command: budgets are met on unseen views, and wrong options refused."""

import json
import re

import numpy as np
import pytest
import torch

from tests.helpers.ply_files import write_raw_gaussians
from tests.helpers.pruning import FAST, ball, run
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import gaussian_files, ply, spz
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.sh import C0, sh_to_colors
from threestudio_gaussiandreamer.gaussians.simplify import Budget
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
from threestudio_gaussiandreamer.host import get_device
from threestudio_gaussiandreamer.prune import PruneOptions, command, pipeline
from threestudio_gaussiandreamer.prune import options as budgets
from threestudio_gaussiandreamer.splatting import rasterize


@pytest.fixture
def source(tmp_path):
    ply.write_gaussians(tmp_path / "in.ply", ball().arrays())
    return tmp_path / "in.ply"


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
    views = pipeline.views_of(first, PruneOptions(size=48))[-1]
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
    ply.write_gaussians(folder / "in.ply", ball().arrays())
    source, path = folder / "in.ply", folder / "once.ply"
    return path, source, run(source, path, "--psnr", "32dB")


def test_a_quality_holds_on_views_that_nothing_was_fitted_to(once):
    path, _, report = once
    assert report["after"]["gaussians"] < 420 and report["psnr_on_unseen_views"] > 31.5
    assert f"{gaussian_files.PRUNED} 32" in ply.read_comments(path)


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
def test_mistakes_are_named(source, tmp_path, capsys, monkeypatch, files, options, said):
    monkeypatch.chdir(tmp_path)
    first = files.split()[0]
    if first == "dim.ply":
        dim = ball()._replace(logit_opacities=torch.full((600,), -20.0))
        ply.write_gaussians(tmp_path / first, dim.arrays())
    if first == "huge.ply":
        cloud = ball()
        cloud.log_scales[:] = 40.0
        write_raw_gaussians(tmp_path / first, cloud.arrays())
    torch.save({"state_dict": {"weight": torch.zeros(3)}}, "a.ckpt")
    for folder in ("folder.ply", "report.ply.json", "picture.ply.png"):
        (tmp_path / folder).mkdir()
    before, content = sorted(tmp_path.iterdir()), source.read_bytes()
    assert command.main([*files.split(), *options]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error and len(error) < 4000
    assert sorted(tmp_path.iterdir()) == before and source.read_bytes() == content


def test_the_rounding_of_the_format_counts_towards_the_budget(tmp_path):
    """Also if the budget is already used up, and if a count removes nothing."""
    bright = ball()
    bright.sh[:] *= 6
    ply.write_gaussians(tmp_path / "in.ply", bright.arrays())
    assert run(tmp_path / "in.ply", tmp_path / "once.ply", "--psnr", "35")["met"]
    assert not run(tmp_path / "once.ply", tmp_path / "twice.spz", "--psnr", "35")["met"]
    run(tmp_path / "once.ply", tmp_path / "count.spz", "--count", "600")
    first = read_cloud(str(tmp_path / "in.ply"))
    views = pipeline.views_of(first, PruneOptions(size=48))[-1]
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
    for views in pipeline.views_of(read_cloud(str(source)), PruneOptions(size=48, **drawn)):
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
    ply.write_gaussians(tmp_path / "in.ply", ball(1).arrays())
    for budget in (("--count", "1"), ("--psnr", "30")):
        assert run(tmp_path / "in.ply", tmp_path / "out.ply", *budget)["met"]
        assert len(read_cloud(str(tmp_path / "out.ply")).gaussians.means) == 1


@pytest.mark.parametrize(("notes", "written"), [(["up: z"], "z"), ([], "-y")])
def test_pruning_a_ply_does_not_rotate_it(tmp_path, notes, written):
    ply.write_gaussians(tmp_path / "in.ply", ball(9).arrays(), notes)
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
    ply.write_gaussians(tmp_path / "in.ply", cloud.arrays())
    assert float(cloud.sh.abs().max()) > 2 * spz.COLOR_REACH
    options = [path, str(tmp_path / "out.spz"), "--count", "600", "--size", "48", "--steps"]
    few, many = (command.run(command.parse([*options, steps])) for steps in ("1", "60"))
    assert many["after"]["gaussians"] == 600
    assert many["psnr_on_unseen_views"] > few["psnr_on_unseen_views"] + 1


def test_views_turn_with_the_axes_of_the_file(source):
    heights = []
    for up, axis, sign in (("z", 2, 1), ("y", 1, 1), ("-y", 1, -1)):
        views = pipeline.views_of(read_cloud(str(source), up=up), PruneOptions(size=48))[0]
        heights.append(views.positions[:, axis] * sign)
    assert all(torch.allclose(heights[0], other, atol=0.05) for other in heights[1:])
    assert heights[0].max() > 1 > -1 > heights[0].min()


def test_recovered_colours_stay_in_the_range_that_viewers_show():
    """In [0, 1], in the input's range if that is larger, and in the format's range."""
    shown = 0.5 / C0
    cloud = ball()._replace(sh=torch.full((2, 1, 3), 0.3))
    assert pipeline.constant_sh_limit(cloud, ".ply") == pytest.approx(shown)
    assert pipeline.constant_sh_limit(cloud, ".spz") == pytest.approx(shown)
    bright = cloud._replace(sh=torch.tensor([2.0, -4.0]).view(2, 1, 1).expand(2, 1, 3))
    assert pipeline.constant_sh_limit(bright, ".ply") == 4
    assert pipeline.constant_sh_limit(bright, ".spz") == spz.COLOR_REACH


@pytest.mark.parametrize(
    ("asked", "spent", "left"),
    [(37, 40, 40.02), (30, 60, 30.004), (40, 40, None), (41, 40, None), (39.99999999, 40, None)],
)
def test_the_remaining_budget(asked, spent, left):
    stored = StoredCloud(ball(7).arrays(), pruned_to=spent)
    found = pipeline.remaining_budget(Budget(psnr=asked), stored)
    assert found.psnr == (left and pytest.approx(left, abs=5e-3))
    if left is None:
        assert found.count == 7
    else:
        assert budgets.combined_psnr(spent, left) == pytest.approx(asked, abs=2e-3)


def test_the_psnr_that_loses_a_tenth_of_a_decibel():
    # two independent errors: their squares add
    psnr = budgets.psnr_for_loss(0.1, 35.0)
    assert 10 ** (-3.5) + 10 ** (-psnr / 10) == pytest.approx(10 ** (-3.49))


def test_sizes_and_decibels_are_read_with_their_units():
    sizes = {"500kB": 500_000, " 2 MB ": 2_000_000, "1.5g": 1_500_000_000, 7: 7}
    assert [budgets.parse_bytes(text, "bytes") for text in sizes] == [*sizes.values()]
    for text in ("40", " 40dB ", "40 db", 40.0):
        assert budgets.parse_number(text, "psnr", "dB") == 40.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *(
            ({"count": n}, "--count: expected a whole number from 1 on, got")
            for n in ("0", "1.5", "x")
        ),
        *(({"bytes": text}, "--bytes: expected a size such as") for text in ("2 potatoes", "1e3")),
        ({"bytes": "9" * 30 + "G"}, "below 2^63 bytes"),
        ({"bytes": "9" * 400}, "expected a number"),
        ({"psnr": "nan"}, "--psnr: expected a number"),
        ({"psnr": "-3"}, "--psnr: expected a number above 0 (dB), got -3"),
        ({"within": "0", "quality": 35}, "--within: expected a number from 0.001 to 30 (dB), "),
        *(({"auto": text}, "--auto: expected a") for text in ("0", "6", "nan")),
    ],
)
def test_a_budget_that_is_none_is_named(given, said):
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        budgets.budget_of(PruneOptions(**given), "--")
    assert len(str(caught.value)) < 200


def test_a_gain_is_a_budget():
    assert budgets.budget_of(PruneOptions(auto="0.25dB"), "--")[-2:] == (0.25, pytest.approx(1e-4))
    found = budgets.budget_of(PruneOptions(auto=1, quality=30.0), "--")[-2:]
    assert found == (1.0, pytest.approx(1e-3))
    for words in ("--auto in.ply out.ply", "in.ply out.ply --auto"):
        assert command.parse(words.split()).auto == "0.5"
    assert command.parse("in.ply --auto 1dB o".split()).auto == "1dB"
