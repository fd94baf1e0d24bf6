"""A small cloud with hidden Gaussians, and the prune command in its fastest settings."""

import torch

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.prune import command

FAST = ["--size", "48", "--steps", "8"]


def ball(count=600, bands=1):
    """Return a coloured ball of thin shells, whose inside is hidden."""
    rng = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    means *= torch.where(torch.arange(count) % 3 == 0, 0.5, 1.0)[:, None]
    sh = torch.zeros(count, bands, 3)
    sh[:, 0] = means
    quats = torch.randn(count, 4, generator=rng)
    return Gaussians(means, quats, torch.full((count, 3), -2.2), torch.full((count,), 3.0), sh)


def run(source, output, *options):
    """Run the command; return its report."""
    return command.run(command.parse([str(source), str(output), *options, *FAST]))
