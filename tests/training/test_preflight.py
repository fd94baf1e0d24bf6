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


WRONG = {
    "^system.guidance: weights 'missing.bin' does not exist": ("test-weights-guidance", {}),
    "InstancePreflight.preflight needs @classmethod": ("test-instance-preflight-guidance", {}),
    "^system.guidance: mesh 'no.glb' does not exist": ("exact-score-guidance", {"mesh": "no.glb"}),
    "^system.guidance: unknown mesh format of": ("exact-score-guidance", {"mesh": __file__}),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_a_guidance_lacks_is_named_before_any_folder_is_made(message, tmp_path, monkeypatch):
    """Also of options that aren't given, and after what the prior lacks."""
    monkeypatch.chdir(tmp_path)
    prompts = "gaussiandreamer-stable-diffusion-prompt-processor"
    cfg = SimpleNamespace(prompt_processor_type=prompts, prompt_processor={})
    cfg.guidance_type, cfg.guidance = WRONG[message]
    with pytest.raises(UserError, match=message):
        preflight_parts(GaussianCloud({}), cfg)
    if "Instance" not in message:
        cloud = GaussianCloud({"prior_type": "mesh-prior", "prior": {"path": "no.glb"}})
        with pytest.raises(UserError, match="^system.geometry.prior: mesh 'no.glb' does not exi"):
            preflight_parts(cloud, cfg)
    assert not [*tmp_path.iterdir()]
