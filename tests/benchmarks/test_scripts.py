"""Short versions of the scripts: charts, the kernel for ARM, a killed run, and configurations of
measured runs, each of which the launcher accepts.
"""

import importlib
import json
import re
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from benchmarks.quality import jobs, runs, toybox, toybox_options
from benchmarks.quality.toybox_jobs import SAMPLES, TRUTH
from benchmarks.robustness import long_run
from benchmarks.splatting import emulated
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

register_parts()


@pytest.mark.slow
@pytest.mark.skipif(bool(cpu.unavailable()), reason="the kernel isn't built")
def test_make_charts_draws_every_chart(monkeypatch):
    pytest.importorskip("matplotlib")
    drawn, makefile = set(), (runs.ROOT / "Makefile").read_text()
    recipe = re.search(r"^charts:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    save = lambda self, path, **_: drawn.add(Path(path))  # noqa: E731
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)
    for module, arguments in re.findall(r"python -m (\S+)(.*)", recipe[1]):
        monkeypatch.setattr("sys.argv", [module, *arguments.split()])
        importlib.import_module(module).main()
    assert drawn == set(runs.CHARTS.glob("*.png"))


@pytest.mark.slow
def test_the_kernel_for_arm_draws_the_same_in_emulation():
    for tool in (emulated.COMPILER, emulated.EMULATOR):
        if shutil.which(tool) is None:
            pytest.skip(f"needs {tool}")
    assert emulated.main() == 0


@pytest.mark.slow
def test_a_killed_run_ends_with_the_state_of_an_uninterrupted_one(tmp_path, capsys):
    short = "--steps 160 --kills 2 --every 20 --minutes 8".split()
    code = long_run.main([*short, "--out", str(tmp_path / "out.json")])
    result = json.loads((tmp_path / "out.json").read_text())
    assert code == 0 and result["holds"], capsys.readouterr().out
    assert result["kills"] == 2 and result["final_step"] == 160 and result["same_final_state"]
    assert result["written_steps_lost"] == result["half_written_files"] == 0


def words(options):
    return [f"{key}={value}" for key, value in options.items()]


def test_the_options_of_every_chart_are_accepted():
    for make in jobs.JOBS.values():
        for job in make():
            check_config(load_config(*runs.configs_of(job.overlay), cli_args=words(job.options)))
    prompt = {"system.prompt_processor.prompt": "a red fox"}
    for make in toybox_options.CHARTS.values():
        for variant in make():
            if variant.name not in (SAMPLES, TRUTH):
                options = words(toybox.QUICK | variant.options | prompt)
                check_config(load_config(runs.ROOT / "configs/toybox.yaml", cli_args=options))


def test_the_demos_variants_run_for_as_many_steps_as_their_configurations():
    for overlay, steps in jobs.DEMOS.values():
        parts = [OmegaConf.load(path) for path in runs.configs_of(overlay)]
        assert OmegaConf.merge(*parts).trainer.max_steps == steps
