"""Damaged files, prompts, extensions and signals give one message."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch

from tests.helpers.checkpoints import whole_checkpoint
from tests.launch.bad_input_cases import DEMO, SMALL, assert_refused
from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.images import read as read_image
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.training import held_out as evaluate
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()


TRIAL = Path("outputs/demo/t")


# -- files -----------------------------------------------------------------------------------------

PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty "
    b"float z\nend_header\n"
)


FILES = {
    "empty.glb": b"",
    "text.glb": b"hello there, this is no mesh",
    "empty.obj": b"# nothing\n",
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "flat.obj": b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "mesh.yaml": b"a: 1\n",
}


@pytest.mark.parametrize("name", ["missing.glb", "", *FILES])
def test_an_invalid_mesh_is_refused(launch_demo, name):
    if name in FILES:
        Path(name).write_bytes(FILES[name])
    code, err = launch_demo(f"system.guidance.mesh={name}")
    assert_refused(code, err, name or "path")


@pytest.mark.parametrize(
    "prior", ["gaussians-prior", "point-cloud-prior", "mesh-prior", "body-prior"]
)
@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"hello",
        b"ply\nformat asc",
        PLY + b"nan nan nan\n",
        PLY + b"a b c\n",
        PLY.replace(b" 1\n", b" 99999999999\n"),
    ],
)
def test_a_file_that_no_prior_can_read_is_refused(tmp_path, prior, content):
    path = tmp_path / "start.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match="start.ply|PointCloudPrior"):
        host.find(prior)({"path": str(path)})("a fox")


def checkpoint(**changes: object) -> dict:
    lightnings = {"pytorch-lightning_version": "2.0.0", "loops": {}, "optimizer_states": []}
    return {"state_dict": {}, "epoch": 0, "global_step": 1, **lightnings, **changes}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (checkpoint(state_dict=[1]), "its state_dict is of type list"),
        (checkpoint(global_step=None), "its global_step is of type NoneType"),
        (
            {k: v for k, v in checkpoint().items() if k != "pytorch-lightning_version"},
            "which Lightning writes",
        ),
        (
            whole_checkpoint() | {"state_dict": {"other": torch.ones(3)}},
            "was made by another configuration",
        ),
        (checkpoint(loops={"x": 1}), "its loops have no fit_loop"),
        (checkpoint(optimizer=os.system), "could run code when read, so it isn't read: "),
    ],
)
def test_a_foreign_checkpoint_is_refused(launch_demo, content, message):
    torch.save(content, "foreign.ckpt")
    # the loops are for training alone
    for stage in ("--train",) if content.get("loops") else ("--train", "--export"):
        code, err = launch_demo("resume=foreign.ckpt", stage=stage)
        assert_refused(code, err, message)
        assert "weights_only" not in err  # torch's advice to read it all the same


def test_a_damaged_score_file_is_measured_again(tmp_path):
    for content in (b"{bro", b"\xff", b"[1]"):
        (tmp_path / "metrics.json").write_bytes(content)
        assert evaluate.Measurements(None, tmp_path).values == {}


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\nxx"])
def test_a_damaged_picture_of_an_earlier_run_is_left_out(tmp_path, content):
    (tmp_path / "held_out").mkdir()
    (tmp_path / "held_out/prior.png").write_bytes(content)
    images = torch.rand(6, 4, 4, 3)
    evaluate.Measurements(None, tmp_path)._save_pictures("result", images, images)
    assert read_image(tmp_path / "held_out/compare.png").shape == (8, 24, 3)


def test_a_fifo_in_the_place_of_a_file_is_named(launch_demo):
    """Writing to it would wait for a reader."""
    TRIAL.mkdir(parents=True)
    os.mkfifo(TRIAL / "cmd.txt")
    code, err = launch_demo()
    assert code == 2 and f"{TRIAL}/cmd.txt is no file" in err and "Traceback" not in err


def test_a_file_in_the_place_of_a_folder_is_named(launch_demo):
    TRIAL.mkdir(parents=True)
    (TRIAL / "save").touch()
    code, err = launch_demo()
    assert code == 2 and f"{TRIAL}/save is no folder" in err and "Traceback" not in err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: !!python/object/apply:os.system ['touch pwned']", "isn't valid YAML"),
        (b"\x89PNG\r\n\x1a\n", "can't be read"),
        (b"a:\n\tb: 1", "line 2, column 1"),
        (b"name: a\nname: b", "duplicate key"),
        (b"", "data_type is empty"),
        (b"system: []", "system is a list in one and a section in another"),
        (b"seed: " + 5000 * b"9", "isn't valid YAML: Exceeds the limit"),
        (b"#" * (1 << 21), "the configuration bad.yaml is larger than 1 MiB"),
        (b"data: [1, 2]", "data is a list in one and a section in another"),
    ],
)
def test_an_invalid_configuration_is_refused(launch_demo, content, message):
    Path("bad.yaml").write_bytes(content)
    assert_refused(*launch_demo(config="bad.yaml"), message)
    assert not Path("pwned").exists()


# -- prompts ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "prompt", ["1984", "a fox: red", "${x}", "../../x", "-x", "🦊" * 1000, "two\nlines", " "]
)
def test_a_prompt_arrives_verbatim_and_stays_in_the_output_root(launch_demo, prompt):
    tagged_by_the_prompt = [option for option in SMALL if not option.startswith("tag=")]
    options = [
        *tagged_by_the_prompt,
        f"system.prompt_processor.prompt={prompt}",
        "trainer.max_steps=0",
        "data.n_test_views=1",
    ]
    assert experiment.main(["--config", str(DEMO), "--train", "--gpu", "cpu", *options]) == 0
    assert os.listdir() == ["outputs"]
    (parsed,) = Path("outputs").glob("demo/*/configs/parsed.yaml")
    assert load_config(parsed).system.prompt_processor.prompt == prompt


# -- extensions and signals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = '\0'", "null bytes"),
        ("def f(:", "custom/part.py:1: invalid syntax"),
        ("import nothing", "custom/part.py:1: ModuleNotFoundError"),
    ],
)
def test_an_extension_that_fails_is_named(launch_demo, source, message):
    Path("custom").mkdir()
    Path("custom/part.py").write_text(source)
    code, err = launch_demo()
    assert_refused(code, err, message)
    assert "custom/part.py" in err


def test_a_signal_while_the_test_views_are_rendered_leaves_a_checkpoint_and_prints_the_command(
    launch_demo, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        patch.setattr(
            GaussianDreamerSystem, "test_step", lambda *args: os.kill(os.getpid(), signal.SIGINT)
        )
        code = experiment.main(["--config", str(DEMO), "--train", "--gpu", "cpu", *SMALL])
    out = capsys.readouterr().out
    last = TRIAL / "ckpts" / "last.ckpt"
    assert code == 130 and "to resume: " in out and f"resume={last.absolute()}" in out
    shutil.rmtree(TRIAL / "save")
    assert launch_demo(f"resume={last}")[0] == 0
    assert (TRIAL / "save" / "it2-export" / "gaussians.ply").is_file()


@pytest.mark.parametrize(
    ("option", "change"),
    [
        ("system.geometry.sh_degree=1", "system.geometry.sh_degree was 0, now it is 1"),
        ("system.background.mode=learned", "system.background.mode was 'random', now it is"),
    ],
)
def test_a_resumed_run_with_tensors_of_other_sizes_names_the_option(launch_demo, option, change):
    assert launch_demo()[0] == 0
    code, err = launch_demo(f"resume={TRIAL}/ckpts/last.ckpt", "trainer.max_steps=3", option)
    assert code == 2 and f"was made by another configuration: {change}" in err
    assert "size mismatch" not in err and "Missing key" not in err


# -- runs that meet --------------------------------------------------------------------------------


def test_a_run_that_is_resumed_at_its_end_is_measured(launch_demo):
    """Also if the scores are missing: in another folder, or because the first run was killed before
    it wrote them.
    """
    assert launch_demo()[0] == 0
    code, err = launch_demo(f"resume={TRIAL}/ckpts/last.ckpt", "tag=other")
    assert code == 0 and "nothing is left to train" in err
    first, other = (
        json.loads((folder / "save/metrics.json").read_text())["result"]
        for folder in (TRIAL, TRIAL.with_name("other"))
    )
    assert (other["step"], other["psnr"]) == (first["step"], first["psnr"])


def test_the_last_checkpoint_resumes_if_the_others_have_weights_only(launch_demo):
    assert launch_demo("checkpoint.save_weights_only=true")[0] == 0
    assert "optimizer_states" in load_checkpoint(TRIAL / "ckpts/last.ckpt")
    (other,) = (path for path in (TRIAL / "ckpts").iterdir() if path.name != "last.ckpt")
    message = "has no optimizer_states, which Lightning writes unless checkpoint.save_weights_only"
    code, err = launch_demo(f"resume={other}")
    assert code == 2 and message in err


def test_a_checkpoint_of_another_optimiser_is_named(launch_demo):
    assert launch_demo("trainer.max_steps=1")[0] == 0
    last = f"resume={TRIAL}/ckpts/last.ckpt"
    code, err = launch_demo(last, "system.optimizer.name=SGD")
    assert "is of another run: system.optimizer.name was 'Adam', now it is 'SGD'" in err
    assert code == 2 and "SGD can't resume from its optimizer_states, which may be another" in err


def test_a_closed_pipe_gives_no_traceback(monkeypatch, capsys):
    closed = []
    monkeypatch.setattr(
        experiment, "run", lambda *args: (_ for _ in ()).throw(BrokenPipeError(32, "Broken pipe"))
    )
    monkeypatch.setattr(os, "dup2", lambda _, to: closed.append(to))
    assert experiment.main(["--config", str(DEMO), "--train"]) == 128 + signal.SIGPIPE
    assert closed == [1] and "the reader of the output has closed it" in capsys.readouterr().err
