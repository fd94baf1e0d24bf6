"""The configurations of the charts' runs."""

from omegaconf import OmegaConf

from benchmarks.quality import jobs, runs
from benchmarks.quality.recipe import CONFIGS, RECIPE, recipe


def test_a_run_takes_the_base_recipe_unless_it_names_a_configuration():
    demo = CONFIGS / "demo.yaml"
    assert runs.configs_of(None) == [demo, RECIPE]
    assert runs.configs_of("") == [demo]
    assert runs.configs_of("demo-draft") == [demo, CONFIGS / "demo-draft.yaml"]


def test_the_recipe_lies_over_the_demo_and_has_the_steps_and_rates_of_the_jobs():
    found, demo = recipe(), OmegaConf.load(CONFIGS / "demo.yaml")
    assert found["trainer"]["max_steps"] == jobs.STEPS
    assert found["system"]["renderer"]["preset"] == demo.system.renderer.preset
    for name, (first, last) in jobs.RATES.items():
        assert found["system"]["geometry"][name] == [0, first, last, jobs.STEPS]


def test_the_demos_variants_run_for_as_many_steps_as_their_configurations():
    for overlay, steps in jobs.DEMOS.values():
        parts = [OmegaConf.load(path) for path in runs.configs_of(overlay)]
        assert OmegaConf.merge(*parts).trainer.max_steps == steps
