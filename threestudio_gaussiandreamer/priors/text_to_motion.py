"""Text to motion with MDM (Tevet et al. 2022, "Human Motion Diffusion Model"), from the files that
its authors publish: ``model*.pt``, ``args.json``, mean and deviation of HumanML3D's features.

The network is written from the architecture that the checkpoints fix: a transformer encoder whose
first token is the sum of the timestep's and the text's embedding, and which predicts the clean
features. Its text features are those of a CLIP, which isn't part of the file."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from ..meshes.side_files import consulted, stamp
from ..models.model_files import load_exactly, read_state_dict
from .body_pose import BODY_JOINTS, PARENTS
from .karras import cosine_alphas_cumprod

FEATURES, HEADS, POSITIONS = 263, 4, 5000
KIND = "MDM checkpoint"
STATISTICS = "Mean.npy", "Std.npy"
"""HumanML3D's; MDM's t2m_std.npy, which is for its evaluator, is a 25th for the pelvis."""
SETTINGS, ACTIONS = "args.json", "actions.txt"
"""The latter may list the phrases of the training, one a line; published models have none."""
SUPPORTED = {"dataset": "humanml", "arch": "trans_enc", "text_encoder_type": "clip",
             "noise_schedule": "cosine"}  # fmt: skip
"""What ``args.json`` must say where it says it."""
IGNORED = re.compile(r"sequence_pos_encoder\.pe$|^clip_model\.")
"""Entries of a checkpoint that are computed, or another model's."""
STEPS, FRAMES = 50, 60
"""At most so many steps of the sampler, and frames at 20 per second."""
VELOCITIES = 16.0
"""Weight of a sample's velocities (m/frame) beside that of its positions (m), squared."""


class MotionModel(nn.Module):
    """Predict clean features from noisy ones; names are those of MDM's checkpoints."""

    def __init__(self, width: int, layers: int, hidden: int, text: int) -> None:
        super().__init__()
        self.input_process = nn.ModuleDict({"poseEmbedding": nn.Linear(FEATURES, width)})
        layer = nn.TransformerEncoderLayer(width, HEADS, hidden, dropout=0.1, activation="gelu")
        self.seqTransEncoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        embed = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.embed_timestep = nn.ModuleDict({"time_embed": embed})
        self.embed_text = nn.Linear(text, width)
        self.output_process = nn.ModuleDict({"poseFinal": nn.Linear(width, FEATURES)})
        # sines and cosines in turn (Vaswani et al. 2017)
        rates = torch.exp(torch.arange(0, width, 2) * (-math.log(10000.0) / width))
        angles = torch.arange(POSITIONS)[:, None] * rates
        waves = torch.stack([angles.sin(), angles.cos()], -1).flatten(1)
        self.register_buffer("positions", waves, persistent=False)

    def forward(
        self, x: Float[Tensor, "B T 263"], t: Tensor, text: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B T 263"]:
        """Return the clean features; zeros as ``text`` for no prompt."""
        first = self.embed_timestep["time_embed"](self.positions[t]) + self.embed_text(text)
        tokens = torch.cat([first[:, None], self.input_process["poseEmbedding"](x)], 1)
        tokens = (tokens + self.positions[: tokens.shape[1]]).transpose(0, 1)
        return self.output_process["poseFinal"](self.seqTransEncoder(tokens)[1:].transpose(0, 1))


class TextToMotion(NamedTuple):
    """A model with what it is sampled with."""

    network: MotionModel
    steps: int
    """Timesteps of its training."""
    guidance_scale: float
    mean: Float[np.ndarray, "263"]
    std: Float[np.ndarray, "263"]
    known: list[str]
    """Phrases of its training; empty if it doesn't list them."""


def load_motion_model(path: str) -> TextToMotion:
    """Load MDM's checkpoint with the files beside it.

    Raises:
        UserError: a file is missing or damaged, or the model is of another kind."""
    with reading(path, KIND) as file:
        beside = [file.parent / name for name in (SETTINGS, ACTIONS, *STATISTICS)]
        consulted.update((str(one), stamp(one)) for one in beside)
        state = read_state_dict(path, KIND)
        state = {name: value for name, value in state.items() if not IGNORED.search(name)}
        layers = len({n.split(".")[2] for n in state if n.startswith("seqTransEncoder.layers.")})
        first = state.get("input_process.poseEmbedding.weight", torch.zeros(0, 0))
        text = state.get("embed_text.weight", torch.zeros(0, 0))
        hidden = len(state.get("seqTransEncoder.layers.0.linear1.weight", ()))
        width = len(first)
        require(
            first.shape[1:] == (FEATURES,) and layers and len(text) == width and not width % HEADS,
            f"it holds another model: one of HumanML3D's {FEATURES} features with CLIP's text was "
            "expected, such as humanml_trans_enc_512",
        )
        network = MotionModel(width, layers, hidden, text.shape[1])
        load_exactly(network, state, f"{KIND} {path!r}")
        network.eval().requires_grad_(False)
        known = beside[1].read_text(encoding="utf-8") if beside[1].is_file() else ""
    with reading(beside[0], f"settings of the {KIND}") as file:
        args = json.loads(file.read_text(encoding="utf-8"))
        steps, guidance = args.get("diffusion_steps", 1000), args.get("guidance_param", 2.5)
        for name, value in SUPPORTED.items():
            found = args.get(name, value)
            require(found == value, f"{name} is {found!r}; only {value!r} is supported")
        usual = steps in range(2, POSITIONS + 1) and math.isfinite(guidance)
        require(usual, f"diffusion_steps is {steps}; expected 2 to {POSITIONS}")
    statistics, known = _statistics(beside[0].parent), list(filter(str.strip, known.splitlines()))
    return TextToMotion(network, steps, guidance, *statistics, known)


def _statistics(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    kind = "file of HumanML3D (MDM's t2m_mean.npy and t2m_std.npy are others)"
    found = [read_arrays(folder / name, kind, ["array"])["array"] for name in STATISTICS]
    if not all(a.shape == (FEATURES,) and a.dtype.kind == "f" for a in found):
        raise UserError(f"{str(folder)!r}: {' and '.join(STATISTICS)} need {FEATURES} numbers each")
    mean, std = np.float64(found)
    return mean, np.maximum(std, 1e-8)


@torch.no_grad()
def sample_motions(
    model: TextToMotion,
    text: Float[Tensor, "1 D"],
    count: int,
    generator: torch.Generator,
    *,
    frames: int = FRAMES,
) -> Float[np.ndarray, "S T 22 3"]:
    """Draw ``count`` motions for a text: ancestral steps (Ho et al. 2020) over at most ``STEPS`` of
    the timesteps, with classifier-free guidance. Metres, y up.

    Raises:
        UserError: the features of the text have another size, or positions aren't finite."""
    given, expected = text.shape[1], model.network.embed_text.in_features
    if given != expected:
        raise UserError(
            f"the motion model takes {expected} features of a text, but its CLIP gives {given}: "
            "it was trained with another CLIP"
        )
    network, device = model.network, text.device
    kept = np.unique(np.linspace(0, model.steps - 1, min(STEPS, model.steps)).round().astype(int))
    abar = cosine_alphas_cumprod(model.steps)[kept]
    shape = (count, frames, FEATURES)
    x = torch.randn(shape, generator=generator).to(device)
    both = torch.cat([text.expand(count, -1), torch.zeros(count, text.shape[1], device=device)])
    for i in range(len(kept) - 1, -1, -1):
        t = torch.full((2 * count,), int(kept[i]), device=device)
        given, none = network(torch.cat([x, x]), t, both).chunk(2)
        clean = none + model.guidance_scale * (given - none)
        before = abar[i - 1] if i else 1.0
        beta = 1 - abar[i] / before
        # the mean and the variance of q(z before | z now, clean)
        towards = math.sqrt(before) * beta / (1 - abar[i])
        stay = math.sqrt(1 - beta) * (1 - before) / (1 - abar[i])
        x = towards * clean + stay * x
        if i:
            fresh = torch.randn(shape, generator=generator).to(device)
            x = x + math.sqrt(beta * (1 - before) / (1 - abar[i])) * fresh
    positions = rigid(steady(x.double().cpu().numpy() * model.std + model.mean))
    if not np.isfinite(positions).all():
        raise UserError("the motion model gives positions that aren't finite: get its files again")
    return positions


def rigid(positions: Float[np.ndarray, "S T 22 3"]) -> Float[np.ndarray, "S T 22 3"]:
    """Give each bone its mean length over the motion, in the direction it has in each frame."""
    found = positions.copy()
    for joint, parent in enumerate(PARENTS[1:BODY_JOINTS], 1):
        bone = positions[..., joint, :] - positions[..., parent, :]
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        bone *= length.mean(1, keepdims=True) / length
        found[..., joint, :] = found[..., parent, :] + bone
    return found


def positions_of(features: Float[np.ndarray, "S T 263"]) -> Float[np.ndarray, "S T 22 3"]:
    """Return the joints of HumanML3D's features (Guo et al. 2022): 0 is half the angle by which the
    heading turns to the next frame, 1 and 2 the pelvis' velocity on the ground in the next frame's
    heading, 3 its height, 4 to 66 the other joints relative to the pelvis' place on the ground."""
    turn = _headings(features)
    steps = (features[:, :-1, 1] + 1j * features[:, :-1, 2]) * turn[:, 1:]
    pelvis = np.cumsum(np.pad(steps, ((0, 0), (1, 0))), axis=1)
    place = np.stack([pelvis.real, 0 * pelvis.real, pelvis.imag], -1)[:, :, None]
    height = features[..., None, 3:4] * [0, 1, 0]
    return place + np.concatenate([height, _turned(features[..., 4:67], turn)], 2)


def steady(features: Float[np.ndarray, "S T 263"]) -> Float[np.ndarray, "S T 22 3"]:
    """Return the least-squares joints of both :func:`positions_of` and the joints' velocities, 193
    to 258, in which samples are far more exact: without them, feet slide."""
    velocity = _turned(features[..., 193:259], _headings(features))[:, :-1]
    change = np.diff(np.eye(features.shape[1]), axis=0)
    normal = np.eye(features.shape[1]) + VELOCITIES * change.T @ change
    given = VELOCITIES * np.einsum("ft,sf...->st...", change, velocity) + positions_of(features)
    return np.einsum("tf,sf...->st...", np.linalg.inv(normal), given)


def _headings(features: Float[np.ndarray, "S T 263"]) -> Complex[np.ndarray, "S T"]:
    """Return the factors of x + iz from the heading's axes to the world's."""
    return np.exp(2j * np.cumsum(np.pad(features[:, :-1, 0], ((0, 0), (1, 0))), axis=1))


def _turned(vectors: Float[np.ndarray, "S T D"], turn: np.ndarray) -> np.ndarray:
    vectors = vectors.reshape(*turn.shape, -1, 3)
    ground = (vectors[..., 0] + 1j * vectors[..., 2]) * turn[..., None]
    return np.stack([ground.real, vectors[..., 1], ground.imag], -1)


def mdm_files(network: MotionModel, steps: int) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
    """Return the state dict and the settings as MDM's authors publish them."""
    width, layers = network.embed_text.out_features, network.seqTransEncoder.layers
    sizes = {"latent_dim": width, "layers": len(layers), "ff_size": layers[0].linear1.out_features}
    others = {"cond_mask_prob": 0.1, "emb_trans_dec": False, "guidance_param": 1.0}
    places = ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe")
    state = network.state_dict() | dict.fromkeys(places, torch.zeros(1, 1, width))
    return state, SUPPORTED | sizes | {"diffusion_steps": steps} | others
