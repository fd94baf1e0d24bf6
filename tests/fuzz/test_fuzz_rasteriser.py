"""A sample of `make fuzz`: extreme Gaussians through every backend."""

import functools

import pytest
import torch

from tests.fuzz.scenes import (
    Drawn,
    Scene,
    disagreement,
    disagreement_on,
    draw,
    extreme_scene,
    fault,
    fault_of,
    well_posed,
)
from tests.stability.backends import BACKENDS, cuda_on_the_host, each_backend

pytestmark = pytest.mark.slow

SCENES, MOST = range(12), 600
ORDINARY = 8
"""Seed of a scene that is mostly well-posed."""


@functools.cache
def scene(seed: int) -> Scene:
    return extreme_scene(seed, most=MOST)


@pytest.fixture(autouse=True)
def stand_in_for_a_gpu(monkeypatch) -> None:
    if "cuda" in BACKENDS:
        cuda_on_the_host(monkeypatch)


@each_backend
def test_nothing_that_is_drawn_is_nan(backend):
    faults = {seed: fault_of(scene(seed), backend) for seed in SCENES}
    assert not any(faults.values()), faults


def test_backends_agree_on_what_is_well_posed():
    parts = {seed: well_posed(scene(seed)) for seed in SCENES}
    faults = {seed: disagreement_on(part, BACKENDS) for seed, part in parts.items()}
    assert not any(faults.values()), faults
    assert sum(len(part.cloud.means) for part in parts.values()) > 500, (
        "too little is well-posed to compare anything"
    )


def test_a_few_seeds_contain_every_extreme():
    clouds = [scene(seed).cloud for seed in range(60)]
    assert {0, MOST} <= {len(cloud.means) for cloud in clouds}
    assert {1, 2, 3, 4} == {len(scene(seed).viewmats) for seed in range(60)}
    assert any(1 in scene(seed).size for seed in range(60))
    for holds in (
        lambda c: c.means.isnan().any(), lambda c: c.scales.isinf().any(),
        lambda c: (c.quats == 0).all(1).any(), lambda c: (c.scales == 0).any(),
        lambda c: (c.opacities > 1).any(), lambda c: (c.opacities < 0).any(),
        lambda c: (c.colors.abs() > 1e29).any(),
        lambda c: len(c.means) and len(c.means.unique(dim=0)) < len(c.means),
    ):  # fmt: skip
        assert any(holds(cloud) for cloud in clouds)


@pytest.mark.parametrize(
    "name, value", [("image", float("nan")), ("alpha", 1.5), ("depth", float("inf"))]
)
def test_a_wrong_render_is_detected(name, value):
    drawn = draw(scene(ORDINARY), "torch")
    wrong = getattr(drawn.out, name).detach().clone()
    wrong[0, 0, 0] = value
    assert fault(scene(ORDINARY), drawn._replace(out=drawn.out._replace(**{name: wrong})))


def test_a_wrong_gradient_is_detected():
    drawn = draw(scene(ORDINARY), "torch")
    assert fault(scene(ORDINARY), drawn) is None
    drawn.grads["quats"][0, 0] = float("nan")
    assert fault(scene(ORDINARY), drawn)


def test_a_backend_that_differs_is_detected():
    part = well_posed(scene(ORDINARY))
    one, other = draw(part, "reference"), draw(part, "torch")
    assert disagreement({"one": one, "other": other}) is None
    shifted = Drawn(other.out._replace(image=1.1 * other.out.image), other.grads)
    assert "image" in disagreement({"one": one, "other": shifted})
    wrong = Drawn(other.out, other.grads | {"means": torch.flip(other.grads["means"], [1])})
    assert "means" in disagreement({"one": one, "other": wrong})
