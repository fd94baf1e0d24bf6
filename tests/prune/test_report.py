"""The report is written completely or not at all."""

import errno
import json
import os

import pytest

from tests.helpers.pruning import run
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.prune import PruneOptions
from threestudio_gaussiandreamer.prune.pipeline import PruneResult
from threestudio_gaussiandreamer.prune.report import write_report


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
        write_report(
            str(tmp_path / "out.ply"),
            PruneResult(*[read_cloud(str(source))] * 2, 0.0),
            ".ply",
            PruneOptions(size=48),
        )
    assert (tmp_path / "out.ply.json").read_text() == earlier


def test_the_report_says_what_a_pruned_cloud_is_compared_with(source, tmp_path, capsys):
    """Pruned once, a file is no longer the original."""
    once, twice = (str(tmp_path / name) for name in ("once.ply", "twice.ply"))
    run(source, once, "--psnr", "30")
    assert "dB to the original, on the test views" in capsys.readouterr().out
    run(once, twice, "--psnr", "25")
    assert "dB to the input, which had been pruned before" in capsys.readouterr().out
