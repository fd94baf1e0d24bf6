"""Noise attached to surfaces: standard normal in each view, the same in all views."""

import math

import numpy as np
import torch
import torch.nn.functional as F

from tests.surface.test_fusion import traced
from threestudio_gaussiandreamer.cameras import focal_length, orbit_c2w, surface_points
from threestudio_gaussiandreamer.diffusion import consistent_noise


def ball(azimuths, size):
    """Return depth and opacity of a unit ball at the origin, ray traced, and its cameras."""
    elevation, distance, fovy = torch.tensor([15.0, 3, math.radians(50)]).repeat(len(azimuths), 1).T
    c2w = orbit_c2w(elevation, torch.tensor(azimuths), distance)
    return *(image[..., None] for image in traced(c2w, fovy, size, 1.0)), c2w, fovy


def table(seed=0, channels=4):
    return consistent_noise.cell_values(channels, torch.Generator().manual_seed(seed))


def noise_of(size, table, view, draw=0, first=0):
    return consistent_noise.attached_noise((size, size), table, draw, first, *view)


def test_pixels_are_standard_normal_and_hardly_correlated():
    size, samples = 32, []
    view = ball([20.0], 128)
    for seed in range(200):
        samples.append(noise_of(size, table(seed), view)[0, 0])
    noise = torch.stack(samples)
    # of 200 seeds and 1024 pixels: 5 standard deviations of a mean and of a variance
    assert abs(float(noise.mean())) < 5 / (200 * size**2 / 4) ** 0.5
    assert abs(float(noise.var()) - 1) < 0.03
    neighbours = (noise[:, :, 1:] * noise[:, :, :-1]).mean(0)[8:24, 8:24]
    # two neighbouring pixels share a cell of a lattice with a probability below a quarter
    assert abs(float(neighbours.mean())) < 0.25


def test_near_views_see_the_same_noise_but_on_the_background():
    size, view = 32, ball([0.0, 0.0, 0.5, 90.0], 128)
    noise = noise_of(size, table(), view)
    centre = noise[:, :, 12:20, 12:20].flatten(1)
    correlation = torch.corrcoef(centre)
    assert torch.equal(centre[0], centre[1])
    assert correlation[0, 2] > 0.5 and abs(correlation[0, 3]) < 0.2
    size, view = 32, ball([0.0, 0.0], 128)
    noise, again = noise_of(size, table(), view), noise_of(size, table(), view, draw=7)
    assert torch.equal(noise_of(size, table(), [x[1:] for x in view], first=1)[0], noise[1])
    corner = (slice(None), slice(0, 6), slice(0, 6))
    assert torch.equal(noise[1, :, 16, 16], again[1, :, 16, 16])  # the surface
    for a, b in ((noise[0], noise[1]), (noise[1], again[1])):
        correlation = torch.corrcoef(torch.stack([a[corner].flatten(), b[corner].flatten()]))
        assert abs(float(correlation[0, 1])) < 0.25  # three deviations of 144 numbers
    assert len(noise[0][corner].unique()) == 4 * 6 * 6


def test_cells_are_cubes_of_each_lattice_also_of_renders_that_are_squeezed():
    """The hash by Python's integers; a pixel is the sum of its cells in all lattices."""
    depth, opacity, c2w, fovy = view = ball([30.0, 200.0], 16)
    focal = focal_length(fovy, 16)
    points, size = surface_points(depth[..., 0], c2w, focal), consistent_noise.cell_size(c2w, focal)
    rows = consistent_noise.surface_cells(points, size) % consistent_noise.TABLE
    for lattice, item, y, x in np.ndindex(*rows.shape):
        shift = np.float32(lattice / consistent_noise.LATTICES)
        cell = [int(c) for c in np.floor((points[item, :, y, x] / size[item]).numpy() + shift)]
        expected = sum(c * prime for c, prime in zip(cell, consistent_noise.PRIMES, strict=True))
        expected += lattice * consistent_noise.TABLE // consistent_noise.LATTICES
        assert rows[lattice, item, y, x] == expected % consistent_noise.TABLE
    values = table()
    expected = sum(values[:, row.long()] for row in rows).transpose(0, 1)
    inside = opacity[:, None, :, :, 0] > 0
    torch.testing.assert_close(noise_of(16, values, view) * inside, expected * inside)
    depth, opacity, *cameras = ball([20.0], 96)
    wide = [F.pad(image[..., 0], (96, 96))[..., None] for image in (depth, opacity)]
    squeezed = consistent_noise.attached_noise((32, 32), table(), 0, 0, *wide, *cameras)
    whole = consistent_noise.attached_noise((32, 96), table(), 0, 0, *wide, *cameras)
    inside = wide[1][0, 1::3, 4::9, 0] > 0
    assert inside.sum() > 50
    assert torch.equal(squeezed[..., inside], whole[..., 1::3][..., inside])
