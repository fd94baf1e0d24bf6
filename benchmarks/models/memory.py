"""Memory of published models, computed without weights on PyTorch's meta device.

    python -m benchmarks.models.memory

Counts parameters, and the bytes that the VAE's encoder keeps of one image for its backward pass.
Writes ``benchmarks/results/models.csv``; ``python -m benchmarks.tables`` makes the table of
docs/models.md from it."""

import argparse
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from benchmarks.markdown import markdown, read, write
from benchmarks.models.published import MODELS, T5_XXL, Model

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/models.csv"
COLUMNS = (
    "model",
    "network_parameters",
    "vae_parameters",
    "clip_parameters",
    "t5_parameters",
    "vae_bytes_per_number",
    "side",
    "vae_gradient_bytes",
)


def parameters(network: nn.Module) -> int:
    """Return the number of stored numbers; tables of positions count, which aren't trained."""
    stored = {value.untyped_storage()._cdata: value for value in network.state_dict().values()}
    return sum(value.numel() for value in stored.values())


def network_of(model: Model) -> nn.Module:
    """Make the network that predicts the noise, without memory."""
    import diffusers

    with torch.device("meta"):
        return getattr(diffusers, model.network)(**model.options)


def vae_of(model: Model) -> nn.Module:
    from diffusers import AutoencoderKL

    with torch.device("meta"):
        return AutoencoderKL(**model.vae)


def clip_parameters(options: dict[str, Any], *, projected: bool) -> int:
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

    with torch.device("meta"):
        encoder = CLIPTextModelWithProjection if projected else CLIPTextModel
        return parameters(encoder(CLIPTextConfig(**options)))


def t5_parameters() -> int:
    from transformers import T5Config, T5EncoderModel

    with torch.device("meta"):
        return parameters(T5EncoderModel(T5Config(**T5_XXL)))


class FusedAttention(torch.autograd.Function):
    """What PyTorch's fused attention keeps for its backward pass; on the meta device PyTorch would
    keep the attention matrix too.
    """

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        output = torch.empty_like(query)
        ctx.save_for_backward(query, key, value, output)
        return output


def fused_attention(query: Tensor, key: Tensor, value: Tensor, **options: Any) -> Tensor:
    return FusedAttention.apply(query, key, value)


def gradient_bytes(vae: nn.Module, side: int, bytes_per_number: int) -> int:
    """Return the bytes that the encoder keeps of one image of ``side`` x ``side`` pixels for the
    gradient, without its parameters, which are kept once.
    """
    vae.requires_grad_(False)
    own = {parameter.untyped_storage()._cdata for parameter in vae.parameters()}
    kept: dict[int, Tensor] = {}

    def pack(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage()._cdata] = tensor  # held, so that no address is used twice
        return tensor

    image = torch.zeros(1, 3, side, side, device="meta", requires_grad=True)
    with (
        patch.object(torch.nn.functional, "scaled_dot_product_attention", fused_attention),
        torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor),
    ):
        vae.encode(image)
    # computed in float32
    return (
        bytes_per_number
        * sum(
            tensor.untyped_storage().nbytes() for place, tensor in kept.items() if place not in own
        )
    ) // 4


def row(name: str, model: Model) -> dict[str, Any]:
    """Count one model."""
    vae = vae_of(model)
    # of Stable Diffusion 2.1 and XL's first encoder no projection is loaded
    clips = [
        clip_parameters(options, projected=model.t5 or options is not model.clips[0])
        for options in model.clips
    ]
    counts = (
        name,
        parameters(network_of(model)),
        parameters(vae),
        sum(clips),
        t5_parameters() if model.t5 else 0,
        model.vae_bytes,
        model.side,
        gradient_bytes(vae, model.side, model.vae_bytes),
    )
    return dict(zip(COLUMNS, counts, strict=True))


def table() -> str:
    """Return the table of docs/models.md."""
    head = (
        "model",
        "network, VAE",
        "loaded",
        "text encoders, once",
        "VAE's gradient, a view",
    )
    return markdown(head, (cells(row) for row in read(RESULTS)))


def cells(row: dict[str, str]) -> tuple[str, ...]:
    network, vae, clip, t5, each, kept = (
        int(row[name]) for name in (*COLUMNS[1:6], "vae_gradient_bytes")
    )
    text = f"CLIP {clip / 1e9:.2f} B in float32: {4 * clip / 2**30:.1f} GiB"
    if t5:
        text += f"; T5 {t5 / 1e9:.2f} B in float16: {2 * t5 / 2**30:.1f} GiB"
    return (
        row["model"],
        f"{network / 1e9:.2f} B, {vae / 1e6:.0f} M",
        f"{(2 * network + each * vae) / 2**30:.1f} GiB",
        text,
        f"{kept / 2**30:.2f} GiB at {row['side']} x {row['side']}",
    )


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    write(RESULTS, COLUMNS, (row(name, model) for name, model in MODELS.items()))
    print(table())


if __name__ == "__main__":
    main()
