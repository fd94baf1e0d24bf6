"""Short versions of the scripts; the launcher accepts the configurations of measured runs."""

import itertools
import json
import shutil

import pytest

from benchmarks.quality import avatars, jobs, runs, toybox, toybox_jobs, toybox_options
from benchmarks.robustness import long_run
from benchmarks.splatting import emulated
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config

register_parts()


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
    charts = [list(make()) for make in toybox_options.CHARTS.values()]
    for variant in itertools.chain(*charts, avatars.VARIANTS):
        if variant.name not in (toybox_jobs.SAMPLES, toybox_jobs.TRUTH):
            options = words(toybox.QUICK | variant.options | prompt)
            check_config(load_config(runs.CONFIGS / variant.config, cli_args=options))
