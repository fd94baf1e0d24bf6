"""``mock-guidance`` and ``smoke.yaml``: every stage of a run without weights."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.helpers.tiny_runs import files
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import find, names
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.experiment import main
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


def test_descent_ends_in_a_disc_on_the_background():
    guidance = find("mock-guidance")({"guidance_scale": 1.0, "weighting_strategy": "uniform"})
    rgb = torch.full((2, 8, 8, 3), 0.5)
    for step in range(200):
        guidance.update_step(0, step)
        rgb = rgb - 0.05 * gradient(guidance, rgb, "a fox")
    assert torch.allclose(rgb[:, 0, 0], torch.tensor(0.25), atol=0.03)
    color = rgb[0, 4, 4]
    assert (color - 0.25).abs().max() > 0.1 and torch.allclose(rgb[0], rgb[1], atol=1e-3)


# the noise of cfd-variant is attached to the surface, for which it needs a renderer's depth
VARIANTS = {name for name in names() if name.endswith("-variant") and "test" not in name}
VARIANTS -= {"cfd-variant"}


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_it_works_with_every_variant(name):
    guidance = find("mock-guidance")({"variant_type": name})
    grad = gradient(guidance, torch.full((2, 8, 8, 3), 0.5), "a fox")
    assert grad.isfinite().all()


def test_it_takes_the_place_of_stable_diffusion():
    overrides = ["system.guidance_type=mock-guidance", "system.prompt_processor.prompt=a fox"]
    cfg = load_config(find_config("gaussiandreamer.yaml"), cli_args=overrides)
    check_config(cfg)
    assert cfg.system.guidance.guidance_scale > 1
    assert "view_dependent_prompting" not in cfg.system.guidance


def test_smoke_yaml_runs_every_stage_on_any_prompt(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("prompt.txt").write_text("ein Würfel: 1/2 $5 ${x}")
    options = ["--gpu", "cpu", "system.prompt_processor.prompt_file=prompt.txt"]
    options += ["use_timestamp=false", "tag=t"]
    assert main(["--config", "smoke.yaml", "--train", *options]) == 0
    exports = {f"save/it8-export/gaussians.{suffix}" for suffix in ("ply", "spz")}
    pictures = {"save/it8-0.png", "save/it8-test/1.png", "index.html"}
    expected = exports | pictures | {"ckpts/last.ckpt", "save/prior/points.npz"}
    assert files(Path("outputs/smoke/t")) >= expected
    assert main(["--config", "smoke.yaml", "--export", *options, "resume=auto"]) == 0
