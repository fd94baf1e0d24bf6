"""Every command without the optional dependencies: one message that names the extra."""

import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.core.extras import EXTRAS
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud

PROMPT = "system.prompt_processor.prompt=a red fox"
COMMANDS = [
    ("toybox.demo", ["a red fox"], "diffusion"),
    ("toybox.train", ["work"], "diffusion"),
    ("toybox.export", ["work", "models"], "diffusion"),
    ("evaluation.scorecard", ["run", "--metrics", "clip", "--clip", "run"], "diffusion"),
    (
        "evaluation.clip_similarity",
        ["--clip", "run", "--prompt", "a fox", "cloud.ply"],
        "diffusion",
    ),
    ("launch.experiment", ["--config", "toybox.yaml", "--train", PROMPT], "diffusion"),
    ("farm.command", ["prompts.txt", "--config", "demo.yaml"], "cluster"),
    ("convert.command", ["cloud.ply", "object.glb"], "mesh"),
]


@pytest.fixture
def without_extras(monkeypatch):
    # not s3fs, which Lightning imports where its distribution is installed
    names = {name for modules in EXTRAS.values() for name in modules.split()} - {"s3fs"}
    for name in list(sys.modules):
        if name.partition(".")[0] in names:
            monkeypatch.delitem(sys.modules, name)

    class Blocker:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in names:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(sys, "meta_path", [Blocker(), *sys.meta_path])


@pytest.mark.parametrize(("module", "arguments", "extra"), COMMANDS)
def test_a_command_names_the_extra_that_it_needs(
    module, arguments, extra, without_extras, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    Path("prompts.txt").write_text("a fox\n")
    write_cloud("cloud.ply", StoredCloud(ball(50)))
    main = import_module(f"threestudio_gaussiandreamer.{module}").main
    assert main(arguments) == 2
    error = capfd.readouterr().err
    assert error.count("error: ") == 1
    assert f"pip install 'threestudio-gaussiandreamer[{extra}]'" in error
