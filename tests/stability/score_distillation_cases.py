"""Helpers of the score distillation tests."""

import torch

from threestudio_gaussiandreamer.cameras import Orbit


def orbit(*views) -> Orbit:
    elevation, azimuth, distance, fovy = torch.tensor(views).T
    return Orbit(elevation, azimuth, distance, torch.deg2rad(fovy))
