"""The configurations of the benchmarks' runs: each is accepted by the launcher."""

import itertools

import pytest
from omegaconf import OmegaConf

from benchmarks.quality import jobs, runs, toybox, toybox_options
from benchmarks.quality.toybox_jobs import SAMPLES, TRUTH
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config

register_parts()
JOBS = list(itertools.chain.from_iterable(make() for make in jobs.JOBS.values()))
TOYBOX = [
    variant
    for variant in itertools.chain.from_iterable(make() for make in toybox_options.CHARTS.values())
    if variant.name not in (SAMPLES, TRUTH)
]


def words(options):
    return [f"{key}={value}" for key, value in options.items()]


@pytest.mark.parametrize("job", JOBS, ids=lambda job: f"{job.chart}-{job.variant}-{job.x:g}")
def test_the_options_of_every_chart_are_accepted(job):
    check_config(load_config(*runs.configs_of(job.overlay), cli_args=words(job.options)))


@pytest.mark.parametrize("variant", TOYBOX, ids=lambda variant: variant.name)
def test_the_options_of_every_run_with_learned_models_are_accepted(variant):
    prompt = {"system.prompt_processor.prompt": "a red fox"}
    options = words(toybox.QUICK | variant.options | prompt)
    check_config(load_config(runs.ROOT / "configs/toybox.yaml", cli_args=options))


def test_the_demos_variants_run_for_as_many_steps_as_their_configurations():
    for overlay, steps in jobs.DEMOS.values():
        parts = [OmegaConf.load(path) for path in runs.configs_of(overlay)]
        assert OmegaConf.merge(*parts).trainer.max_steps == steps
