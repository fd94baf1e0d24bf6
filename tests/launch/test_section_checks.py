"""Options of different sections that contradict each other."""

from pathlib import Path

import pytest

from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_shared_views

CONFIGS = Path(__file__).parents[2] / "configs"
PERP_NEG = "system.prompt_processor.use_perp_neg=true"
LATENT = "system.guidance.space=latent"


def check(names, *overrides):
    register_parts()
    paths = [CONFIGS / f"{name}.yaml" for name in names]
    given = ["system.prompt_processor.prompt=a fox"] if "demo" not in names else []
    check_config(load_config(*paths, cli_args=[*given, *overrides]))


MVDREAM = ("gaussiandreamer", "gaussiandreamer-mvdream")
WRONG = [
    (MVDREAM, ["data.n_view=2"], "data.n_view: the guidance sees 4 views"),
    (MVDREAM, [PERP_NEG], "this guidance has one prompt for all"),
    (
        ("gaussiandreamer",),
        [PERP_NEG, "system.guidance.view_dependent_prompting=false"],
        "set system.guidance.view_dependent_prompting=true",
    ),
    (("toybox",), [PERP_NEG], "or system.guidance.view_contrast=0"),
    (
        ("gaussiandreamer",),
        ["system.prompt_processor_type=plain-prompt-processor", "system.prompt_processor={}"],
        "needs a prompt processor that encodes text",
    ),
    (("demo",), (LATENT, "data.height=250"), "pictures of 250x256 can't be pooled"),
    (("demo",), (LATENT, "data.width=[256,250]", "data.resolution_milestones=[9]"), "256x250"),
    (("demo",), (LATENT, "system.renderer.downsample=2", "data.height=280"), "of 140x128"),
    (("demo",), (LATENT, "system.guidance.image_size=64", "data.width=252"), "of 64x63"),
    (("demo",), ("system.guidance.mode=view-agnostic", "data.height=4096"), "needs .* GiB"),
]


@pytest.mark.parametrize(("names", "overrides", "message"), WRONG)
def test_contradictions_are_named(names, overrides, message):
    with pytest.raises(UserError, match=message):
        check(names, *overrides)


@pytest.mark.parametrize(
    ("names", "overrides"),
    [
        (("toybox",), [PERP_NEG, "system.guidance.view_contrast=0"]),
        (("demo",), [LATENT, "data.height=512", "system.renderer.downsample=2"]),
        (("demo",), ["data.height=250"]),
        (MVDREAM, []),
    ],
)
def test_valid_combinations_pass(names, overrides):
    check(names, *overrides)


@pytest.mark.parametrize(
    ("batch", "processes", "message"),
    [
        ("4", 3, "data.batch_size is 4, no multiple of the 3 processes"),
        ("[8,2]", 4, "data.batch_size is 2, fewer than the 4 processes"),
    ],
)
def test_processes_that_cant_share_the_views_are_found_before_they_start(batch, processes, message):
    overrides = [f"data.batch_size={batch}", f"trainer.devices={processes}"]
    if "[" in batch:
        overrides.append("data.resolution_milestones=[9]")
    register_parts()
    cfg = load_config(CONFIGS / "demo.yaml", cli_args=overrides)
    with pytest.raises(UserError, match=message):
        check_shared_views(cfg)
    cfg.n_gpus = 2
    check_shared_views(cfg)
