"""Families of models are recognised by their network or file names, and refused by name."""

import json

import pytest

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models import hub as families

UNET = {"_class_name": "UNet2DConditionModel", "in_channels": 4}
SETTINGS = {
    families.STABLE_DIFFUSION: UNET,
    families.STABLE_DIFFUSION_XL: UNET | {"addition_embed_type": "text_time"},
    families.STABLE_DIFFUSION_3: {"_class_name": "SD3Transformer2DModel"},
    families.DEEP_FLOYD: UNET | {"in_channels": 3, "addition_embed_type": "text"},
    families.MULTI_VIEW: {"_class_name": "MultiViewUNetModel", "camera_dim": 16, "ip_dim": 0},
}
NAMES = {
    families.STABLE_DIFFUSION: ["unet", "vae", "text_encoder"],
    families.STABLE_DIFFUSION_XL: ["unet", "vae", "text_encoder", "text_encoder_2"],
    families.STABLE_DIFFUSION_3: ["transformer", "vae", "text_encoder_2", "text_encoder_3"],
    families.DEEP_FLOYD: ["unet", "text_encoder"],
    families.MULTI_VIEW: ["unet", "vae", "text_encoder"],
}


def model(folder, settings):
    component = "transformer" if "Transformer" in settings["_class_name"] else "unet"
    (folder / component).mkdir(parents=True)
    (folder / component / "config.json").write_text(json.dumps(settings))
    return folder


@pytest.mark.parametrize("family", families.FAMILIES, ids=lambda family: family.title)
def test_every_family_is_taken_by_its_own_parts_alone(family, tmp_path):
    folder = model(tmp_path / "model", SETTINGS[family])
    names = [f"{component}/config.json" for component in NAMES[family]]
    families.require_family(family, folder)
    families.require_names(family, names)
    by_names = families.STABLE_DIFFUSION if family == families.MULTI_VIEW else family
    for other in set(families.FAMILIES) - {family}:
        said = f"isn't {other.title}, but {family.title}.*gaussiandreamer-{family.parts}-guidance"
        refused(said, families.require_family, other, folder)
        if not {family, other} <= set(families.SAME_FILES):
            with pytest.raises(UserError, match=f"isn't {other.title}, but {by_names.title}"):
                families.require_names(other, names)


def test_models_that_no_guidance_takes_and_settings_that_are_left_to_the_loader(tmp_path):
    image = SETTINGS[families.MULTI_VIEW] | {"ip_dim": 16}
    for settings in ({"_class_name": "FluxTransformer2DModel"}, image):
        folder = model(tmp_path / settings["_class_name"], settings)
        said = f"{settings['_class_name']}, which no guidance takes; those that are taken: Stable"
        refused(said, families.require_family, families.MULTI_VIEW, folder)
    families.require_family(families.STABLE_DIFFUSION, tmp_path)
    (tmp_path / "unet").mkdir()
    for content in ("not json", "[1]"):
        (tmp_path / "unet" / "config.json").write_text(content)
        families.require_family(families.STABLE_DIFFUSION, tmp_path)
    families.require_names(families.STABLE_DIFFUSION, ["README.md", "vae/config.json"])


def test_the_parts_and_configurations_that_messages_name_exist():
    from pathlib import Path

    from threestudio_gaussiandreamer.host import find
    from threestudio_gaussiandreamer.launch import parts  # noqa: F401

    configs = Path(__file__).parents[2] / "configs"
    for family in families.FAMILIES:
        assert find(f"gaussiandreamer-{family.parts}-guidance").family == family
        assert find(f"gaussiandreamer-{family.processor or family.parts}-prompt-processor")
        text = (configs / family.config).read_text()
        assert f"gaussiandreamer-{family.parts}-guidance" in text
