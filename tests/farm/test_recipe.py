"""What one asset is made with, and what a run has made."""

import shlex

from threestudio_gaussiandreamer.farm import recipe
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import digest
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.options import find_config, parse_arguments

RECIPE = Recipe((Source("a.yaml", b""),), ("x=1",), cpu=True, cores=2)
JOB = Job(Row("fox", "a fox's tail", 7, ("demo.yaml",), ("y=2",)), (Source("demo.yaml", b""),))


def test_a_row_comes_after_the_farm_and_the_prompt_last():
    args = parse_arguments(recipe.launch_arguments(RECIPE, JOB, ["1.yaml"], "tag=fox"))
    assert args.config == ["1.yaml"] and args.stage == "train" and args.gpu == "cpu"
    chosen = ["x=1", "y=2", "seed=7", "system.prompt_processor.prompt=a fox's tail", "tag=fox"]
    assert args.overrides == chosen


def test_the_command_that_repeats_an_asset_has_its_prompt_threads_and_configurations(tmp_path):
    words = shlex.split(recipe.repeat_command(RECIPE, JOB))
    assert words[0] == "OMP_NUM_THREADS=2" and "demo.yaml" in words
    assert "launch.py" not in words  # this process wasn't started by it
    assert "system.prompt_processor.prompt=a fox's tail" in words and "low.yaml" not in words
    saving = RECIPE._replace(low_memory=Source("low.yaml", b""))
    job = JOB._replace(saves_memory=True)
    names = [source.name for source in recipe.all_sources(saving, job)]
    assert names == ["a.yaml", "demo.yaml", "low.yaml"]
    assert "low.yaml" in recipe.repeat_command(saving, job)
    # of a farm on S3 the command can be run too
    (tmp_path / "s3.yaml").write_text("exp_root_dir: s3://bucket/runs")
    sources = tuple(map(recipe.read_config, ("demo.yaml", str(tmp_path / "s3.yaml"))))
    farm = RECIPE._replace(sources=sources, overrides=())
    words = shlex.split(recipe.repeat_command(farm, Job(Row("fox", "a fox"))))
    args = parse_arguments(words[words.index("--config") :])
    cfg = load_config(*map(find_config, args.config), cli_args=args.overrides)
    check_config(cfg)
    assert cfg.exp_root_dir == "outputs"


def test_the_digest_is_of_names_and_contents(tmp_path):
    folder = tmp_path / "save" / "it5-export"
    folder.mkdir(parents=True)
    digests = set()
    for name, content in (("a.ply", b"1"), ("a.ply", b"2"), ("b.spz", b"2")):
        (folder / name).write_bytes(content)
        digests.add(digest(tmp_path))
    (folder / "report.json").write_text("seconds")
    (folder / "pruned").mkdir()
    assert len(digests) == 3 and digest(tmp_path) in digests
