"""Damaged files give one message."""

import json
from pathlib import Path

import torch

from tests.launch.cases import assert_refused
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint
from threestudio_gaussiandreamer.images import read as read_image
from threestudio_gaussiandreamer.training import held_out as evaluate

register_parts()
TRIAL = Path("outputs/demo/t")


def test_an_invalid_mesh_is_refused(launch_demo):
    Path("text.glb").write_bytes(b"hello there, this is no mesh")
    assert_refused(*launch_demo("system.guidance.mesh=text.glb"), "text.glb")


def test_damaged_results_of_an_earlier_run_are_made_again(tmp_path):
    for content in (b"{bro", b"\xff", b"[1]"):
        (tmp_path / "metrics.json").write_bytes(content)
        assert evaluate.Measurements(None, tmp_path).values == {}
    (tmp_path / "held_out").mkdir()
    for content in (b"", b"\x89PNG\r\n\x1a\nxx"):
        (tmp_path / "held_out/prior.png").write_bytes(content)
        images = torch.rand(6, 4, 4, 3)
        evaluate.Measurements(None, tmp_path)._save_pictures("result", images, images)
        assert read_image(tmp_path / "held_out/compare.png").shape == (8, 24, 3)


def test_what_a_finished_run_can_be_resumed_with(launch_demo):
    """At its end it is measured, also if the scores are missing: in another folder, or because the
    first run was killed before it wrote them.
    """
    assert launch_demo("checkpoint.save_weights_only=true")[0] == 0
    last = f"resume={TRIAL}/ckpts/last.ckpt"
    code, err = launch_demo(last, "tag=other")
    assert code == 0 and "nothing is left to train" in err
    first, other = (
        json.loads((folder / "save/metrics.json").read_text())["result"]
        for folder in (TRIAL, TRIAL.with_name("other"))
    )
    assert (other["step"], other["psnr"]) == (first["step"], first["psnr"])

    assert "optimizer_states" in load_checkpoint(TRIAL / "ckpts/last.ckpt")
    (weights,) = (path for path in (TRIAL / "ckpts").iterdir() if path.name != "last.ckpt")
    code, err = launch_demo(f"resume={weights}", "trainer.max_steps=3")
    message = "has no optimizer_states, which Lightning writes unless checkpoint.save_weights_only"
    assert code == 2 and message in err

    code, err = launch_demo(last, "system.optimizer.name=SGD", "trainer.max_steps=3")
    assert "is of another run: system.optimizer.name was 'Adam', now it is 'SGD'" in err
    assert code == 2 and "SGD can't resume from its optimizer_states, which may be another" in err
