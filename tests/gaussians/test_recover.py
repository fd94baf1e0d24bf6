"""Recovery improves Gaussians and never makes them worse."""

import pytest
import torch

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.gaussians import recover, simplify
from threestudio_gaussiandreamer.gaussians.recover import Recovery
from threestudio_gaussiandreamer.gaussians.simplify import Budget, keep_best, view_importance
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all, views_around


def views(cloud, train, val, size=48):
    """Return training and validation views."""
    sets = ((train, 0.0), (val, 45.0))
    return [views_around(cloud, count, size, turn=turn) for count, turn in sets]


def test_recovery_pays():
    cloud = ball()
    train_views, val_views = views(cloud, 16, 8)
    images = render_all(cloud, train_views)
    pruned = keep_best(cloud, view_importance(cloud, train_views), 200)
    recovered = recover.recover(pruned, train_views, images, 40, 0)
    before = render_all(cloud, val_views)
    gain = psnr_to_original(recovered, val_views, before)
    assert gain - psnr_to_original(pruned, val_views, before) > 1.0


@pytest.mark.parametrize(
    ("count", "bearable", "tried"),
    [
        (580, [1.0], [1]),
        (580, [1 / 16] * 3, [1, 1 / 4, 1 / 16]),
        (580, [0.0] * 4, [1, 1 / 4, 1 / 16, 1 / 64]),
        (200, [1 / 16] * 5 + [1.0] * 3, [1, 1 / 4, 1 / 16, 1 / 4, 1 / 16, 1 / 4, 1, 1]),
    ],
)
def test_a_recovery_never_lowers_the_quality(monkeypatch, count, bearable, tried):
    """It is repeated with smaller rates, near those of the one before, and skipped if none is small
    enough.
    """
    cloud, scales, bearable = ball(), [], iter(bearable)
    train_views, val_views = views(cloud, 8, 4, size=32)

    def recover_with(cloud, views, images, steps, seed, sh_reach, lr_scale):
        scales.append(lr_scale)
        return cloud if lr_scale <= next(bearable) else cloud._replace(sh=cloud.sh + 1)

    monkeypatch.setattr(recover, "recover", recover_with)
    monkeypatch.setattr(simplify, "merge_duplicates", lambda values, at_least: values)
    recovery = Recovery(cloud, train_views, val_views, steps=1)
    found = simplify.simplify(cloud, Budget(count=count), recovery)
    assert scales == tried
    if count == 580:
        kept = keep_best(cloud, view_importance(cloud, train_views), count)
        assert all(torch.equal(a, b) for a, b in zip(found, kept, strict=True))


def test_a_recovery_of_many_gaussians_takes_fewer_steps(monkeypatch):
    taken = []

    def recover_with(cloud, views, images, steps, *rest):
        taken.append(steps)
        return cloud

    monkeypatch.setattr(recover, "recover", recover_with)
    monkeypatch.setattr(recover, "MOST", 200)
    cloud = ball()
    recovery = Recovery(cloud, *views(cloud, 4, 4, size=16), steps=9)
    for count in (100, 200, 600):
        recovery(cloud.rows(slice(count)), 0)
    assert taken == [9, 9, 3]
