"""Helpers of the rasteriser tests."""

import torch

BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
