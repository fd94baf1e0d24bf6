"""Every command without the optional dependencies: one message that names the extra."""

import re
import sys
from importlib import import_module, metadata
from pathlib import Path

import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.core.extras import error_of_extra, extras
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud

PROMPT = "system.prompt_processor.prompt=a red fox"
COMMANDS = [
    ("toybox.demo", ["a red fox"], "diffusion"),
    ("evaluation.scorecard", ["run", "--metrics", "clip", "--clip", "run"], "diffusion"),
    ("launch.experiment", ["--config", "toybox.yaml", "--train", PROMPT], "diffusion"),
    ("farm.command", ["prompts.txt", "--config", "demo.yaml"], "cluster"),
    ("convert.command", ["cloud.ply", "object.glb"], "mesh"),
]


@pytest.fixture
def without_extras(monkeypatch):
    # not s3fs, which Lightning imports where its distribution is installed
    names = set().union(*extras().values()) - {"s3fs"}
    for name in list(sys.modules):
        if name.partition(".")[0] in names:
            monkeypatch.delitem(sys.modules, name)

    class Blocker:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in names:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(sys, "meta_path", [Blocker(), *sys.meta_path])


@pytest.mark.parametrize(
    ("module", "extra"),
    [("pxr", "usd"), ("anny", "body"), ("skimage.measure", "mesh"), ("tokenizers", "diffusion")],
)
def test_the_extra_of_a_module_is_that_of_pyproject_toml(module, extra, monkeypatch):
    """As the metadata of an installed package has it."""
    text = Path(__file__).parents[2].joinpath("pyproject.toml").read_text(encoding="utf-8")
    lists = re.search(r"\[project.optional-dependencies\]\n(.*?)\n\n", text, re.DOTALL)[1]
    requirements = [
        f'{requirement}; extra == "{name}"'
        for name, found in re.findall(r"^([\w-]+) = \[(.*)\]", lists, re.MULTILINE)
        for requirement in re.findall(r'"([^"]+)"', found)
    ]
    monkeypatch.setattr(metadata, "requires", lambda name: requirements)
    error = error_of_extra(ModuleNotFoundError(f"No module named {module!r}", name=module))
    assert f"[{extra}]'" in str(error)
    assert error_of_extra(ModuleNotFoundError("No module named 'pytest'", name="pytest")) is None


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
