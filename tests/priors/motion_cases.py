"""Helpers of the motion tests."""

import numpy as np
import torch

from threestudio_gaussiandreamer.priors.smpl_fit import posed_joints


def joints_of(body, pose, shape=None, translation=None):
    shape = torch.zeros(len(pose), 10, dtype=torch.float64) if shape is None else shape
    translation = (
        torch.zeros(len(pose), 3, dtype=torch.float64) if translation is None else translation
    )
    return posed_joints(body, pose, shape, translation).numpy()


def walk(body, frames=6):
    """Return a motion (F, 22, 3): standing, then raising the left knee while turning to
    the left.
    """
    pose = torch.zeros(frames, 24, 3, dtype=torch.float64)
    pose[:, 1, 0] = torch.linspace(0, -1.2, frames)
    pose[:, 4, 0] = torch.linspace(0, 1.0, frames)
    pose[:, 0, 1] = torch.linspace(0, np.pi / 2, frames)
    return joints_of(body, pose)[:, :22]
