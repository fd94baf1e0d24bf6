"""Helpers of the Shap-E tests."""

import torch

from threestudio_gaussiandreamer.priors.shap_e import ShapEPrior

FAST = {"num_inference_steps": 2, "grid_size": 24}


CPU = torch.device("cpu")


def make(folder, **options):
    return ShapEPrior(FAST | {"model": str(folder)} | options)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)
