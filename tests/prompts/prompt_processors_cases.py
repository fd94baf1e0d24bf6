"""Helpers of the prompt processor tests."""

from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401


def processor(models, kind="stable-diffusion", **options):
    options = {
        "prompt": "a fox",
        "negative_prompt": "ugly",
        "pretrained_model_name_or_path": str(models[kind]),
        **options,
    }
    return find(f"gaussiandreamer-{kind}-prompt-processor")(options)
