"""Score distillation without a score model, on pixels."""

from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance.base import ScoreDistillation


class PixelGuidance(ScoreDistillation):
    """Latents are the pixels in [-1, 1], and no prompt is read; subclasses predict the noise."""

    def encode(self, rgb, **batch):
        return 2 * rgb - 1

    def decode(self, latents):
        return (latents + 1) / 2

    def condition(self, prompt_utils, **batch):
        return None


class TowardsGrey(PixelGuidance):
    """The gradient is w x for latents x."""

    def predict(self, z, t, condition):
        noise = streams.normal_per_item(tuple(z.shape), 0, "noise", self.step)
        return noise + sds.predict_x0(z, noise, self.alphas_cumprod[t]), None
