"""A run whose budget is found, towards the colour of a mock guidance."""

import csv
import re

from tests.training.runs import SMALL, cloud_of, length, mocked_config, run_folder
from threestudio_gaussiandreamer.launch.experiment import main


def test_auto_says_what_more_would_gain_and_a_background_is_learned(tmp_path, painted_box, capsys):
    """In each round, and at the end of the run; here without a ground truth."""
    options = ["budget=auto", "min_gaussians=20"]
    options += [f"prune.{x}" for x in "start=2 stop=6 every=2 gain=5.9 likeness=1".split()]
    options = [f"system.geometry.{option}" for option in options]
    options += [f"exp_root_dir={tmp_path}", *length(6)]
    background = {"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": 0.1}
    config = mocked_config(tmp_path, painted_box, background=background)
    assert main(["--config", str(config), "--train", "--gpu", "cpu", *SMALL, *options]) == 0
    said = "".join(capsys.readouterr())
    assert "budget=auto samples once a step, too rarely in 2 steps a round" in said
    rounds = re.findall(r"step (2|4): (\d+) -> (\d+) Gaussians: .* would (gain|lose) \d", said)
    assert len(rounds) == 2 and all(int(now) <= int(before) for _, before, now, _ in rounds)
    assert re.search(rf"{int(rounds[1][2]):,} of [\d,]+ Gaussians: twice as many would gain", said)
    rows = csv.DictReader(open(run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv"))
    assert any(row.get("prune/gain") for row in rows)
    color = cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")["background.logit"].sigmoid()
    assert color[0] > 0.55 and (color[1:] < 0.45).all()  # on its way to the mock's (0.9, 0.2, 0.1)
