"""``mock-guidance``: gradients without weights."""

from types import SimpleNamespace

import torch

from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.options import find_config

register_parts()


def batch(views=2, size=8):
    return {
        "azimuth": torch.linspace(-90, 90, views),
        "height": size,
        "width": size,
        "comp_rgb_bg": torch.full((views, 1, 1, 3), 0.25),
    }


def gradient(guidance, rgb, prompt):
    rgb = rgb.clone().requires_grad_()
    out = guidance(rgb, SimpleNamespace(prompt=prompt), **batch(*rgb.shape[:2]))
    out["loss_sds"].backward()
    return rgb.grad


def test_the_gradient_is_a_function_of_step_render_and_prompt():
    rgb = torch.full((2, 8, 8, 3), 0.5)
    fox, again, ball = (
        gradient(find("mock-guidance")({}), rgb, prompt) for prompt in ("a fox", "a fox", "a ball")
    )
    assert torch.equal(fox, again) and not torch.equal(fox, ball)


def test_it_takes_the_place_of_stable_diffusion():
    overrides = ["system.guidance_type=mock-guidance", "system.prompt_processor.prompt=a fox"]
    cfg = load_config(find_config("gaussiandreamer.yaml"), cli_args=overrides)
    check_config(cfg)
    assert cfg.system.guidance.guidance_scale > 1
    assert "view_dependent_prompting" not in cfg.system.guidance
