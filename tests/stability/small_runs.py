"""Short runs through the launcher, in this process, for the rows about training and files."""

import csv
import io
import json
import os
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch

from tests.helpers.gallery import differences
from threestudio_gaussiandreamer.launch import experiment

EVERY_STEP = ["checkpoint.every_n_train_steps=1", "trainer.max_steps=5"]
DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
SMALL = [
    "data.width=24", "data.height=24", "data.eval_width=24", "data.eval_height=24",
    "data.n_test_views=2", "data.train_views=8", "data.batch_size=2",
    "system.geometry.prior.num_points=120", "system.geometry.prior.color_smoothing=0",
    "system.geometry.grow.num_candidates=2000", "system.geometry.budget=null",
    "system.evaluation.size=16", "system.evaluation.views=2", "system.evaluation.supersample=1",
    "trainer.enable_progress_bar=false", "trainer.log_every_n_steps=1",
    "trainer.limit_val_batches=0", "use_timestamp=false", "tag=t",
]  # fmt: skip


class Ended(NamedTuple):
    out: str
    err: str
    folder: Path
    """The folder of the run."""

    @property
    def last(self) -> Path:
        return self.folder / "ckpts" / "last.ckpt"

    def at_step(self, step: int) -> Path:
        return self.folder / f"ckpts/epoch=0-step={step}.ckpt"

    def checkpoint(self, path: Path | None = None) -> dict[str, Any]:
        return torch.load(path or self.last, weights_only=True, map_location="cpu")

    def metrics(self) -> dict[str, Any]:
        return json.loads((self.folder / "save" / "metrics.json").read_text())

    def logged(self, name: str) -> list[float]:
        """Return the values logged under a name, in order."""
        files = self.folder.glob("csv_logs/version_*/metrics.csv")
        files = sorted(files, key=lambda path: int(path.parent.name.removeprefix("version_")))
        rows = [row for path in files for row in csv.DictReader(open(path))]
        return [float(row[name]) for row in rows if row.get(name)]


def launch(folder: Path, *overrides: str, stage="--train", config: Path = DEMO, code=0) -> Ended:
    """Run the small demo below ``folder``, which ends with ``code``; restore the environment."""
    out, err = io.StringIO(), io.StringIO()
    prior = any(option.startswith("system.geometry.prior_type=") for option in overrides)
    small = [o for o in SMALL if not (prior and o.startswith("system.geometry.prior."))]
    arguments = ["--config", str(config), stage, "--gpu", "cpu", f"exp_root_dir={folder}"]
    with mock.patch.dict(os.environ), redirect_stdout(out), redirect_stderr(err):
        found = experiment.main([*arguments, *small, *overrides])
    assert found == code and "Traceback" not in err.getvalue(), f"{found}: {err.getvalue()}"
    return Ended(out.getvalue(), err.getvalue(), Path(folder) / "demo" / "t")


def refused(folder: Path, *overrides: str, words: Sequence[str], **options: Any) -> Ended:
    """Run, and require exit code 2 and one error message, with these words."""
    ended = launch(folder, *overrides, code=2, **options)
    assert sum(line.startswith("error: ") for line in ended.err.splitlines()) == 1, ended.err
    assert all(word in ended.err for word in words), ended.err
    return ended


def require_equal_ends(measured: Any, one: Ended, other: Ended, what: str) -> None:
    """Measure how many tensors of two runs' last training states differ; fail if any does."""
    differing = differences(one.checkpoint(), other.checkpoint())
    measured(differing, "tensors", what=what, at_most=0)
