"""The command: what is refused before any work, and the lock of the farm's folder."""

import fcntl
import os
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.launch.cases import DEMO
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm import command, recipe
from threestudio_gaussiandreamer.farm.place import Place
from threestudio_gaussiandreamer.farm.recipe import Recipe, Source, require_same_farm
from threestudio_gaussiandreamer.farm.rows import Row, read_rows

RECIPE = Recipe((Source("a.yaml", b"x: 1"),), ("y=2",), cpu=True, cores=1)


def recipe_of(config, *overrides):
    return Recipe((recipe.read_config(config),), overrides, cpu=True, cores=1)


@pytest.fixture
def farm(tmp_path, monkeypatch, capsys):
    """``farm(text, arguments...)`` runs the command; returns (exit code, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(text, *arguments, name="prompts.txt"):
        (tmp_path / name).write_text(text)
        code = command.main([name, "--config", str(DEMO), *arguments])
        return code, capsys.readouterr().err

    return run


@pytest.fixture
def no_ray(monkeypatch):
    refuse = Mock(side_effect=AssertionError("Ray was started"))
    monkeypatch.setattr(command.driver, "connect", refuse)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("a fox\na fox", [], "lines 1 and 2 have the same name 'a_fox'"),
        ("a fox", ["name=mine"], "name is set by --out: remove 'name=mine'"),
        ("a fox", ["system.prompt_processor.prompt=x"], "set by the prompt list"),
        ("a fox", ["--out", "prompts.txt"], "can't be written"),
        *(("a fox", ["--config", f"{i}.yaml"], "isn't known here: give --out") for i in range(2)),
        ("a fox", ["--out", "held"], "another farm command is at work in"),
        ("a fox", ["--workers", "0"], "--workers: expected 1 or more, got 0"),
        ("a fox", ["--gpus", "-1"], "--gpus"),
        ("a fox", ["--time-limit", "nan"], "--time-limit: expected a number above 0"),
        ("a fox", ["--price", "-2"], "--price"),
    ],
)
def test_bad_input_is_refused_before_ray_starts(farm, no_ray, text, arguments, message):
    for i, root in enumerate(("out/${name}", "???")):  # not known before a run
        Path(f"{i}.yaml").write_text(f"exp_root_dir: {root}")
    Path("held").mkdir()
    descriptor = os.open("held", os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    before = {*os.listdir(), "prompts.txt"}
    code, err = farm(text, *arguments)
    os.close(descriptor)
    assert code == 2 and message in err and "Traceback" not in err
    assert {*os.listdir()} == before


def test_an_address_of_the_environment_is_named_as_such(monkeypatch):
    pytest.importorskip("ray")
    said = {"http://127.0.0.1:8265": "expected host:port", "127.0.0.1:1": ".*refused"}
    for address in said:
        monkeypatch.setenv("RAY_ADDRESS", address)
        pattern = rf"^RAY_ADDRESS {address}: no Ray .*\({said[address]}.*`unset RAY_ADDRESS`"
        with pytest.raises(UserError, match=pattern):
            command.driver.connect(None)
    with pytest.raises(UserError, match="--address 127.0.0.1:1: no Ray .*leave --address out"):
        command.driver.connect(address)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"pip install 'threestudio-gaussiandreamer\[cluster\]'"):
        command.driver.connect(None)


def test_the_report_and_a_finished_farm_need_no_ray(farm, no_ray, monkeypatch, tmp_path):
    """Nor does a farm of another configuration start Ray to be refused."""
    monkeypatch.setenv("HERE", "s3://bucket")
    (tmp_path / "a.yaml").write_text("exp_root_dir: ${oc.env:HERE}/runs")
    assert recipe.root_of([str(DEMO), str(tmp_path / "a.yaml")]) == "s3://bucket/runs"
    assert recipe.root_of([str(DEMO)]) == "outputs"
    require_same_farm(Place(tmp_path / "runs/farm-prompts"), RECIPE)
    assert farm("a fox", "--report", f"exp_root_dir={tmp_path}/runs")[0] == 0
    assert "waiting" in (tmp_path / "runs/farm-prompts/report/table.csv").read_text()
    arguments = ["--out", "out", "trainer.max_steps=3"]
    place = Place(tmp_path / "out")
    require_same_farm(place, recipe_of(str(DEMO), *arguments[2:]))
    (tmp_path / "prompts.txt").write_text("a fox")
    (row,) = read_rows(tmp_path / "prompts.txt")
    place.publish(row, {"key": row.key})
    assert farm("a fox", *arguments) == (0, "")
    assert (tmp_path / "out/report/table.csv").is_file()
    code, err = farm("a fox", *arguments[:2], "trainer.max_steps=4")
    assert code == 2 and "belongs to another farm: its overrides is" in err
    with pytest.raises(AssertionError, match="Ray was started"):
        farm("a fox\na cat", *arguments)
    code, err = farm('{"prompt": "a cat", "name": "a_fox"}', *arguments, name="prompts.jsonl")
    assert code == 2 and "line 1 of the prompt list: 'a_fox' was begun in this farm with" in err
    monkeypatch.setattr(command, "make_assets", lambda *args: None)
    assert farm("a fox\na cat", *arguments) == (1, "")  # something is left to do


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"overrides": ("trainer.max_steps=-3",)}, "line 3 of the prompt list: trainer.max_steps"),
        ({"config": ("nothing.yaml",)}, "line 3 .*unknown configuration 'nothing.yaml'"),
        # also in rows beyond those of which the whole configuration is checked
        ({"overrides": ("resume=x.ckpt",)}, "line 3 of the prompt list: resume is set by the farm"),
    ],
)
def test_an_error_in_a_rows_configuration_names_its_line(monkeypatch, options, message):
    if "resume" in message:
        monkeypatch.setattr("threestudio_gaussiandreamer.farm.recipe.MOST_CHECKS", 1)
    with pytest.raises(ValueError, match=message):
        rows = [Row("fox", "a fox"), Row("cat", "a cat", line=3, **options)]
        recipe.check_recipe(recipe_of(str(DEMO)), rows)


def test_the_low_memory_configuration_is_used_where_it_is_valid():
    row = [Row("fox", "a fox")]
    demo, paper = recipe_of(str(DEMO)), recipe_of("gaussiandreamer.yaml")
    assert recipe.check_recipe(demo, row).low_memory is None  # its guidance has no such options
    assert recipe.check_recipe(paper, row).low_memory.name.endswith("gaussiandreamer-lowmem.yaml")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (RECIPE._replace(sources=(Source("a.yaml", b"x: 2"),)), "its configurations is"),
        (RECIPE._replace(overrides=("y=3",)), 'its overrides is \\["y=2"\\], here \\["y=3"\\]'),
        (RECIPE._replace(cores=2), "its cores is 1, here 2"),
        (RECIPE._replace(cpu=False), 'its device is "cpu", here "gpu"'),
    ],
)
def test_a_folder_of_another_farm_is_refused(tmp_path, other, message):
    moved = (Source("elsewhere/a.yaml", b"x: 1"),)
    for same in (RECIPE, RECIPE._replace(sources=moved)):
        require_same_farm(Place(tmp_path), same)
    with pytest.raises(ValueError, match=f"belongs to another farm: {message}"):
        require_same_farm(Place(tmp_path), other)
