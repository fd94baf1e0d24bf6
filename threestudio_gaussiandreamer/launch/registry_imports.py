"""Imports the modules that register parts, or that import those which do."""

from importlib import import_module

MODULES = (
    "training.data",
    "training.background",
    "training.renderer",
    "training.density",
    "training.geometry",
    "priors.mesh",
    "priors.point_cloud",
    "priors.gaussians",
    "priors.random",
    "priors.shap_e",
    "priors.point_e",
    "priors.motion",
    "priors.anny",
    "guidance.exact_score",
    "guidance.mock",
    "guidance.stable_diffusion",
    "guidance.deep_floyd",
    "guidance.mvdream",
    "guidance.stable_diffusion_3",
    "prompts.prompts",
    "prompts.prompt_processors",
    "exporters.files",
    "training.system",
)

for module in MODULES:
    import_module(f"..{module}", __package__)
