"""Hidden Gaussians go first, recovery never makes the rest worse, and the search ends."""

import math

import pytest
import torch

from tests.helpers.pruning import ball
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.gaussians import recover
from threestudio_gaussiandreamer.gaussians import simplify as simplifying
from threestudio_gaussiandreamer.gaussians.simplify import (
    Budget,
    keep_best,
    simplify,
    view_importance,
)
from threestudio_gaussiandreamer.gaussians.views import (
    psnr_to_original,
    rasterize_views,
    render_all,
    row_batches,
    views_around,
)
from threestudio_gaussiandreamer.metrics import psnr


def recovery(cloud, size):
    """Recover with two steps on eight views, validated on eight others."""
    views = (views_around(cloud, 8, size, turn=turn) for turn in (0.0, 45.0))
    return recover.Recovery(cloud, *views, steps=2)


def test_recovery_pays_and_grey_gaussians_are_not_lost_before_grey():
    cloud = ball()
    train_views, val_views = (views_around(cloud, n, 48, turn=t) for n, t in ((16, 0), (8, 45)))
    images, before = render_all(cloud, train_views), render_all(cloud, val_views)
    pruned = keep_best(cloud, view_importance(cloud, train_views), 200)
    recovered = recover.recover(pruned, train_views, images, 40, 0)
    gain = psnr_to_original(recovered, val_views, before)
    assert gain - psnr_to_original(pruned, val_views, before) > 1.0
    cloud = ball()
    cloud.sh[::2] = 0.0
    kept = keep_best(cloud, view_importance(cloud, views_around(cloud, 16, 48)), 300)
    outside = kept.means.norm(dim=1) > 0.9
    grey = (kept.sh == 0).all(-1)[:, 0] & outside
    assert 0.3 < grey.double().sum() / outside.double().sum() < 0.7


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
    """It is repeated with smaller rates, and skipped if none is small enough."""
    cloud, scales, bearable = ball(), [], iter(bearable)

    def recover_with(cloud, views, images, steps, seed, sh_reach, lr_scale):
        scales.append(lr_scale)
        return cloud if lr_scale <= next(bearable) else cloud._replace(sh=cloud.sh + 1)

    monkeypatch.setattr(recover, "recover", recover_with)
    monkeypatch.setattr(simplifying, "merge_duplicates", lambda values, at_least: values)
    fitted = recovery(cloud, 32)
    found = simplify(cloud, Budget(count=count), fitted)
    assert scales == tried
    if count == 580:
        kept = keep_best(cloud, view_importance(cloud, fitted.train_views), count)
        assert all(torch.equal(a, b) for a, b in zip(found, kept, strict=True))


def test_any_quality_or_gain_ends_the_search():
    opaque, small = torch.full((12,), 6.0), torch.full((12, 3), -3.0)
    apart = ball(12)._replace(logit_opacities=opaque, log_scales=small)
    for least, count in ((1.0, 1), (99.0, 12)):
        assert len(simplify(apart, Budget(psnr=least), recovery(apart, 48)).means) == count
    cloud = ball()
    budgets = (Budget(gain=5.0), Budget(gain=0.5), Budget(gain=0.01), Budget(gain=0.5, error=0.1))
    found = (simplify(cloud, budget, recovery(cloud, 48)) for budget in budgets)
    most, some, least, rough = (len(each.means) for each in found)
    assert 0 < most <= some <= least <= 600 and rough < some < 600


@pytest.mark.parametrize(("before", "after", "met"), [(50, 40, False), (60, 54, True)])
def test_a_gain_counts_the_error_of_the_input(before, after, met):
    """A fifth fewer, a third of a doubling, may lose a sixth of a dB of 40 dB to the truth."""
    some, fewer = (keep_best(ball(), torch.arange(600.0), count) for count in (500, 400))
    assert Budget(gain=0.5).met_by(recover.Round(fewer, after), recover.Round(some, before)) == met


def test_a_large_cloud_loses_its_hidden_gaussians_without_a_recovery(monkeypatch, recorded):
    """Fewer are left before the first recovery and the first ranking."""
    monkeypatch.setattr(simplifying, "LARGE", 450)
    monkeypatch.setattr(simplifying, "LOSSLESS", 30.0)
    cloud = ball()
    calls = recorded(recover, "recover"), recorded(simplifying, "view_importance")
    found = simplify(cloud, Budget(count=200), recovery(cloud, 48))
    fitted, ranked = ([len(args[0].means) for args, _ in each] for each in calls)
    assert len(found.means) == 200 and ranked and max(ranked) < len(cloud.means)
    assert fitted and max(fitted) < simplifying.KEEP * len(cloud.means)
    hidden = ball()._replace(logit_opacities=torch.full((600,), -20.0))
    refused("none of the 600 Gaussians", simplify, hidden, Budget(count=200), recovery(hidden, 48))


@pytest.mark.parametrize("needed", [1, 79, 81, 400, 600])
def test_a_large_cloud_is_pruned_at_once_to_what_its_images_need(monkeypatch, needed):
    monkeypatch.setattr(simplifying, "LARGE", 100)
    cloud, asked, least = ball(), [], max(needed, 80)
    kept = recovery(cloud, 16)

    def quality(fewer):
        asked.append(len(fewer.means))
        return 99.0 if asked[-1] >= needed else 0.0

    def rank(cloud, views, seed):
        assert least <= len(cloud.means) <= least + 520 / 2**simplifying.BISECTIONS + 1
        raise StopIteration

    monkeypatch.setattr(kept, "quality", quality)
    monkeypatch.setattr(simplifying, "view_importance", rank)
    with pytest.raises(StopIteration):
        simplify(cloud, Budget(count=80), kept)
    assert len(asked) <= simplifying.BISECTIONS + 1


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e14])
def test_clouds_in_other_units_give_equal_views(unit):
    """The near and far planes clip no cloud given in millimetres."""
    cloud = ball()
    other = cloud._replace(means=cloud.means * unit, log_scales=cloud.log_scales + math.log(unit))
    ours, theirs = (render_all(each, views_around(each, 6, 48)) for each in (cloud, other))
    assert psnr(theirs, ours) > 60


def test_a_constant_harmonic_gives_the_images_of_zero_higher_ones():
    """Also with more channels, which are per view."""
    plain, with_bands = ball(), ball(bands=4)
    views, rows, black = views_around(plain, 3, 32), torch.arange(3), torch.zeros(3)
    assert torch.equal(render_all(plain, views), render_all(with_bands, views))
    channels = torch.rand(3, 600, 2, generator=torch.Generator().manual_seed(0))
    ours, theirs = (
        rasterize_views(cloud, views, rows, torch.zeros(5), channels=channels).image
        for cloud in (plain, with_bands)
    )
    assert ours.shape[-1] == 5 and torch.equal(ours, theirs)
    assert torch.equal(ours[..., :3], rasterize_views(plain, views, rows, black).image)


@pytest.mark.parametrize(
    ("gaussians", "sizes"), [(0, [4, 2]), (500_000, [4, 2]), (1_000_000, [2] * 3), (10**7, [1] * 6)]
)
def test_fewer_views_of_a_large_cloud_are_rendered_at_once(gaussians, sizes):
    batches = row_batches(views_around(ball(), 6, 16), gaussians)
    assert [len(rows) for rows in batches] == sizes
    assert torch.cat(batches).tolist() == list(range(6))
