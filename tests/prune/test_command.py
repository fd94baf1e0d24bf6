"""The prune command: budgets are met on unseen views, a second run changes nothing, and wrong
options are rejected before any work.
"""

import json

import pytest
import torch

from tests.helpers.ply_files import write_raw_gaussians
from tests.helpers.pruning import FAST, ball, run
from threestudio_gaussiandreamer.formats.gaussian_files import PRUNED, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.ply import read_comments, read_gaussians, write_gaussians
from threestudio_gaussiandreamer.gaussians import recover
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
from threestudio_gaussiandreamer.host import get_device
from threestudio_gaussiandreamer.prune import PruneOptions
from threestudio_gaussiandreamer.prune import command as prune
from threestudio_gaussiandreamer.prune.pipeline import views_of


def test_a_cloud_trained_antialiased_is_measured_and_written_so(source, tmp_path):
    stored = read_cloud(str(source))._replace(antialiased=True)
    write_cloud(str(tmp_path / "mip.ply"), stored)
    run(tmp_path / "mip.ply", tmp_path / "out.spz", "--count", "250")
    assert json.loads((tmp_path / "out.spz.json").read_text())["options"]["antialias"] is True
    assert read_cloud(str(tmp_path / "out.spz")).antialiased
    run(source, tmp_path / "plain.ply", "--count", "250")
    assert json.loads((tmp_path / "plain.ply.json").read_text())["options"]["antialias"] is False


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


def test_a_count_that_changes_nothing_keeps_the_note(source, tmp_path):
    once = run(source, tmp_path / "once.ply", "--psnr", "32")["after"]["gaussians"]
    run(tmp_path / "once.ply", tmp_path / "same.ply", "--count", str(once))
    run(source, tmp_path / "whole.ply", "--count", "600")
    assert read_cloud(str(tmp_path / "same.ply")).pruned_to == 32
    assert read_cloud(str(tmp_path / "whole.ply")).pruned_to is None


@pytest.mark.parametrize("budget", [("--count", "150"), ("--bytes", "12kB")])
def test_what_pruning_to_a_count_or_size_has_lost_counts_towards_a_later_quality(
    source, tmp_path, budget
):
    """Against the original, which the later runs don't see."""
    run(source, tmp_path / "fewer.ply", *budget)
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
    assert run(source, tmp_path / "fine.ply", "--psnr", "30")["met"]
    report = run(source, tmp_path / "out.spz", "--psnr", "90")
    assert (
        not report["met"]
        and report["after"]["gaussians"] == 600
        and "the budget isn't met" in caplog.text
    )
    assert 30 < read_cloud(str(tmp_path / "out.spz")).pruned_to < 80  # what the format has cost
    assert run(source, tmp_path / "out.ply", "--psnr", "120")["met"]


def test_a_stricter_budget_than_what_is_spent_is_not_met(source, tmp_path, capsys):
    run(source, tmp_path / "once.ply", "--psnr", "30")
    report = run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "45")
    assert not report["met"] and "has been pruned to 30 dB before" in capsys.readouterr().out
    assert read_cloud(str(tmp_path / "twice.ply")).pruned_to == 30


def test_the_input_is_not_overwritten(source, tmp_path, capsys):
    before = source.read_bytes()
    assert prune.main([str(source), str(source), "--count", "10"]) == 2
    assert "OUT is IN" in capsys.readouterr().err and source.read_bytes() == before


def test_a_looser_budget_prunes_further(source, tmp_path):
    run(source, tmp_path / "once.ply", "--psnr", "55")
    assert run(tmp_path / "once.ply", tmp_path / "twice.ply", "--psnr", "40")["after"][
        "gaussians"
    ] < len(read_gaussians(tmp_path / "once.ply").means)


def test_the_same_call_gives_the_same_bits(source, tmp_path):
    for name in ("a.ply", "b.ply"):
        run(source, tmp_path / name, "--count", "300")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_cloud_that_shows_nothing_is_refused(tmp_path, capsys):
    write_gaussians(
        tmp_path / "in.ply", ball()._replace(logit_opacities=torch.full((600,), -20.0)).arrays()
    )
    assert (
        prune.main([str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--psnr", "40", *FAST])
        == 2
    )
    assert "none of the 600 Gaussians is visible in any view" in capsys.readouterr().err


def test_ctrl_c_leaves_nothing_behind(source, tmp_path, monkeypatch, capsys):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(recover, "recover", interrupted)
    assert prune.main([str(source), str(tmp_path / "out.ply"), "--count", "300", *FAST]) == 130
    assert "stopped" in capsys.readouterr().err and [path.name for path in tmp_path.iterdir()] == [
        "in.ply"
    ]


def test_a_checkpoint_without_gaussians_is_refused(tmp_path, capsys):
    torch.save({"state_dict": {"weight": torch.zeros(3)}}, tmp_path / "a.ckpt")
    assert prune.main([str(tmp_path / "a.ckpt"), str(tmp_path / "out.ply"), "--count", "9"]) == 2
    assert "holds no cloud of Gaussians" in capsys.readouterr().err


def test_a_count_above_what_is_there_changes_nothing(source, tmp_path):
    assert run(source, tmp_path / "out.ply", "--count", "1000")["after"]["gaussians"] == 600


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
        (["--within", "0", "--quality", "35"], "--within: expected a loss from 0.001 to 30 dB, "),
        (["--within", "5000", "--quality", "35"], "--within: expected a loss"),
        (["--within", "0.1"], "--within: give quality (--quality) too, the PSNR of the"),
        (["--count", "9", "--quality", "35"], "--quality: has no effect without the budget within"),
        (["--within", "0.1", "--quality", "nan"], "--quality: expected a finite number"),
    ],
)
def test_a_wrong_budget_is_refused_before_any_work(source, tmp_path, capsys, options, said):
    assert prune.main([str(source), str(tmp_path / "out.ply"), *options]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out.ply").exists()


def test_an_input_name_that_is_too_long(source, tmp_path, capsys):
    assert prune.main([f"{tmp_path}/{'x' * 300}.ply", str(source), "--count", "9"]) == 2
    assert "not a usable file name" in capsys.readouterr().err


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
