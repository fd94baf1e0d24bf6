"""What the renderer adds to the rasterizer's pictures; fixed, random and learned backgrounds."""

from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.training.background import FlatBackground
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.optimizer import PartRates
from threestudio_gaussiandreamer.training.renderer import (
    LazyMapping,
    SplattingRenderer,
    normals_from_depth,
)


def plane(height: int, width: int) -> tuple[torch.Tensor, ...]:
    """Return depth, camera and field of view of a view from above onto the plane z = 0."""
    c2w = cameras.orbit_c2w(torch.tensor([50.0]), torch.tensor([30.0]), torch.tensor([2.5]))
    fovy = torch.tensor([0.7])
    rays = cameras.ray_directions(c2w, fovy, height, width, normalize=False)
    return -c2w[:, None, None, 2:3, 3] / rays[..., 2:], c2w, fovy


def test_normals_are_those_of_the_depth_surface_and_have_gradients():
    depth, c2w, fovy = plane(24, 32)
    alpha = torch.ones_like(depth)
    alpha[:, :10] = 0.5
    normals = normals_from_depth(depth, alpha, c2w, fovy)
    drawn, nothing = normals[:, 10:], normals[:, :10]
    up = torch.tensor([0.5, 0.5, 1.0]).expand_as(drawn)
    torch.testing.assert_close(drawn, up, rtol=0, atol=1e-4)
    assert (nothing == 0.5).all()
    depth, c2w, fovy = plane(8, 8)
    depth[:, :4] = 0
    depth.requires_grad_()
    normals = normals_from_depth(depth, torch.ones_like(depth), c2w, fovy)
    assert (normals[:, :3] == 0.5).all()
    normals.square().sum().backward()
    assert depth.grad.isfinite().all()

    def of(depth: torch.Tensor) -> torch.Tensor:
        return normals_from_depth(depth, torch.ones_like(depth), c2w.double(), fovy.double())

    assert torch.autograd.gradcheck(of, plane(4, 4)[0].double().requires_grad_())


def test_depth_and_normals_are_computed_when_they_are_read():
    """They have gradients even if they are first read where none are recorded."""
    means = torch.zeros(1, 3, requires_grad=True)
    geometry = SimpleNamespace(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=lambda: torch.full((1, 3), 0.3),
        opacities=lambda: torch.full((1,), 0.9),
        colors=lambda centers: torch.ones(1, 3),
    )
    parts = {"geometry": geometry, "material": None, "background": FlatBackground({})}
    renderer = find("gaussiandreamer-splatting")({}, **parts)
    c2w = cameras.orbit_c2w(torch.tensor([10.0]), torch.tensor([30.0]), torch.tensor([2.5]))
    out = renderer(c2w=c2w, fovy=torch.tensor([0.7]), height=16, width=16)
    assert {"depth", "comp_normal"} <= out.keys() and len({**out}) == len(out)
    with torch.no_grad():
        depth = out["depth"]
    assert out["depth"] is depth and abs(depth[0, 8, 8].item() - 2.5) < 0.1
    for name in ("depth", "comp_normal"):
        (gradient,) = torch.autograd.grad(out[name].sum(), means, retain_graph=True)
        assert gradient.any()


@pytest.mark.parametrize(
    ("background", "message"),
    [
        (lambda dirs: torch.zeros(3), r"returned a tensor \(3,\); expected a tensor of colours"),
        (lambda dirs: None, r"returned NoneType; expected a tensor of colours \(2, 4, 5, 3\)"),
    ],
)
def test_a_background_of_another_shape_or_type_is_named(background, message):
    out = SimpleNamespace(image=torch.zeros(2, 4, 5, 3), alpha=torch.zeros(2, 4, 5, 1))
    c2w, fovy = torch.eye(4).expand(2, 4, 4), torch.ones(2)
    with pytest.raises(UserError, match=message):
        SplattingRenderer._composite(SimpleNamespace(background=background), out, c2w, fovy)


def test_fixed_and_random_backgrounds():
    background = FlatBackground({"mode": "random", "color": [1.0, 1.0, 1.0]})
    background.update_step(0, 7)
    first = background.color(4)
    background.color(2)
    assert torch.equal(background.color(4), first) and len(first.unique(dim=0)) == 4
    background.update_step(0, 8)
    assert not torch.equal(background.color(4), first)
    assert torch.equal(background.eval().color(4), torch.ones(4, 3))
    background = FlatBackground({"color": [0.2, 0.4, 0.6]})
    assert torch.allclose(background.color(3), torch.tensor([0.2, 0.4, 0.6]).expand(3, 3))
    assert background(torch.zeros(2, 5, 7, 3)).shape == (2, 5, 7, 3)
    assert not list(background.parameters())


def test_learned_starts_at_the_colour_stays_in_range_and_learns():
    options = {"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": [0, 0.1, 0.2, 10]}
    background = FlatBackground(options)
    optimizer = torch.optim.Adam(background.parameter_groups())
    rates, parts = PartRates({}), {"geometry": GaussianCloud({}), "background": background}
    rates.groups(SimpleNamespace(**parts, material=None, renderer=None))
    for step in range(400):
        rates.set(optimizer, 0, step)
        optimizer.zero_grad()
        ((background.color(2) - torch.tensor([1.0, 0.0, 0.5])) ** 2).sum().backward()
        optimizer.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.2)
    color = background.color(1)[0]
    assert color[0] > 0.95 and color[1] < 0.05 and color.min() >= 0 and color.max() <= 1


def test_a_derived_background_with_colours_of_pixels_is_drawn():
    class Derived(FlatBackground):
        pass

    class Gradient(FlatBackground):
        def forward(self, dirs):
            return dirs.abs()

    assert FlatBackground.is_flat(Derived({})) and not FlatBackground.is_flat(Gradient({}))


def test_values_of_a_lazy_mapping_are_computed_once_when_they_are_read():
    calls = []
    mapping = LazyMapping({"a": 1}, {"b": lambda: calls.append("b") or 2, "c": lambda: 1 / 0})
    assert "b" in mapping and "c" in mapping and "d" not in mapping
    assert list(mapping) == ["a", "b", "c"] and len(mapping) == 3 and not calls
    assert mapping["b"] == mapping.get("b") == 2 and calls == ["b"]
    assert len(mapping) == 3 and mapping.get("d", 5) == 5
    with pytest.raises(KeyError):
        mapping["d"]
    mapping["c"] = 3
    assert {**mapping} == dict(mapping) == mapping == {"a": 1, "b": 2, "c": 3}
