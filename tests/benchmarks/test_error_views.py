"""Training views that are drawn where the error is large."""

import pytest
import torch

from benchmarks.quality import error_views
from threestudio_gaussiandreamer.cameras import Orbit
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.training.data import orbit_batch

SOME = {"train_views": 160, "batch_size": 400}


@pytest.fixture
def errors(monkeypatch):
    errors = error_views.SectorErrors()
    monkeypatch.setattr(error_views.ErrorMeasuringGuidance, "errors", errors)
    return errors


def azimuths(**options):
    module = error_views.ErrorViewsDataModule({**SOME, **options})
    module.setup("fit")
    cameras = module.train_dataset
    return cameras.pool.azimuth[cameras._pick(400, generator(0, "test"))]


def sectors(azimuth):
    return torch.bincount((azimuth % 360 / 22.5).long(), minlength=error_views.SECTORS)


def test_errors_are_relative_to_those_at_the_same_timestep(errors):
    for _ in range(100):
        for azimuth, factor in ((10.0, 3.0), (190.0, 1.0)):
            for timestep, usual in ((0.15, 1.0), (0.85, 40.0)):
                errors.add(azimuth, timestep, factor * usual)
    assert errors.means[0] / errors.means[8] == pytest.approx(3, rel=0.2)
    assert torch.equal(errors.means[1:8], torch.ones(7))


def test_half_of_the_views_follow_the_errors(errors):
    even = sectors(azimuths())
    errors.means[4] = 15.0  # as much as all others together
    by_error, by_square = sectors(azimuths()), sectors(azimuths(error_power=2.0))
    assert even.max() < 50
    assert 100 < by_error[4] < 150 < by_square[4] < 230
    assert torch.equal(sectors(azimuths(error_power=0.0)), even)


def test_the_guidance_measures_its_views():
    options = {"mesh": "toy.glb", "mode": "direction-bins", "bank_views": 20}
    guidance = error_views.ErrorMeasuringGuidance({**options, "guidance_scale": 2.0})
    azimuth = torch.tensor([10.0, 100.0])
    orbit = Orbit(torch.zeros(2), azimuth, torch.full((2,), 2.0), torch.full((2,), 0.8))
    for _ in range(2):  # the first at a timestep is its own measure
        guidance(torch.rand(2, 64, 64, 3), None, **orbit_batch(orbit, 64, 64))
    changed = (guidance.errors.means != 1).nonzero().flatten().tolist()
    assert changed and set(changed) <= {0, 4}
