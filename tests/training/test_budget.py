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
def test_auto_says_what_it_measured(tmp_path, painted_box, capsys, known):
    """The loss against the ground truth; without one, the PSNR between the renders before and
    after.
    """
    options = [
        "system.geometry.budget=auto",
        "system.geometry.min_gaussians=20",
        "trainer.max_steps=6",
        "trainer.val_check_interval=6",
    ]
    options += [
        f"system.geometry.prune.{rule}"
        for rule in ("start=0", "stop=6", "every=2", "quality=60", "likeness=1")
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
    said = [line for line in "".join(capsys.readouterr()).splitlines() if "Gaussians; dB" in line]
    measured = r"lost -?[\d.e-]+, affordable 30" if known else r"likeness [\d.]+, asked_for 1"
    pattern = r"step (2|4): (\d+) -> (\d+) Gaussians; dB on the views of this step: " + measured
    rounds = [re.search(pattern, line) for line in said]
    assert len(rounds) == 2 and all(int(found[3]) == int(0.8 * int(found[2])) for found in rounds)
    rows = list(
        csv.DictReader(open(run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv"))
    )
    assert any(row.get("prune/lost" if known else "prune/likeness") for row in rows)


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
        r"instead of 0.8"
    )
    assert re.search(told, "".join(capsys.readouterr()))
    assert len(cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")["geometry.means"]) == 70
