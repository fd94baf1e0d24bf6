"""The prune command: budgets are met on unseen views, a second run changes nothing, and mistakes
cost no work.
"""

import errno
import json
import math
import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.helpers.raw_ply import write_raw_gaussians
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import (
    PRUNED,
    StoredCloud,
    read_cloud,
    write_cloud,
)
from threestudio_gaussiandreamer.formats.ply import read_comments, read_gaussians, write_gaussians
from threestudio_gaussiandreamer.gaussians import simplify
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.gaussians.simplify import Budget
from threestudio_gaussiandreamer.prune import command as prune
from threestudio_gaussiandreamer.splatting import rasterize

FAST = ["--size", "48", "--steps", "8"]


def ball(count=600, bands=1):
    """A coloured ball of thin shells: what is inside is hidden."""
    rng = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    means *= torch.where(torch.arange(count) % 3 == 0, 0.5, 1.0)[:, None]
    sh = torch.zeros(count, bands, 3)
    sh[:, 0] = means
    quats = torch.randn(count, 4, generator=rng)
    return Gaussians(means, quats, torch.full((count, 3), -2.2), torch.full((count,), 3.0), sh)


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.ply"
    write_gaussians(path, ball().arrays())
    return path


def run(source, output, *options):
    return prune.run(prune.parse([str(source), str(output), *options, *FAST]))


def test_a_count_is_met_exactly(source, tmp_path):
    report = run(source, tmp_path / "out.ply", "--count", "250")
    assert report["after"]["gaussians"] == 250 == len(read_gaussians(tmp_path / "out.ply").means)
    assert json.loads((tmp_path / "out.ply.json").read_text())["after"]["gaussians"] == 250
    assert (tmp_path / "out.ply.png").stat().st_size > 0


def test_a_size_is_kept(source, tmp_path):
    run(source, tmp_path / "out.ply", "--bytes", "20kB")
    assert 15_000 < (tmp_path / "out.ply").stat().st_size <= 20_000


def test_a_quality_holds_on_views_that_nothing_was_fitted_to(source, tmp_path):
    report = run(source, tmp_path / "out.ply", "--psnr", "32")
    assert report["after"]["gaussians"] < 420 and report["psnr_on_unseen_views"] > 31.5


def test_a_second_run_removes_nothing(source, tmp_path):
    run(source, tmp_path / "once.ply", "--psnr", "32dB")
    run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "32")
    assert (tmp_path / "once.ply").read_bytes() == (tmp_path / "twice.ply").read_bytes()
    assert f"{PRUNED} 32" in read_comments(tmp_path / "twice.ply")


def test_a_second_run_of_nearly_the_same_budget_has_nearly_nothing_to_spend(source, tmp_path):
    once = run(source, tmp_path / "once.ply", "--psnr", "32")["after"]["gaussians"]
    assert (
        run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "31.999")["after"]["gaussians"]
        >= 0.98 * once
    )
    assert read_cloud(str(tmp_path / "twice.ply")).pruned_to == 31.999


@pytest.mark.parametrize(
    ("asked", "spent", "left"),
    [
        (37.0, 40.0, 40.02),
        (30.0, 60.0, 30.004),
        (40.0, 40.0, None),
        (41.0, 40.0, None),
        (39.99999999, 40.0, None),
    ],
)
def test_what_is_left_of_a_budget(asked, spent, left):
    assert prune.unspent(asked, spent) == (left and pytest.approx(left, abs=5e-3))
    assert left is None or prune.spent_together(spent, left) == pytest.approx(asked, abs=2e-3)


def test_a_count_that_changes_nothing_keeps_the_note(source, tmp_path):
    once = run(source, tmp_path / "once.ply", "--psnr", "32")["after"]["gaussians"]
    run(tmp_path / "once.ply", tmp_path / "same.ply", "--count", str(once))
    run(tmp_path / "once.ply", tmp_path / "fewer.ply", "--count", str(once - 50))
    assert (
        read_cloud(str(tmp_path / "same.ply")).pruned_to == 32
        and read_cloud(str(tmp_path / "fewer.ply")).pruned_to is None
    )


def test_a_quality_that_the_format_cannot_give_is_not_said_to_be_met(source, tmp_path, caplog):
    assert run(source, tmp_path / "fine.ply", "--psnr", "30")["met"]
    report = run(source, tmp_path / "out.spz", "--psnr", "90")
    assert (
        not report["met"]
        and report["after"]["gaussians"] == 600
        and "the budget isn't met" in caplog.text
    )
    assert 30 < read_cloud(str(tmp_path / "out.spz")).pruned_to < 80  # what the format has cost
    assert run(source, tmp_path / "out.ply", "--psnr", "120")["met"]


def test_what_a_format_costs_is_spent_too(tmp_path):
    """Also where the budget has been spent already, and where a count drops nothing."""
    bright = ball()
    bright.sh[:] *= 6
    write_gaussians(tmp_path / "in.ply", bright.arrays())
    assert run(tmp_path / "in.ply", tmp_path / "once.ply", "--psnr", "35")["met"]
    assert not run(tmp_path / "once.ply", tmp_path / "twice.spz", "--psnr", "35")["met"]
    run(tmp_path / "once.ply", tmp_path / "count.spz", "--count", "600")
    first = read_cloud(str(tmp_path / "in.ply"))
    views = prune.views_of(first, prune.PruneOptions(size=48))[-1]
    pictures = simplify.look(prune.tensors_of(first), views)
    for name in ("twice.spz", "count.spz"):
        found = read_cloud(str(tmp_path / name))
        turned = prune.tensors_of(found.in_axes(first.up))
        assert (
            found.pruned_to < 34.9
            and simplify.likeness(turned, views, pictures) > found.pruned_to - 0.5
        )


def test_a_stricter_budget_than_what_is_spent_is_not_met(source, tmp_path, capsys):
    run(source, tmp_path / "once.ply", "--psnr", "30")
    report = run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "45")
    assert not report["met"] and "has been pruned to 30 dB already" in capsys.readouterr().out
    assert read_cloud(str(tmp_path / "twice.ply")).pruned_to == 30


@pytest.mark.parametrize(
    ("here", "count", "rounds"),
    [(100, 100, 0), (10, 20, 0), (10000, 6400, 2), (10000, 1500, 9), (2, 1, 1), (600, 1, 24)],
)
def test_how_many_rounds_it_takes(here, count, rounds):
    assert simplify.rounds_to(count, here) == rounds


@pytest.mark.parametrize(
    ("drawn", "eps2d"), [({}, 0.3), ({"eps2d": 0.05}, 0.05), ({"antialias": True}, 0.3)]
)
def test_a_cloud_is_judged_as_the_viewer_draws_it(source, drawn, eps2d):
    for views in prune.views_of(read_cloud(str(source)), prune.PruneOptions(size=48, **drawn)):
        cloud, rgb = ball(), sh_to_colors(ball().sh, ball().means)
        shape = (
            cloud.means,
            cloud.quats,
            cloud.log_scales.exp(),
            cloud.logit_opacities.sigmoid(),
            rgb,
            views.viewmats[:1],
            views.Ks[:1],
        )
        options = {
            "background": views.backgrounds[:1],
            "near": views.near,
            "eps2d": eps2d,
            "antialias": "antialias" in drawn,
        }
        assert torch.equal(
            simplify.look(cloud, views)[0], rasterize(*shape, 48, 48, **options).image[0]
        )


def test_the_input_is_not_overwritten(source, tmp_path, capsys):
    before = source.read_bytes()
    assert prune.main([str(source), str(source), "--count", "10"]) == 2
    assert "OUT is IN" in capsys.readouterr().err and source.read_bytes() == before


def test_a_looser_budget_goes_on(source, tmp_path):
    run(source, tmp_path / "once.ply", "--psnr", "55")
    assert run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "40")["after"][
        "gaussians"
    ] < len(read_gaussians(tmp_path / "once.ply").means)


def test_the_same_call_gives_the_same_bits(source, tmp_path):
    for name in ("a.ply", "b.ply"):
        run(source, tmp_path / name, "--count", "300")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_hidden_gaussians_go_first():
    cloud = ball()
    views = simplify.views_around(cloud, 16, 48)
    kept = simplify.only(cloud, simplify.worth(cloud, views), 400)
    outside = kept.means.norm(dim=1) > 0.9
    assert (
        outside.double().mean() > 0.9
    )  # two thirds of all; a few inner ones are seen through gaps


def test_recovery_pays():
    cloud = ball()
    probes, judges = (
        simplify.views_around(cloud, count, 48, turn=turn) for count, turn in ((16, 0.0), (8, 45.0))
    )
    pictures = simplify.look(cloud, probes)
    pruned = simplify.only(cloud, simplify.worth(cloud, probes), 200)
    recovered = simplify.recover(pruned, probes, pictures, 40, 0)
    before = simplify.look(cloud, judges)
    assert (
        simplify.likeness(recovered, judges, before)
        > simplify.likeness(pruned, judges, before) + 1.0
    )


def test_harmonics_are_kept(tmp_path):
    write_gaussians(tmp_path / "in.ply", ball(bands=4).arrays())
    run(tmp_path / "in.ply", tmp_path / "out.ply", "--count", "400")
    assert read_gaussians(tmp_path / "out.ply").sh.shape == (400, 4, 3)


def test_a_checkpoint_is_read(tmp_path):
    cloud = ball()
    state = {f"geometry.{name}": value for name, value in cloud._asdict().items() if name != "sh"}
    state |= {"geometry.sh0": cloud.sh, "geometry.sh_rest": torch.zeros(len(cloud.means), 0, 3)}
    torch.save({"state_dict": state, "epoch": 0, "global_step": 1}, tmp_path / "last.ckpt")
    assert (
        run(tmp_path / "last.ckpt", tmp_path / "out.ply", "--count", "300")["before"]["gaussians"]
        == 600
    )


def test_gsplats_checkpoints_are_read(source, tmp_path):
    cloud = ball()
    splats = {
        "means": cloud.means,
        "quats": cloud.quats,
        "scales": cloud.log_scales,
        "opacities": cloud.logit_opacities,
    }
    torch.save(
        {"step": 7, "splats": splats | {"sh0": cloud.sh, "shN": torch.zeros(600, 0, 3)}},
        tmp_path / "ckpt.pt",
    )
    write_cloud(str(tmp_path / "in.ply"), StoredCloud(cloud.arrays()).in_axes("-y"))
    for name in ("ckpt.pt", "in.ply"):
        run(tmp_path / name, tmp_path / f"{name}.ply", "--count", "300")
    from_checkpoint, from_ply = (tmp_path / f"{name}.ply" for name in ("ckpt.pt", "in.ply"))
    assert from_checkpoint.read_bytes() == from_ply.read_bytes()
    assert read_cloud(str(from_ply)).up == "-y"


@pytest.mark.parametrize(("stated", "written"), [("z", "z"), ("-y", "-y"), (None, "-y")])
def test_pruning_a_ply_does_not_rotate_it(tmp_path, stated, written):
    notes = [f"up: {stated}"] if stated else []
    write_gaussians(tmp_path / "in.ply", ball().arrays(), notes)
    run(tmp_path / "in.ply", tmp_path / "out.ply", "--count", "600")
    read = read_cloud(str(tmp_path / "out.ply"))
    np.testing.assert_array_equal(read.gaussians.means, ball().means)
    assert read.up == written


def test_a_ply_from_an_spz_has_the_axes_of_the_viewers(source, tmp_path):
    run(source, tmp_path / "a.spz", "--count", "600")
    run(tmp_path / "a.spz", tmp_path / "b.ply", "--count", "600")
    assert read_cloud(str(tmp_path / "b.ply")).up == "-y"


@pytest.mark.parametrize("output", ["out.spz", "out.ply"])
def test_harmonics_that_cannot_be_drawn_are_one_message(tmp_path, capsys, output):
    write_raw_gaussians(tmp_path / "in.ply", ball(bands=25).arrays())
    arguments = [str(tmp_path / "in.ply"), str(tmp_path / output), "--count", "300", *FAST]
    assert prune.main(arguments) == 2
    assert (
        "in.ply: the Gaussians have harmonics of degree 4; expected 0 to 3"
        in capsys.readouterr().err
    )


def test_gaussians_that_cannot_be_drawn_are_left_out(tmp_path, caplog):
    cloud = ball()
    cloud.means[3], cloud.sh[5] = float("nan"), float("inf")
    write_raw_gaussians(tmp_path / "in.ply", cloud.arrays())
    splats = {
        "means": cloud.means,
        "quats": cloud.quats,
        "scales": cloud.log_scales,
        "opacities": cloud.logit_opacities,
    }
    torch.save(
        {"splats": splats | {"sh0": cloud.sh, "shN": torch.zeros(600, 0, 3)}}, tmp_path / "in.pt"
    )
    for name in ("in.ply", "in.pt"):
        assert (
            run(tmp_path / name, tmp_path / "out.ply", "--count", "300", "--up", "z")["before"][
                "gaussians"
            ]
            == 598
        )
    assert caplog.text.count("2 of 600 Gaussians hold NaN or infinity: left out") == 2


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e14])
def test_clouds_in_other_units_look_alike(unit):
    """No plane of the camera cuts a cloud in millimetres away."""
    cloud = ball()
    other = cloud._replace(means=cloud.means * unit, log_scales=cloud.log_scales + math.log(unit))
    ours, theirs = (
        simplify.look(each, simplify.views_around(each, 6, 48)) for each in (cloud, other)
    )
    assert simplify.psnr(theirs, ours) > 60


def test_a_cloud_that_shows_nothing_is_refused(tmp_path, capsys):
    write_gaussians(
        tmp_path / "in.ply", ball()._replace(logit_opacities=torch.full((600,), -20.0)).arrays()
    )
    assert (
        prune.main([str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--psnr", "40", *FAST])
        == 2
    )
    assert "none of the 600 Gaussians is to be seen" in capsys.readouterr().err


def test_ctrl_c_leaves_nothing_behind(source, tmp_path, monkeypatch, capsys):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(simplify, "recover", interrupted)
    assert prune.main([str(source), str(tmp_path / "out.ply"), "--count", "300", *FAST]) == 130
    assert "stopped" in capsys.readouterr().err and [path.name for path in tmp_path.iterdir()] == [
        "in.ply"
    ]


def test_a_checkpoint_without_gaussians_is_refused(tmp_path, capsys):
    torch.save({"state_dict": {"weight": torch.zeros(3)}}, tmp_path / "a.ckpt")
    assert prune.main([str(tmp_path / "a.ckpt"), str(tmp_path / "out.ply"), "--count", "9"]) == 2
    assert "holds no cloud of Gaussians" in capsys.readouterr().err


def test_a_compact_file_is_written_within_its_size_and_read_again(source, tmp_path):
    report = run(source, tmp_path / "out.spz", "--bytes", "7kB")
    assert (
        6_600 < (tmp_path / "out.spz").stat().st_size == report["after"]["bytes"] <= 7_000
        and report["after"]["gaussians"] > 300
    )
    assert 900 < run(source, tmp_path / "small.spz", "--bytes", "1kB")["after"]["bytes"] <= 1_000
    assert (
        run(tmp_path / "out.spz", tmp_path / "again.spz", "--count", "200")["after"]["gaussians"]
        == 200
    )
    assert read_cloud(str(tmp_path / "again.spz")).up == "y"


def test_a_quality_holds_in_the_compact_file(source, tmp_path):
    report = run(source, tmp_path / "once.spz", "--psnr", "32")
    assert report["after"]["gaussians"] < 450 and report["psnr_on_unseen_views"] > 31.5
    run(tmp_path / "once.spz", tmp_path / "twice.spz", "--psnr", "32")
    assert (
        len(read_cloud(str(tmp_path / "twice.spz")).gaussians.means) == report["after"]["gaussians"]
    )


def test_colours_beyond_the_compact_formats_reach_are_fitted_within_it(tmp_path):
    cloud = ball()
    cloud.sh[::7] *= 12  # thin ones, which others hide in part
    cloud.logit_opacities[::7] = -1
    write_gaussians(tmp_path / "in.ply", cloud.arrays())
    assert float(cloud.sh.abs().max()) > 2 * prune.COLOR_REACH
    source = read_cloud(str(tmp_path / "in.ply"))
    reports = []
    for steps in ("1", "60"):
        path = str(tmp_path / f"{steps}.spz")
        reports.append(
            prune.run(
                prune.parse(
                    [
                        str(tmp_path / "in.ply"),
                        path,
                        "--count",
                        "600",
                        "--size",
                        "48",
                        "--steps",
                        steps,
                    ]
                )
            )
        )
    assert len(source.gaussians.means) == reports[1]["after"]["gaussians"] == 600
    assert reports[1]["psnr_on_unseen_views"] > reports[0]["psnr_on_unseen_views"] + 1


def test_views_turn_with_the_axes_of_the_file(tmp_path):
    source = tmp_path / "in.ply"
    write_gaussians(source, ball().arrays())
    views = {
        up: prune.views_of(read_cloud(str(source), up=up), prune.PruneOptions(size=48))[0]
        for up in ("z", "y", "-y")
    }
    top = {"z": 2, "y": 1, "-y": 1}
    heights = {up: views[up].positions[:, top[up]] * (-1 if up == "-y" else 1) for up in views}
    assert torch.allclose(heights["z"], heights["y"], atol=0.05) and torch.allclose(
        heights["y"], heights["-y"], atol=0.05
    )
    assert heights["z"].max() > 1 > -1 > heights["z"].min()


def test_a_count_above_what_is_there_changes_nothing(source, tmp_path):
    assert run(source, tmp_path / "out.ply", "--count", "1000")["after"]["gaussians"] == 600


def test_the_likeness_that_loses_a_tenth_of_a_decibel():
    # two independent errors: their squares add
    likeness = prune.likeness_within(0.1, 35.0)
    assert 10 ** (-3.5) + 10 ** (-likeness / 10) == pytest.approx(10 ** (-3.49))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--count", "0"], "--count: expected a whole number from 1 on"),
        (["--count", "1.5"], "--count: expected a whole number"),
        (["--count", "many"], "--count: expected a number, got 'many'"),
        (["--bytes", "2 potatoes"], "--bytes: expected a size such as"),
        (["--bytes", "1"], "--bytes: 1 are too few for one Gaussian, which takes"),
        (["--psnr", "nan"], "--psnr: expected a number"),
        (["--psnr", "-3"], "--psnr: expected a number above 0"),
        (["--within", "0"], "--within: expected a loss from 0.001 to 30 dB, got 0"),
        (["--within", "5000"], "--within: expected a loss"),
        (["--within", "0.1", "--quality", "nan"], "--quality: expected a number"),
    ],
)
def test_a_wrong_budget_is_refused_before_any_work(source, tmp_path, capsys, options, said):
    assert prune.main([str(source), str(tmp_path / "out.ply"), *options]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out.ply").exists()


def test_a_missing_file_and_a_wrong_name(source, tmp_path, capsys):
    assert prune.main([str(tmp_path / "im.ply"), str(tmp_path / "out.ply"), "--count", "9"]) == 2
    assert "in.ply" in capsys.readouterr().err  # the near name
    assert prune.main([str(source), str(tmp_path / "out.obj"), "--count", "9"]) == 2
    assert "expected the name of a .ply or .spz file" in capsys.readouterr().err


def test_a_folder_in_the_place_of_the_output_costs_no_work(source, tmp_path, capsys, monkeypatch):
    monkeypatch.delattr(prune, "read")
    (tmp_path / "out.ply").mkdir()
    assert prune.main([str(source), str(tmp_path / "out.ply"), "--count", "9"]) == 2
    assert "out.ply' can't be written" in capsys.readouterr().err


@pytest.mark.parametrize("ending", ["", ".json", ".png"])
def test_a_folder_in_the_way_of_any_output_costs_no_work(
    source, tmp_path, capsys, monkeypatch, ending
):
    monkeypatch.delattr(prune, "read")
    (tmp_path / f"out.ply{ending}").mkdir()
    assert prune.main([str(source), str(tmp_path / "out.ply"), "--count", "9"]) == 2
    found = capsys.readouterr().err
    assert found.startswith(f"error: OUT{ending}:") and "it is a folder" in found


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a\0b.ply", "OUT: "),
        ("x" * 300 + ".ply", "OUT: "),
        ("x" * 249 + ".ply", "OUT.json: "),
        ("none/out.ply", "OUT: there is no folder"),
        ("in.ply/out.ply", "OUT: there is no folder"),
    ],
)
def test_names_that_no_file_can_have_cost_no_work(
    source, tmp_path, capsys, monkeypatch, name, said
):
    monkeypatch.delattr(prune, "read")
    assert prune.main([str(source), f"{tmp_path}/{name}", "--count", "9"]) == 2
    found = capsys.readouterr().err
    assert found.startswith(f"error: {said}") and len(found) < 400 and len(found.splitlines()) == 1


def test_the_report_replaces_a_link_and_does_not_follow_it(source, tmp_path):
    (tmp_path / "precious").write_text("precious")
    for ending in (".json", ".png"):
        (tmp_path / f"out.ply{ending}").symlink_to(tmp_path / "precious")
    run(source, tmp_path / "out.ply", "--count", "600")
    assert (tmp_path / "precious").read_text() == "precious"
    assert json.loads((tmp_path / "out.ply.json").read_text())["after"]["gaussians"] == 600


def test_a_report_that_cannot_be_written_leaves_the_earlier_one(source, tmp_path, monkeypatch):
    run(source, tmp_path / "out.ply", "--count", "600")
    earlier = (tmp_path / "out.ply.json").read_text()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="No space left"):
        prune.write_report(
            str(tmp_path / "out.ply"),
            prune.Pruned(*[read_cloud(str(source))] * 2, 0.0),
            ".ply",
            prune.PruneOptions(size=48),
        )
    assert (tmp_path / "out.ply.json").read_text() == earlier


@pytest.mark.parametrize("log_scale", [40.0, 80.0, 200.0])
def test_scales_too_large_to_render_are_named(tmp_path, capsys, log_scale):
    cloud = ball()
    cloud.log_scales[:] = log_scale
    write_raw_gaussians(tmp_path / "in.ply", cloud.arrays())
    assert prune.main([str(tmp_path / "in.ply"), str(tmp_path / "o.ply"), "--count", "9"]) == 2
    found = capsys.readouterr().err
    assert "the largest scale is" in found and "near" not in found


def test_a_budget_is_needed_and_only_one(source, tmp_path, capsys):
    assert prune.main([str(source), "out.ply"]) == 2
    assert prune.main([str(source), "out.ply", "--count", "5", "--psnr", "40"]) == 2


def test_any_quality_ends_the_search():
    apart = ball(12)._replace(
        logit_opacities=torch.full((12,), 6.0), log_scales=torch.full((12, 3), -3.0)
    )
    probes, judges = (simplify.views_around(apart, 8, 48, turn=turn) for turn in (0.0, 45.0))
    assert len(simplify.simplify(apart, probes, judges, Budget(psnr=1.0), steps=2).means) == 1
    assert len(simplify.simplify(apart, probes, judges, Budget(psnr=99.0), steps=2).means) == 12


@pytest.mark.parametrize("bearable", [1.0, 1 / 16, 0.0])
def test_a_recovery_makes_nothing_worse(monkeypatch, bearable):
    """It is done anew at smaller rates, and left out where none is small enough."""
    cloud, paces = ball(), []
    probes, judges = (
        simplify.views_around(cloud, count, 48, turn=turn) for count, turn in ((16, 0.0), (8, 45.0))
    )

    def recover(cloud, views, pictures, steps, seed, sh_reach, pace):
        paces.append(pace)
        return cloud if pace <= bearable else cloud._replace(sh=cloud.sh + 1)

    monkeypatch.setattr(simplify, "recover", recover)
    monkeypatch.setattr(
        simplify, "merge_duplicates", lambda values, at_least: SimpleNamespace(values=values)
    )
    found = simplify.simplify(
        cloud, probes, judges, simplify.Budget(count=len(cloud.means) - 20), steps=1
    )
    kept = simplify.only(cloud, simplify.worth(cloud, probes), len(cloud.means) - 20)
    assert all(torch.equal(a, b) for a, b in zip(found, kept, strict=True))
    assert paces == [pace for pace in simplify.PACES if pace >= bearable]


def test_a_recovery_begins_near_the_pace_of_the_one_before(monkeypatch):
    cloud, paces, bearable = ball(), [], iter([1 / 16] * 5 + [1.0] * 3)
    probes, judges = (
        simplify.views_around(cloud, count, 32, turn=turn) for count, turn in ((8, 0.0), (4, 45.0))
    )

    def recover(cloud, views, pictures, steps, seed, sh_reach, pace):
        paces.append(pace)
        return cloud if pace <= next(bearable) else cloud._replace(sh=cloud.sh + 1)

    monkeypatch.setattr(simplify, "recover", recover)
    monkeypatch.setattr(
        simplify, "merge_duplicates", lambda values, at_least: SimpleNamespace(values=values)
    )
    simplify.simplify(cloud, probes, judges, simplify.Budget(count=200), steps=1)
    assert paces == [1, 1 / 4, 1 / 16, 1 / 4, 1 / 16, 1 / 4, 1, 1]


def test_a_round_that_failed_is_not_tried_again(monkeypatch):
    """Below a hundred Gaussians a round of one can't become smaller."""
    cloud, tried = ball()._replace(), []
    few = simplify.only(cloud, torch.arange(600.0), 20)
    recover = simplify.recover
    monkeypatch.setattr(
        simplify,
        "recover",
        lambda cloud, *rest: tried.append(len(cloud.means)) or recover(cloud, *rest),
    )
    probes, judges = (simplify.views_around(few, 8, 32, turn=turn) for turn in (0.0, 45.0))
    assert (
        len(simplify.simplify(few, probes, judges, simplify.Budget(psnr=99.0), steps=2).means) == 20
    )
    assert len(tried) <= 5 * len(simplify.PACES) and tried.count(19) <= len(simplify.PACES)


def test_grey_gaussians_are_not_lost_before_grey():
    cloud = ball()
    cloud.sh[::2] = 0.0
    kept = simplify.only(cloud, simplify.worth(cloud, simplify.views_around(cloud, 16, 48)), 300)
    outside = kept.means.norm(dim=1) > 0.9
    grey = (kept.sh == 0).all(-1)[:, 0] & outside
    assert 0.3 < grey.double().sum() / outside.double().sum() < 0.7
