import torch

from benchmarks.splatting.half_precision import Pairs, blended


def test_the_gradient_is_that_of_autograd_and_coarser_sums_are_worse():
    rng = torch.Generator().manual_seed(0)
    gauss = torch.rand(40, 6, generator=rng).double()
    features, cotangent = (torch.rand(n, 3, generator=rng).double() for n in (40, 6))
    opacities = torch.full((40,), 0.3, dtype=torch.float64, requires_grad=True)
    alphas = opacities[:, None] * gauss
    before = torch.cat([torch.ones(1, 6).double(), (1 - alphas[:-1]).cumprod(0)])
    image = torch.einsum("mp,mc->pc", alphas * before, features)
    image.backward(cotangent)
    pairs = Pairs(alphas.detach(), before.detach(), features, opacities.detach())
    found, gradient = blended(pairs, cotangent, torch.float64)
    torch.testing.assert_close(found, image.detach())
    torch.testing.assert_close(gradient, opacities.grad)
    errors = []
    for dtype in (torch.float32, torch.float16, torch.bfloat16):
        rounded, other = blended(pairs, cotangent, dtype)
        errors.append(torch.stack([(rounded - found).norm(), (other - gradient).norm()]))
    assert (errors[0] < errors[1] / 100).all() and (errors[1] < errors[2] / 2).all()
