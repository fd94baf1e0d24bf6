"""Runs under a budget: their messages, and the number of Gaussians at the end."""

import csv
import re

import pytest

from tests.training.runs import CONFIGS, PRUNE, SMALL, cloud_of, launch, mocked_config, run_folder
from threestudio_gaussiandreamer.launch.experiment import main


@pytest.mark.slow
def test_a_budget_without_remaining_rounds_gives_a_warning(tmp_path, painted_box, capsys):
    """Also if a run is resumed after its rounds."""
    steps = ["trainer.max_steps=7", "trainer.val_check_interval=7"]
    assert launch(tmp_path, painted_box, *PRUNE, *steps) == 0
    assert "no round of pruning" not in "".join(capsys.readouterr())
    resume = f"resume={run_folder(tmp_path) / 'ckpts' / 'last.ckpt'}"
    options = [
        *PRUNE,
        "system.geometry.budget=100",
        "trainer.max_steps=9",
        "trainer.val_check_interval=9",
    ]
    assert launch(tmp_path, painted_box, *options, resume) == 0
    assert "no round of pruning remains, so 130 Gaussians are kept instead of 100" in "".join(
        capsys.readouterr()
    )


@pytest.mark.parametrize("known", [True, False])
def test_auto_says_what_more_would_gain(tmp_path, painted_box, capsys, known):
    """In each round, and at the end of the run; also without a ground truth."""
    options = [
        "system.geometry.budget=auto",
        "system.geometry.min_gaussians=20",
        "trainer.max_steps=6",
        "trainer.val_check_interval=6",
    ]
    options += [
        f"system.geometry.prune.{rule}"
        for rule in ("start=2", "stop=6", "every=2", "gain=5.9", "likeness=1")
    ]
    config = CONFIGS / "demo.yaml" if known else mocked_config(tmp_path, painted_box)
    options += [f"system.guidance.mesh={painted_box}"] if known else []
    assert (
        main(
            [
                "--config",
                str(config),
                "--train",
                "--gpu",
                "cpu",
                f"exp_root_dir={tmp_path}",
                *SMALL,
                *options,
            ]
        )
        == 0
    )
    said = "".join(capsys.readouterr())
    rounds = re.findall(r"step (2|4): (\d+) -> (\d+) Gaussians: .* would (gain|lose) \d", said)
    assert len(rounds) == 2 and all(int(now) <= int(before) for _, before, now, _ in rounds)
    assert re.search(rf"{int(rounds[1][2]):,} of [\d,]+ Gaussians: twice as many would gain", said)
    rows = csv.DictReader(open(run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv"))
    assert any(row.get("prune/gain") for row in rows)


def test_a_budget_that_needs_larger_rounds_is_met_with_a_message(tmp_path, painted_box, capsys):
    options = [
        *PRUNE,
        "system.geometry.budget=70",
        "trainer.max_steps=8",
        "trainer.val_check_interval=8",
    ]
    assert launch(tmp_path, painted_box, *options) == 0
    told = (
        r"2 rounds of pruning must reduce \d+ Gaussians to 70: each keeps 0.[56]\d "
        r"instead of 0.75"
    )
    assert re.search(told, "".join(capsys.readouterr()))
    assert len(cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")["geometry.means"]) == 70
