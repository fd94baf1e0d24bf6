"""Every module that registers a part, in the order of the rings; importing this module imports them all."""

from importlib import import_module

MODULES = (
    "data",
    "background",
    "renderer",
    "geometry",
    "priors.mesh",
    "priors.point_cloud",
    "priors.gaussians",
    "priors.random",
    "priors.body",
    "guidance.exact_score",
    "prompts",
    "exporters.ply",
    "exporters.points",
    "exporters.bundle",
    "system",
)

for module in MODULES:
    import_module(f".{module}", __package__)
