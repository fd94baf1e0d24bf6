"""Sizes and construction of the toybox's networks; all but the judge have published formats."""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from .tokens import LENGTH
from .views import LABELS, SIZE

TEXT_WIDTH, TEXT_LAYERS, HEADS = 128, 2, 4
VISION_WIDTH, VISION_LAYERS, PATCH = 128, 4, 16
FEATURES = 128
"""Of CLIP's common space, and so of the points model's condition."""
VAE_CHANNELS = (16, 32, 64, 80)
UNET_CHANNELS = (96, 160)
"""At 16^2 and 8^2."""
LATENT_CHANNELS = 4
POINTS_WIDTH, POINTS_LAYERS = 128, 5
MOTION_WIDTH, MOTION_LAYERS, MOTION_HIDDEN = 128, 4, 1024
"""The last is that of every published MDM."""
SCHEDULE = {"num_train_timesteps": 1000, "beta_schedule": "scaled_linear"}
SCHEDULE |= {"beta_start": 0.00085, "beta_end": 0.012}
"""Stable Diffusion's."""


def clip_model(vocabulary_size: int) -> Any:
    """Make a transformers CLIPModel; the tokenizer's last two tokens are start and end."""
    from transformers import CLIPConfig, CLIPModel

    start, end = vocabulary_size - 2, vocabulary_size - 1
    text = {"vocab_size": vocabulary_size, "max_position_embeddings": LENGTH}
    text |= {"bos_token_id": start, "eos_token_id": end, "pad_token_id": end}
    text |= _transformer(TEXT_WIDTH, TEXT_LAYERS)
    vision = _transformer(VISION_WIDTH, VISION_LAYERS) | {"image_size": SIZE, "patch_size": PATCH}
    towers = {"text_config": text, "vision_config": vision}
    return CLIPModel(CLIPConfig(**towers, projection_dim=FEATURES))


def _transformer(width: int, layers: int) -> dict[str, Any]:
    sizes = {"hidden_size": width, "intermediate_size": 4 * width, "num_hidden_layers": layers}
    return sizes | {"num_attention_heads": HEADS, "hidden_act": "gelu", "projection_dim": FEATURES}


def autoencoder() -> Any:
    """Make a diffusers AutoencoderKL that shrinks 8 times."""
    from diffusers import AutoencoderKL

    levels = len(VAE_CHANNELS)
    network = AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        block_out_channels=VAE_CHANNELS,
        layers_per_block=1,
        latent_channels=LATENT_CHANNELS,
        norm_num_groups=2,
        sample_size=SIZE,
        mid_block_add_attention=False,
    )
    start_as_identity(network)
    with torch.no_grad():  # the posterior's standard deviation starts at exp(-3)
        for convolution in (network.quant_conv, network.post_quant_conv):
            nn.init.dirac_(convolution.weight)
            nn.init.zeros_(convolution.bias)
        network.quant_conv.weight[LATENT_CHANNELS:] *= 0.1
        network.quant_conv.bias[LATENT_CHANNELS:] = -6.0
    return network


def unet() -> Any:
    """Make a diffusers UNet2DConditionModel of 16^2 latents with cross attention at 8^2."""
    from diffusers import UNet2DConditionModel

    network = UNet2DConditionModel(
        sample_size=SIZE // 8,
        in_channels=LATENT_CHANNELS,
        out_channels=LATENT_CHANNELS,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        mid_block_type=None,
        block_out_channels=UNET_CHANNELS,
        layers_per_block=1,
        cross_attention_dim=TEXT_WIDTH,
        attention_head_dim=HEADS,
        norm_num_groups=16,
    )
    start_as_identity(network)
    _start_at_zero(network.conv_out)
    return network


@torch.no_grad()
def start_as_identity(network: nn.Module) -> None:
    """Initialise every block of a diffusers network to pass its input on unchanged, so that
    training needs far fewer steps: residual branches start at zero, resampling as averages."""
    for name, module in network.named_modules():
        if name.endswith(("conv2", "proj_out")):
            _start_at_zero(module)
        elif name.endswith(("downsamplers.0.conv", "upsamplers.0.conv", "conv_shortcut")):
            # the average of places^2 inputs per channel; missing channels keep small random weights
            places = 2 if "downsamplers" in name else 1
            module.weight.mul_(0.1)
            nn.init.zeros_(module.bias)
            start = 0 if module.stride == (2, 2) else module.kernel_size[0] // 2
            rows = slice(start, start + places)
            for channel in range(min(module.weight.shape[:2])):
                module.weight[channel, channel, rows, rows] += 1 / places**2


def _start_at_zero(layer: Any) -> None:
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)


def scheduler() -> Any:
    """Make Stable Diffusion's noise schedule, for a network that predicts v."""
    from diffusers import DDPMScheduler

    return DDPMScheduler(**SCHEDULE, prediction_type="v_prediction", clip_sample=False)


class AttributeHeads(nn.Module):
    """One linear classifier for each of LABELS."""

    def __init__(self, width: int) -> None:
        super().__init__()
        sizes = {name: len(classes) for name, classes in LABELS.items()}
        self.heads = nn.ModuleDict({name: nn.Linear(width, n) for name, n in sizes.items()})

    def forward(self, features: Float[Tensor, "B W"]) -> dict[str, Tensor]:
        return {name: head(features) for name, head in self.heads.items()}


class Judge(nn.Module):
    """Classifiers of pictures in [0, 1], (B, 3, 128, 128), into LABELS: of objects, and of persons.

    It shares neither architecture nor training data nor seed with the models that it evaluates."""

    def __init__(self) -> None:
        super().__init__()
        self.objects, self.persons = Classifier(), PersonClassifier()

    def forward(
        self, images: Float[Tensor, "B 3 s s"], persons: Bool[Tensor, " B"]
    ) -> dict[str, Tensor]:
        found = {name: images.new_empty(len(images), len(each)) for name, each in LABELS.items()}
        for network, rows in ((self.objects, ~persons), (self.persons, persons)):
            if rows.any():
                part = images[rows].contiguous(memory_format=torch.channels_last)
                for name, logits in network(part).items():
                    found[name][rows] = logits.float()
        return found


class Classifier(nn.Module):
    """A convolutional network with a head for each attribute."""

    CHANNELS = (24, 48, 96, 128)

    def __init__(self) -> None:
        super().__init__()
        layers, previous = [], 3
        for channels in self.CHANNELS:
            shrink = nn.Conv2d(previous, channels, 4, stride=2, padding=1)
            grouped = nn.Conv2d(channels, channels, 3, padding=1, groups=8)
            for convolution in (shrink, grouped):
                layers += [convolution, nn.GroupNorm(8, channels), nn.SiLU()]
            previous = channels
        self.body = nn.Sequential(*layers)
        self.mix = nn.Sequential(nn.Linear(2 * previous, 256), nn.SiLU())
        self.heads = AttributeHeads(256)

    def forward(self, images: Float[Tensor, "B 3 s s"]) -> dict[str, Tensor]:
        x = self.body(images * 2 - 1).flatten(2)
        return self.heads(self.mix(self.pooled(x)))

    def pooled(self, x: Float[Tensor, "B C P"]) -> Float[Tensor, "B D"]:
        return torch.cat([x.mean(-1), x.amax(-1)], dim=1)


class PersonClassifier(Classifier):
    """One that also sees where something is, which tells an arm from the other; at half the
    resolution, which is five times as fast."""

    PLACES = 16

    def __init__(self) -> None:
        super().__init__()
        previous, side = self.CHANNELS[-1], SIZE // 2 ** (1 + len(self.CHANNELS))
        self.squeeze = nn.Conv1d(previous, self.PLACES, 1)
        size = self.PLACES * side**2 + previous
        self.mix = nn.Sequential(nn.Linear(size, 256), nn.SiLU())

    def forward(self, images: Float[Tensor, "B 3 s s"]) -> dict[str, Tensor]:
        return super().forward(F.avg_pool2d(images, 2))

    def pooled(self, x: Float[Tensor, "B C P"]) -> Float[Tensor, "B D"]:
        return torch.cat([self.squeeze(x).flatten(1), x.amax(-1)], dim=1)


IGNORED = -100
"""The label of classes that torch's losses ignore."""


def classified(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> tuple[Tensor, Tensor]:
    """Return the mean cross entropy over the attributes, and the share recognised."""
    pairs = list(zip(logits.values(), labels.unbind(1), strict=True))
    sums = [F.cross_entropy(value.float(), label, reduction="sum") for value, label in pairs]
    known = (labels != IGNORED).sum(dim=0).clamp(min=1)  # a batch may have no label of a column
    loss = (torch.stack(sums) / known).mean()
    right = torch.stack([(value.argmax(-1) == label).sum() for value, label in pairs]).sum()
    return loss, right / known.sum()


def accuracies(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> dict[str, float]:
    """Return the share recognised of each attribute."""
    return {
        name: float((value.argmax(-1) == label)[label != IGNORED].float().mean())
        for (name, value), label in zip(logits.items(), labels.unbind(1), strict=True)
    }
