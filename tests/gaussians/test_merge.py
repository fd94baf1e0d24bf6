"""Duplicates become one Gaussian that renders like both; all others keep their bits."""

import pytest
import torch

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.merge import merge_duplicates
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.metrics import psnr


def shell(count=60, seed=0):
    """Return coloured flat Gaussians on a sphere that do not overlap."""
    rng = torch.Generator().manual_seed(seed)
    index = torch.arange(count) + 0.5
    up = 1 - 2 * index / count
    angle = index * 2.399963
    means = torch.stack([(1 - up**2).sqrt() * angle.cos(), (1 - up**2).sqrt() * angle.sin(), up], 1)
    log_scales = torch.tensor([-2.0, -2.3, -4.0]) + 0.2 * torch.randn(count, 3, generator=rng)
    opacities = torch.rand(count, generator=rng) * 0.3 + 0.5
    return {
        "means": means,
        "log_scales": log_scales,
        "quats": torch.randn(count, 4, generator=rng),
        "logit_opacities": opacities.logit(),
        "sh0": torch.randn(count, 1, 3, generator=rng),
        "sh_rest": 0.1 * torch.randn(count, 3, 3, generator=rng),
    }


def copies(params, times):
    """Return each Gaussian ``times`` times at its position, with the same total transmittance."""
    through = 1 - params["logit_opacities"].sigmoid()
    split = params | {"logit_opacities": (1 - through ** (1 / times)).logit()}
    return {name: value.repeat(times, *[1] * (value.dim() - 1)) for name, value in split.items()}


def repeated(times):
    return {k: v[:1].repeat(times, *[1] * (v.dim() - 1)) for k, v in shell().items()}


def picture(params):
    sh = torch.cat([params["sh0"], params["sh_rest"]], 1)
    cloud = Gaussians(*(params[name] for name in Gaussians._fields[:-1]), sh)
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0")
    around = Gaussians(*(shell()[name] for name in names))
    return render_all(cloud, views_around(around, 6, 48))


def test_a_merged_pair_keeps_its_peak_and_integral_and_small_ones_stay():
    a, b, pair = 0.6, 0.8, repeated(2)
    log_size = pair["log_scales"][0].mean()
    pair["logit_opacities"] = torch.tensor([a, b]).logit()
    merged = merge_duplicates(pair)
    peak = merged["logit_opacities"].sigmoid().item()
    size = (merged["log_scales"].mean() - log_size).exp().item()
    r = torch.linspace(0, 8, 4001, dtype=torch.float64)
    g = (-0.5 * r**2).exp()
    light = torch.trapezoid((1 - (1 - a * g) * (1 - b * g)) * r, r).item()
    assert peak == pytest.approx(1 - (1 - a) * (1 - b), abs=1e-6)
    assert peak * size**2 == pytest.approx(light, rel=1e-4)
    rng = torch.Generator().manual_seed(0)
    many = repeated(2000)
    many["means"] = torch.rand(2000, 3, generator=rng)
    many["log_scales"] = torch.full((2000, 3), -9.0)
    many["log_scales"][0] = -1.0
    merged = merge_duplicates(many)
    assert len(merged["means"]) > 1900
    assert merged["log_scales"].max() < -0.9  # e^354 before


@pytest.mark.parametrize("times", [2, 5])
def test_copies_in_one_place_become_one(times):
    params = shell()
    merged = merge_duplicates(copies(params, times))
    assert len(merged["means"]) == 60
    key = torch.tensor([1.0, 10.0, 100.0])
    order, wanted = ((of["means"] @ key).argsort() for of in (merged, params))
    for name in ("means", "logit_opacities", "sh0", "sh_rest"):  # float32 logits
        torch.testing.assert_close(merged[name][order], params[name][wanted], atol=1e-4, rtol=1e-4)
    growth = (merged["log_scales"][order] - params["log_scales"][wanted]).mean(1)
    assert (growth > 0).all() and (growth < 0.4).all()  # together they fall off more slowly
    assert psnr(picture(merged), picture(copies(params, times))) > 40
    assert len(merge_duplicates(repeated(400))["means"]) <= 4


def test_another_colour_size_or_place_and_a_chain_of_neighbours_are_no_duplicates():
    params = shell()
    merged = merge_duplicates(params)
    assert all(torch.equal(merged[name], params[name]) for name in params)
    assert len(merge_duplicates(repeated(2))["means"]) == 1
    for name, offset in (("sh0", 1.5), ("log_scales", [0, 1.0, 0]), ("means", [0.1, 0, 0.1])):
        params = repeated(2)
        params[name][1] += torch.tensor(offset)
        assert len(merge_duplicates(params)["means"]) == 2
    one = repeated(40)
    one["quats"], one["log_scales"][:] = torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1), -2.0
    one["means"] = torch.arange(40)[:, None] * torch.tensor([[0.05, 0.0, 0.0]])
    assert 10 <= len(merge_duplicates(one)["means"]) <= 20


def test_few_and_unusable_gaussians_and_the_floor():
    params = shell(2)
    for count in (1, 0):
        few = {name: value[:count] for name, value in params.items()}
        assert len(merge_duplicates(few, at_least=0)["means"]) == count
    same = copies(shell(3), 2)
    same["means"][0] = same["quats"][4] = float("nan")
    same["log_scales"][2] = torch.tensor([-30.0, -30, 3])
    assert len(merge_duplicates(same)["means"]) == 6
    params = copies(shell(), 2)
    params["sh0"][60:90] += 0.2  # duplicates still, but dearer ones
    assert len(merge_duplicates(params, at_least=200)["means"]) == 120
    merged = merge_duplicates(params, at_least=90)
    assert len(merged["means"]) == 90 and torch.equal(merged["sh0"][60:], params["sh0"][60:90])


@pytest.mark.parametrize(("opacity", "larger"), [(0.005, 0.6), (0.0001, 1.5)])
def test_a_small_gaussian_in_a_large_faint_one_stays_opaque(opacity, larger):
    pair = repeated(2)
    pair["log_scales"][1] += larger
    pair["logit_opacities"] = torch.tensor([0.9, opacity]).logit()
    merged = merge_duplicates(pair)
    assert len(merged["means"]) == 1 and merged["logit_opacities"].sigmoid() > 0.89
    assert psnr(picture(merged), picture(pair)) > 45
