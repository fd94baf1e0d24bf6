"""`launch.py` with one more geometry, ``round-cloud``: Gaussians with one size for all three axes,
for `attributes.py` alone.

It isn't part of the package, because anisotropic Gaussians are better: see docs/results.md.
"""

import sys

from jaxtyping import Float
from torch import Tensor

from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training.geometry import LOG_SCALE_RANGE, GaussianCloud

register_parts()


@register("round-cloud")
class RoundCloud(GaussianCloud):
    """A cloud whose three stored scales start equal and get equal gradients, so that they stay
    equal.
    """

    def scales(self) -> Float[Tensor, "N 3"]:
        return self.log_scales.mean(1, keepdim=True).clamp(*LOG_SCALE_RANGE).exp().expand(-1, 3)


if __name__ == "__main__":
    sys.exit(main())
