"""Helpers of the tests of the launcher."""

from pathlib import Path

from threestudio_gaussiandreamer.launch.config import load_config

DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
SMALL = [
    "data.width=16", "data.height=16", "data.eval_width=16", "data.eval_height=16",
    "data.n_test_views=2", "data.train_views=4", "system.geometry.prior.num_points=80",
    "system.geometry.prior.color_smoothing=0", "system.geometry.grow.num_candidates=200",
    "system.evaluation.size=16", "system.evaluation.views=2", "trainer.enable_progress_bar=false",
    "trainer.max_steps=2", "use_timestamp=false", "tag=t",
]  # fmt: skip


def assert_refused(code: int, err: str, message: str) -> None:
    """Assert one message, no traceback, nothing written, and that the prior hasn't run."""
    assert code == 2 and "Traceback" not in err and not Path("outputs").exists(), err
    assert message in err and sum(line.startswith("error: ") for line in err.splitlines()) == 1
    assert "the cloud starts" not in err


def load(*overrides: str):
    return load_config("tiny.yaml", cli_args=overrides)
