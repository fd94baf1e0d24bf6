"""Variants of score distillation, and of the weights' files, with all kinds of models."""

import shutil
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch

from tests.guidance import test_mvdream
from tests.helpers import tiny_large_guidance as tiny
from tests.helpers.tiny_guidance import relative, renders
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import variants

pytest.importorskip("diffusers")
DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16}
NO_LORA = {"stable-diffusion-3": "is a transformer", "mvdream": "predicts several together"}


def ring():
    """Return four views around the object, and what the renderer gives of them."""
    depth, opacity = torch.full((4, 16, 16, 1), 2.0), torch.ones(4, 16, 16, 1)
    return test_mvdream.ring() | {"depth": depth, "opacity": opacity, "fovy": torch.ones(4)}


VARIANTS = [module.name for module in iter_modules(variants.__path__) if module.name != "base"]


@pytest.mark.parametrize(
    "kind, variant",
    [
        *(("stable-diffusion", variant) for variant in VARIANTS),
        ("stable-diffusion-xl", "sdi"),
        ("stable-diffusion-3", "cfd"),
        ("mvdream", "nfsd"),
    ],
)
def test_variants_give_a_gradient(large, prompts, kind, variant):
    """Of Stable Diffusion with Perp-Neg."""
    folder, prompt_utils = large(kind)
    prompt_utils = prompts[True] if kind == "stable-diffusion" else prompt_utils
    guide = tiny.guidance(kind, folder, guidance_scale=7.5, variant_type=f"{variant}-variant")
    plain = tiny.guidance(kind, folder, guidance_scale=7.5)
    plain, _ = tiny.gradient(plain, prompt_utils, renders(), **ring())
    grad, out = tiny.gradient(guide, prompt_utils, renders(), **ring())
    assert grad.isfinite().all() and (grad != 0).float().mean() > 0.9 and out["bad_items"] == 0
    assert torch.allclose(grad, plain) == (variant == "sds") and out["evaluations"] >= 8


def test_several_views_together_have_an_empty_prompt_with_their_cameras(large):
    folder, prompt_utils = large("mvdream")
    guide = tiny.guidance("mvdream", folder, variant_type="nfsd-variant")
    condition = guide.condition(prompt_utils, **ring())
    negative = condition.embeddings[4:]
    assert condition.empty.shape == negative.shape and not torch.equal(condition.empty, negative)
    z, t = torch.randn(4, 4, 8, 8), torch.full((4,), 600)
    assert not torch.allclose(
        guide.empty_prompt(z, t, condition), guide.unconditional(z, t, condition)
    )
    rows = torch.tensor([2, 0])
    assert torch.equal(condition.select(rows).empty, condition.empty[rows])


@pytest.mark.parametrize("kind", ["stable-diffusion-xl", *NO_LORA])
def test_a_lora_is_trained_in_unets_of_single_views(large, kind):
    folder, prompt_utils = large(kind)
    options = {"pretrained_model_name_or_path": str(folder), "variant_type": "vsd-variant"}
    if kind in NO_LORA:
        part = type(tiny.guidance(kind, folder))
        with pytest.raises(UserError, match=f"vsd-variant trains a LoRA .*{NO_LORA[kind]}"):
            part.preflight(options)
    else:
        guide = tiny.guidance(kind, folder, variant_type="vsd-variant")
        for option in ("enable_torch_compile", "enable_sequential_cpu_offload"):
            with pytest.raises(UserError, match=f"system.guidance.{option}: vsd-variant trains"):
                guide.preflight(options | {option: True})
        grad, out = tiny.gradient(guide, prompt_utils, renders(), **ring())
        assert grad.isfinite().all() and grad.any() and out["bad_items"] == 0


@pytest.mark.parametrize(
    "kind, variant, named",
    [
        ("stable-diffusion-xl", "fp16", True),
        ("stable-diffusion-3", "bf16", True),
        ("mvdream", "fp16", False),
    ],
)
def test_models_published_in_half_precision_only(large, kind, variant, named, tmp_path):
    """With the precision in the files' names, or without."""
    from safetensors.torch import load_file, save_file

    folder, prompts = large(kind)
    copy = Path(shutil.copytree(folder, tmp_path / "model"))
    for path in copy.rglob("*.safetensors"):
        tensors = {
            name: value.to(DTYPES[variant]) if value.is_floating_point() else value
            for name, value in load_file(path).items()
        }
        path.unlink()
        new = path.with_name(f"{path.stem}.{variant}.safetensors") if named else path
        save_file(tensors, new, metadata={"format": "pt"})
    full, half = (
        tiny.gradient(tiny.guidance(kind, model), prompts, renders(), **ring())[0]
        for model in (folder, copy)
    )
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert 0 < relative(half, full.double()) < (0.1 if variant == "fp16" else 0.5)
