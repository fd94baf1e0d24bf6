"""What parts need from outside is checked with all of their options, before any long work."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.files import existing_file
from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.system import preflight_parts

register_parts()


@register("test-weights-guidance")
class WeightsGuidance(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        weights: str = "missing.bin"

    @classmethod
    def preflight(cls, cfg):
        existing_file(cfg.weights, "weights")


@register("test-instance-preflight-guidance")
class InstancePreflight(WeightsGuidance):
    def preflight(self):
        """Take no options."""


def check(guidance_type, guidance=(), prompts="plain-prompt-processor", **prior):
    options = {"prompt_processor_type": prompts, "prompt_processor": {}}
    cfg = options | {"guidance_type": guidance_type, "guidance": dict(guidance)}
    preflight_parts(GaussianCloud(prior), SimpleNamespace(**cfg))


def test_a_guidance_gets_options_that_are_not_given_before_any_folder_is_made(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="^system.guidance: weights 'missing.bin' does not exist"):
        check("test-weights-guidance", prompts="gaussiandreamer-stable-diffusion-prompt-processor")
    assert not [*tmp_path.iterdir()]


def test_a_preflight_of_another_kind_is_named():
    with pytest.raises(UserError, match="InstancePreflight.preflight needs @classmethod"):
        check("test-instance-preflight-guidance")


@pytest.mark.parametrize(
    ("mesh", "message"),
    [("no.glb", "mesh 'no.glb' does not exist"), (__file__, "unknown mesh format of")],
)
def test_the_mesh_of_a_guidance_is_checked(mesh, message):
    with pytest.raises(UserError, match=f"^system.guidance: {message}"):
        check("exact-score-guidance", {"mesh": mesh})


def test_the_prior_is_checked_first():
    with pytest.raises(UserError, match="^system.geometry.prior: mesh 'no.glb' does not exist"):
        check("test-weights-guidance", prior_type="mesh-prior", prior={"path": "no.glb"})
