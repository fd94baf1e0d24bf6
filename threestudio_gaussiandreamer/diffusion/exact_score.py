"""The optimal denoiser of a known image distribution, in closed form.

The data are K known images x_k of d values, with probabilities pi_k. With z = a x0 + sigma eps,
where a = sqrt(abar) and sigma = sqrt(1 - abar) as in ``sds.py``:

    p_t(z)  = sum_k pi_k N(z; a x_k, sigma^2 I)
    gamma_k = softmax_k(log pi_k - |z - a x_k|^2 / 2 sigma^2)   responsibilities
    m       = sum_k gamma_k x_k = E[x0 | z]                     denoised
    eps_hat = (z - a m) / sigma = -sigma grad log p_t(z)

Distances are expanded to |z|^2 - 2 a z x + a^2 |x|^2 in float64, which is several times faster than
sums of squared differences. In float32 the expansion has errors of about one nat in the logits at
512 x 512 pixels. Everything else is computed in the type of z.

The closed-form denoiser memorises: for d above a few hundred it returns the nearest known image
(Scarvelis et al. 2023, "Closed-Form Diffusion Models"). The perplexity of the responsibilities
measures this: it is then 1."""

from collections.abc import Callable
from typing import NamedTuple, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from . import sds

CPU_CHUNK_ELEMENTS, GPU_CHUNK_ELEMENTS = 2**18, 2**24
"""Largest number of elements of a temporary, unless one image has more: 2 MiB in float64, which the
caches of a CPU hold, and 128 MiB, since on a GPU each operation is a launch.
"""


def images_per_chunk(elements: int, device: torch.device) -> int:
    """Return how many images of so many elements are processed at once; at least one."""
    most = CPU_CHUNK_ELEMENTS if device.type == "cpu" else GPU_CHUNK_ELEMENTS
    return max(1, most // max(elements, 1))


def squared_distances(
    z: Float[Tensor, "B d"], bank: Float[Tensor, "*batch K d"], abar: Float[Tensor, " B"]
) -> Float[Tensor, "B K"]:
    """Compute |z - sqrt(abar) x_k|^2 in float64.

    Args:
        bank: the images x_k, shared (K, d) or per item (B, K, d).
    """
    wide_z, norms, products = z.double(), [], []
    chunk = images_per_chunk(bank.numel() // max(bank.shape[-2], 1), bank.device)
    for part in bank.split(chunk, dim=-2):
        x = part.double()
        products.append(wide_z @ x.mT if x.dim() == 2 else (wide_z[:, None] @ x.mT)[:, 0])
        norms.append(x.square().sum(-1))
    return expanded_distances(wide_z, abar, torch.cat(norms, dim=-1), torch.cat(products, dim=1))


def expanded_distances(
    z: Float[Tensor, "B d"],
    abar: Float[Tensor, " B"],
    norms: Float[Tensor, "*batch K"],
    products: Float[Tensor, "B K"],
) -> Float[Tensor, "B K"]:
    """Compute |z - sqrt(abar) x_k|^2 from |x_k|^2 and z x_k; all but abar are float64."""
    a = abar.double().sqrt().to(z.device)[:, None]
    distances = a * (a * norms - 2 * products) + z.square().sum(1, keepdim=True)
    return distances.clamp_min_(0)


def denoise(
    z: Float[Tensor, "B d"],
    abar: Float[Tensor, " B"],
    distances: Float[Tensor, "B K"],
    mean_of: Callable[[Float[Tensor, "B K"]], Float[Tensor, "B d"]],
    log_prior: Optional[Float[Tensor, "*prior K"]] = None,
) -> tuple[Float[Tensor, "B d"], Float[Tensor, " B"]]:
    """Return the optimal prediction of the noise in z, and the perplexity of the responsibilities:
    exp of their entropy, in [1, K], the effective number of images that could have given z.

    Args:
        abar: cumulative product of 1 - beta, per item, in (0, 1).
        distances: |z - sqrt(abar) x_k|^2, float64.
        mean_of: returns the sum of the images with the responsibilities as weights.
        log_prior: log pi_k, not necessarily normalised; -inf excludes an image. By default uniform.
    """
    variance = 1 - abar.double()
    logits = -distances / (2 * variance.to(distances)[:, None])
    gamma = torch.softmax(logits if log_prior is None else logits + log_prior.to(logits), dim=1)
    residual = z - sds.per_item(abar.double().sqrt(), z) * mean_of(gamma.to(z))
    eps = sds.per_item(variance.sqrt() / variance, z) * residual
    return eps, (-torch.special.xlogy(gamma, gamma).sum(1)).exp()


def weighted_sum(
    weights: Float[Tensor, "B K"], bank: Float[Tensor, "*batch K d"]
) -> Float[Tensor, "B d"]:
    """Sum the images with weights >= 0, in the weights' type. Images without a weight in any item,
    often all but one, aren't read.
    """
    used = (weights > 0).any(0).nonzero().flatten()
    weights, bank = weights[:, used], bank.index_select(-2, used).to(weights)
    return weights @ bank if bank.dim() == 2 else (weights[:, None] @ bank)[:, 0]


# The linear latent
# --------------------------------------------------------------------------------------------------


COLOR_MATRIX = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 2
"""Orthonormal columns from RGB to four channels; its rows are the corners of a tetrahedron: the
first channel is a luminance, the others are opponent colours.
"""


class LinearLatent(NamedTuple):
    """A linear replacement for a VAE: average pooling over ``factor`` x ``factor`` pixels, a colour
    matrix, and a scale.

    ``y = scale * matrix @ pool(2 rgb - 1)``. With factor 1, no matrix and scale 1 this is the space
    of a pixel-space diffusion model. The score is defined on y, so the gradient by autograd is
    exact; components of an image in the null space of the map, such as details within a pooled
    pixel, get no gradient."""

    factor: int = 1
    matrix: Optional[Float[Tensor, "c 3"]] = None
    """None = the identity."""
    scale: float = 1.0

    def encode(self, rgb: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B c h w"]:
        """Encode images in [0, 1]; H and W are multiples of ``factor``."""
        return self.encode_pooled(F.avg_pool2d(rgb, self.factor) if self.factor > 1 else rgb)

    def encode_pooled(self, rgb: Float[Tensor, "B 3 h w"]) -> Float[Tensor, "B c h w"]:
        """Encode images in [0, 1] that have already been pooled."""
        latents = _recolored(2 * rgb - 1, self.matrix)
        return latents if self.scale == 1 else self.scale * latents

    def decode(self, latents: Float[Tensor, "B c h w"]) -> Float[Tensor, "B 3 H W"]:
        """Decode to images in [0, 1] with the pseudo-inverse of the colour matrix, repeating each
        pooled pixel ``factor`` x ``factor`` times.
        """
        inverse = None if self.matrix is None else torch.linalg.pinv(self.matrix.double())
        rgb = (_recolored(latents, inverse) / self.scale + 1) / 2
        return (
            rgb.clamp(0, 1)
            .repeat_interleave(self.factor, dim=2)
            .repeat_interleave(self.factor, dim=3)
        )

    def normalised(self, rgb: Float[Tensor, "K 3 h w"]) -> "LinearLatent":
        """Return it with unit variance on images in [0, 1]; raise UserError if of one colour."""
        std = self._replace(scale=1.0).encode_pooled(rgb).std()
        if not std > 0:
            raise UserError("a latent can't be normalised on images that are all of one colour")
        return self._replace(scale=1 / float(std))


def _recolored(
    images: Float[Tensor, "B i h w"], matrix: Optional[Float[Tensor, "o i"]]
) -> Float[Tensor, "B o h w"]:
    return images if matrix is None else F.conv2d(images, matrix.to(images)[:, :, None, None])
