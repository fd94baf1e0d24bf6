"""The rasteriser's contract, through the documented ``rasterize``: every backend of this machine
draws, and differentiates, what the float64 specification does.
"""

import math

import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import rasterize

WIDTH, HEIGHT = 34, 18
NAMES = ("means", "quats", "scales", "opacities", "colors", "background")


def scene(count: int, size: float, seed: int) -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    return {
        "means": uniform(count, 3) * 2 - 1,
        "quats": uniform(count, 4) * 2 - 1,
        "scales": size * (0.2 + uniform(count, 3)),
        "opacities": uniform(count),
        "colors": uniform(count, 3),
        "background": uniform(3),
    }


def cameras(count: int) -> dict[str, torch.Tensor]:
    """Return cameras around the origin, at distance 3."""
    views = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for view, angle in zip(views, torch.linspace(0, 2, count).tolist(), strict=True):
        cos, sin = math.cos(angle), math.sin(angle)
        view[:3, :3] = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        view[2, 3] = 3
    focal = 0.9 * HEIGHT
    intrinsics = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    return {"viewmats": views, "Ks": intrinsics.double().repeat(count, 1, 1)}


def drawn(backend: str, dtype: torch.dtype, cloud: dict, **options) -> dict[str, torch.Tensor]:
    """Return the pictures, and the gradients of a fixed sum of them."""
    leaves = {name: value.to(dtype).requires_grad_() for name, value in cloud.items()}
    views = {name: value.to(dtype) for name, value in cameras(2).items()}
    size = {"width": WIDTH, "height": HEIGHT}
    out = rasterize(**leaves, **views, **size, backend=backend, **options)
    pictures = {"image": out.image, "alpha": out.alpha, "depth": out.depth}
    rng = torch.Generator().manual_seed(1)
    weights = [torch.rand(p.shape, generator=rng, dtype=torch.float64) for p in pictures.values()]
    total = sum((p * w).sum() for p, w in zip(pictures.values(), weights, strict=True))
    grads = torch.autograd.grad(total, list(leaves.values()))
    return pictures | dict(zip(NAMES, grads, strict=True))


@pytest.fixture(params=["cpu", "torch"])
def backend(request) -> str:
    """Return a backend; skip it where this machine can't run it."""
    try:
        drawn(request.param, torch.float32, scene(1, 0.1, seed=0))
    except UserError as error:
        pytest.skip(str(error))
    return request.param


OPTIONS = [
    {"preset": "accurate"},
    {"preset": "balanced", "antialias": True},
    {"preset": "accurate", "downsample": 2, "eps2d": 0.1},
    {"preset": "accurate", "near": 2.5, "far": 3.3},
    {"alpha_min": 0.0, "alpha_max": 0.6, "stop": 0.0},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_backend_is_the_specification(backend, options):
    cloud = scene(120, 0.15, seed=0)
    found = drawn(backend, torch.float32, cloud, **options)
    truth = drawn("reference", torch.float64, cloud, **options)
    for name, expected in truth.items():
        error = (found[name].double() - expected).norm() / expected.norm()
        assert error < 1e-4, f"{name}: {error:.1e}"


def test_the_specification_is_front_to_back_compositing():
    """Two Gaussians on the axis of a camera, by the formula."""
    cloud = scene(2, 0.1, seed=0)
    cloud["means"] = torch.tensor([[0, 0, 0], [0, 0, 1]], dtype=torch.float64)
    cloud["scales"] = torch.ones((2, 3), dtype=torch.float64)
    cloud["opacities"] = torch.tensor([0.5, 0.8], dtype=torch.float64)
    view = {name: value[:1] for name, value in cameras(1).items()}
    image = rasterize(**cloud, **view, width=WIDTH, height=HEIGHT, backend="reference").image
    near, far = cloud["colors"]
    middle = image[0, HEIGHT // 2, WIDTH // 2]
    expected = 0.5 * near + 0.5 * (0.8 * far + 0.2 * cloud["background"])
    assert (middle - expected).abs().max() < 0.02


def test_nothing_and_nonsense(backend):
    cloud = scene(40, 0.15, seed=2)
    cloud["means"][3, 0] = math.nan
    found = drawn(backend, torch.float32, cloud)
    assert found["image"].isfinite().all()
    with pytest.raises(UserError, match="means"):
        drawn(backend, torch.float32, cloud, non_finite="error")
    empty = {name: value[:0] if name != "background" else value for name, value in cloud.items()}
    image = drawn(backend, torch.float32, empty)["image"]
    assert (image == empty["background"].float()).all()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"scales": torch.zeros(40, 2)}, "scales"),
        ({"opacities": torch.zeros(39)}, "opacities"),
        ({"preset": "fst"}, "fst"),
        ({"backend": "gpu"}, "gpu"),
        ({"width": 0}, "width"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_wrong_argument_is_named(change, word):
    views = {name: value.float() for name, value in cameras(2).items()}
    cloud = {name: value.float() for name, value in scene(40, 0.15, seed=2).items()}
    with pytest.raises(UserError, match=word):
        rasterize(**{**cloud, **views, "width": WIDTH, "height": HEIGHT, **change})
