"""Distil classifier-free guidance of the toybox's U-Net into a U-Net that takes the scale as an
input (Meng et al. 2023, arXiv:2210.03142, stage one): one evaluation per view in place of two.

    python -m threestudio_gaussiandreamer.toybox.train TRAINING --from-weights MODELS \\
        --stages unet --images 1
    python -m benchmarks.models.distil_guidance TRAINING MODELS OUT --minutes 12
    python -m benchmarks.quality.toybox --charts default --models OUT --out FOLDER

MODELS is the folder of an export, such as the bundled one, TRAINING a folder of ``toybox.train``
that starts from it, and OUT a copy of MODELS with the new U-Net. Scales are uniform between 1 and
8. Prints the squared error on withheld objects at scale 4, relative to that of the prediction
without guidance, from which the training starts."""

import argparse
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance.scale_input import scale_input
from threestudio_gaussiandreamer.models.bundled import write_digests
from threestudio_gaussiandreamer.toybox.checkpoints import averaged_weights
from threestudio_gaussiandreamer.toybox.loop import Options
from threestudio_gaussiandreamer.toybox.unet_stage import UNetBatch, UNetStage

WIDTH = 64
"""Of the scale's embedding."""
LARGEST_SCALE, HELD_OUT_SCALE = 8.0, 4.0
BATCH, HELD_OUT = 32, 64
RATE, WARMUP, EMA_DECAY = 4e-4, 30, 0.99
REPORT = 40


class Case(NamedTuple):
    """A batch of the U-Net's inputs and its target."""

    z: Float[Tensor, "B 4 s s"]
    t: Int[Tensor, " B"]
    tokens: Float[Tensor, "B N F"]
    scale: float
    conditional: Float[Tensor, "B 4 s s"]
    guided: Float[Tensor, "B 4 s s"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("training", type=Path, help="folder of toybox.train")
    parser.add_argument("models", type=Path, help="folder of toybox.export")
    parser.add_argument("out", type=Path, help="folder for the models with the new U-Net")
    parser.add_argument("--minutes", type=float, default=12.0, help="of CPU time")
    parser.add_argument("--pool", type=int, default=24, help="shards of training pictures")
    arguments = parser.parse_args()
    stage = UNetStage(Options(folder=arguments.training, batch=BATCH, pool=arguments.pool))
    stage.model.load_state_dict(averaged_weights(arguments.training, UNetStage.name))
    student = distil(stage, 60 * arguments.minutes)
    shutil.copytree(arguments.models, arguments.out, dirs_exist_ok=True)
    student.half().save_pretrained(str(arguments.out / "stable-diffusion" / "unet"))
    write_digests(arguments.out)


def distil(stage: UNetStage, seconds: float) -> nn.Module:
    """Train for so many CPU seconds; return the averaged student."""
    student = student_of(stage.model)
    average = AveragedModel(student, multi_avg_fn=get_ema_multi_avg_fn(EMA_DECAY))
    optimizer = torch.optim.Adam(student.parameters(), betas=(0.9, 0.99))
    held_out = case_of(stage, held_out_batch(stage), HELD_OUT_SCALE)
    rng = torch.Generator().manual_seed(0)
    start = time.process_time()
    for step, batch in enumerate(stage.batches(0)):
        share = (time.process_time() - start) / seconds
        if share >= 1:
            break
        optimizer.param_groups[0]["lr"] = rate_at(step, share)
        scale = 1 + (LARGEST_SCALE - 1) * float(torch.rand((), generator=rng))
        case = case_of(stage, batch, scale)
        optimizer.zero_grad(set_to_none=True)
        (error(student, case) / (1 + (scale - 1) / 2) ** 2).backward()
        nn.utils.clip_grad_norm_(student.parameters(), 1.0)
        optimizer.step()
        average.update_parameters(student)
        if step % REPORT == 0:
            print(f"step {step}: error {relative_error(average.module, held_out):.3f}", flush=True)
    print(f"{step} steps: error {relative_error(average.module, held_out):.3f}")
    return average.module


def held_out_batch(stage: UNetStage) -> UNetBatch:
    """Return pictures of withheld objects, at timesteps from the first to the last."""
    [(_, batch), *_] = stage.held_out
    batch = UNetBatch(*(value[:HELD_OUT] for value in batch[:4]))
    return batch._replace(t=torch.linspace(20, 980, HELD_OUT).long())


def rate_at(step: int, share: float) -> float:
    """Return the learning rate: it rises in the first steps and falls in the second half."""
    return RATE * min(1.0, (step + 1) / WARMUP) * min(1.0, 2 * (1 - share) + 0.02)


def student_of(teacher: Any) -> Any:
    """Copy a U-Net into one that takes the scale, on which its output doesn't depend yet."""
    options = {name: value for name, value in teacher.config.items() if name[0] != "_"}
    student = type(teacher)(**options | {"time_cond_proj_dim": WIDTH})
    student.load_state_dict(teacher.state_dict(), strict=False)
    nn.init.zeros_(student.time_embedding.cond_proj.weight)
    return student


@torch.no_grad()
def case_of(stage: UNetStage, batch: UNetBatch, scale: float) -> Case:
    """Return the inputs of a batch, and what the teacher predicts with guidance."""
    z = sds.add_noise(batch.latents * stage.scale, batch.noise, stage.alphas_cumprod[batch.t])
    tokens = stage.text_model(batch.ids).last_hidden_state
    empty = stage.tokens([""]).expand_as(tokens)
    both = (stage.model(z, batch.t, encoder_hidden_states=each).sample for each in (tokens, empty))
    conditional, unconditional = both
    guided = sds.classifier_free(conditional, unconditional, scale)
    return Case(z, batch.t, tokens, scale, conditional, guided)


def error(student: nn.Module, case: Case) -> Tensor:
    inputs = scale_input(case.scale, WIDTH, len(case.z))
    predicted = student(case.z, case.t, encoder_hidden_states=case.tokens, **inputs).sample
    return (predicted - case.guided).square().mean()


@torch.no_grad()
def relative_error(student: nn.Module, case: Case) -> float:
    """Return the squared error relative to that of the prediction without guidance."""
    return float(error(student, case) / (case.conditional - case.guided).square().mean())


if __name__ == "__main__":
    main()
