"""A tiny ImageReward in the published format, and its formula in plain torch."""

import torch
import torch.nn.functional as F

WIDTH, LAYERS, PATCH, SIZE = 64, 2, 8, 16
WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "a", "red", "fox", "blue", "mug")
HEAD = {0: (WIDTH, 1024), 2: (1024, 128), 4: (128, 64), 6: (64, 16), 7: (16, 1)}


def state_dict(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random tensors under the names of the published file, with its buffer."""
    rng = torch.Generator().manual_seed(seed)
    shapes = {"blip.visual_encoder.cls_token": (1, 1, WIDTH)}
    shapes["blip.visual_encoder.pos_embed"] = (1, (SIZE // PATCH) ** 2 + 1, WIDTH)
    shapes |= layer("blip.visual_encoder.patch_embed.proj", WIDTH, 3, PATCH, PATCH)
    for i in range(LAYERS):
        block = f"blip.visual_encoder.blocks.{i}"
        shapes |= norm(f"{block}.norm1") | norm(f"{block}.norm2")
        shapes |= layer(f"{block}.attn.qkv", 3 * WIDTH, WIDTH)
        shapes |= layer(f"{block}.attn.proj", WIDTH, WIDTH)
        shapes |= layer(f"{block}.mlp.fc1", 4 * WIDTH, WIDTH)
        shapes |= layer(f"{block}.mlp.fc2", WIDTH, 4 * WIDTH)
        bert = f"blip.text_encoder.encoder.layer.{i}"
        for attention in ("attention", "crossattention"):
            for name in ("self.query", "self.key", "self.value", "output.dense"):
                shapes |= layer(f"{bert}.{attention}.{name}", WIDTH, WIDTH)
            shapes |= norm(f"{bert}.{attention}.output.LayerNorm")
        shapes |= layer(f"{bert}.intermediate.dense", 2 * WIDTH, WIDTH)
        shapes |= layer(f"{bert}.output.dense", WIDTH, 2 * WIDTH)
        shapes |= norm(f"{bert}.output.LayerNorm")
    shapes |= norm("blip.visual_encoder.norm")
    embeddings = "blip.text_encoder.embeddings"
    shapes[f"{embeddings}.word_embeddings.weight"] = (len(WORDS), WIDTH)
    shapes[f"{embeddings}.position_embeddings.weight"] = (40, WIDTH)
    shapes |= norm(f"{embeddings}.LayerNorm")
    for number, (inputs, outputs) in HEAD.items():
        shapes |= layer(f"mlp.layers.{number}", outputs, inputs)
    state = {name: 0.2 * torch.randn(shape, generator=rng) for name, shape in shapes.items()}
    return state | {f"{embeddings}.position_ids": torch.arange(40)[None]}


def layer(name: str, *shape: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": shape, f"{name}.bias": shape[:1]}


def norm(name: str) -> dict[str, tuple[int, ...]]:
    return layer(name, WIDTH)


def write(folder, state=None):
    """Write a folder with both files."""
    folder.mkdir(exist_ok=True)
    torch.save(state_dict() if state is None else state, folder / "ImageReward.pt")
    (folder / "vocab.txt").write_text("\n".join(WORDS) + "\n")
    return folder


def rewards(state: dict, pixels: torch.Tensor, ids: list[int]) -> torch.Tensor:
    """The reward of normalised pictures for a prompt without padding."""
    vision = picture_features(Tensors(state, "blip.visual_encoder."), pixels)
    found = text_features(Tensors(state, "blip.text_encoder."), torch.tensor([ids]), vision)[:, 0]
    for number in HEAD:
        found = Tensors(state, "mlp.layers.").linear(str(number), found)
    return (found[:, 0] - 0.16717362830052426) / 1.0333394966054072


class Tensors(dict):
    """The tensors, those whose names begin with a prefix without it."""

    def __init__(self, state: dict, prefix: str) -> None:
        super().__init__((name.removeprefix(prefix), value) for name, value in state.items())

    def linear(self, name: str, x: torch.Tensor) -> torch.Tensor:
        return F.linear(x, self[f"{name}.weight"], self[f"{name}.bias"])

    def norm(self, name: str, x: torch.Tensor, eps: float) -> torch.Tensor:
        return F.layer_norm(x, (WIDTH,), self[f"{name}.weight"], self[f"{name}.bias"], eps)


def picture_features(t: Tensors, pixels: torch.Tensor) -> torch.Tensor:
    weights = (t[f"patch_embed.proj.{name}"] for name in ("weight", "bias"))
    patches = F.conv2d(pixels, *weights, stride=PATCH)
    x = torch.cat([t["cls_token"].expand(len(pixels), -1, -1), patches.flatten(2).mT], 1)
    x = x + t["pos_embed"]
    for i in range(LAYERS):
        block = f"blocks.{i}"
        q, k, v = t.linear(f"{block}.attn.qkv", t.norm(f"{block}.norm1", x, 1e-6)).chunk(3, -1)
        x = x + t.linear(f"{block}.attn.proj", attended(q, k, v))
        hidden = F.gelu(t.linear(f"{block}.mlp.fc1", t.norm(f"{block}.norm2", x, 1e-6)))
        x = x + t.linear(f"{block}.mlp.fc2", hidden)
    return t.norm("norm", x, 1e-6)


def text_features(t: Tensors, ids: torch.Tensor, pictures: torch.Tensor) -> torch.Tensor:
    x = t["embeddings.word_embeddings.weight"][ids]
    x = x + t["embeddings.position_embeddings.weight"][: ids.shape[1]]
    x = t.norm("embeddings.LayerNorm", x, 1e-12).expand(len(pictures), -1, -1)
    for i in range(LAYERS):
        bert = f"encoder.layer.{i}"
        for attention, source in (("attention", None), ("crossattention", pictures)):
            place = f"{bert}.{attention}"
            other = x if source is None else source
            q = t.linear(f"{place}.self.query", x)
            k, v = (t.linear(f"{place}.self.{name}", other) for name in ("key", "value"))
            found = t.linear(f"{place}.output.dense", attended(q, k, v))
            x = t.norm(f"{place}.output.LayerNorm", found + x, 1e-12)
        hidden = F.gelu(t.linear(f"{bert}.intermediate.dense", x))
        found = t.linear(f"{bert}.output.dense", hidden)
        x = t.norm(f"{bert}.output.LayerNorm", found + x, 1e-12)
    return x


def attended(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Attention with one head."""
    return (q @ k.mT / WIDTH**0.5).softmax(-1) @ v
