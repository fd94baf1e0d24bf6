"""Whole runs with variants of score distillation, stopped and resumed."""

import pytest
import torch

from tests.helpers import tiny_models
from tests.helpers.guidance_runs import assert_resumes, checkpoint, config, diffusion, run

NOISES = {
    "system.guidance.mode": "direction-bins",
    "system.guidance.space": "latent",
    "system.guidance.latent_size": 8,
    "system.guidance.bank_views": 12,
    "system.guidance.guidance_scale": 7.5,
}
"""An exact score in which the noise doesn't cancel."""


def options(variant, **more):
    chosen = NOISES | {"system.guidance.variant_type": variant} | more
    return [f"{key}={value}" for key, value in chosen.items()]


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["vsd-variant", "sdi-variant", "cfd-variant"])
def test_a_run_with_the_exact_score_resumes_as_if_it_had_never_stopped(tmp_path, variant):
    found = assert_resumes(config(tmp_path / "run.yaml"), tmp_path, *options(variant))
    moments = {name for name in found if name.startswith("/guidance")}
    expected = {"mean", "square", "weight"} if variant == "vsd-variant" else set()
    assert moments == {f"/guidance/{name}" for name in expected}


@pytest.mark.slow
def test_a_lora_resumes_as_if_it_had_never_stopped(tmp_path, monkeypatch):
    pytest.importorskip("diffusers")
    monkeypatch.chdir(tmp_path)
    model = tiny_models.stable_diffusion(tmp_path / "model")
    path = config(tmp_path / "run.yaml", **diffusion(model))
    found = assert_resumes(path, tmp_path, "system.guidance.variant_type=vsd-variant")
    assert any(name.startswith("/guidance/up.") for name in found)
    assert any(name.startswith("/guidance/exp_avg_sq.") for name in found)
    assert all(value.isfinite().all() for value in found.values())


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["nfsd-variant", "vsd-variant", "cfd-variant"])
def test_a_run_with_a_tiny_deep_floyd(tmp_path, monkeypatch, variant):
    pytest.importorskip("diffusers")
    monkeypatch.chdir(tmp_path)
    model = tiny_models.deep_floyd(tmp_path / "model")
    path = config(tmp_path / "run.yaml", **diffusion(model, family="deep-floyd"))
    assert run(path, tmp_path, f"system.guidance.variant_type={variant}") == 0
    assert torch.isfinite(checkpoint(tmp_path)["state_dict"]["geometry.means"]).all()


def test_a_variant_that_cannot_work_ends_the_run_before_the_prior(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "threestudio_gaussiandreamer.priors.random.RandomPrior.generate",
        lambda *args: pytest.fail("ran the prior"),
    )
    blind = {"system.guidance.mode": "view-agnostic"}
    path = config(tmp_path / "run.yaml")
    assert run(path, tmp_path, *options("csd-variant", **blind)) == 2
    assert "csd-variant follows the difference" in capsys.readouterr().err
    assert run(path, tmp_path, *options("csd-varient")) == 2
    printed = capsys.readouterr().err
    assert "system.guidance.variant_type" in printed and "'csd-variant'" in printed
