"""Train the toybox's models: ``python -m threestudio_gaussiandreamer.toybox.train FOLDER``.

Stages run in order, each up to its number of images, and go on from their checkpoints, so the same
command continues a training that was stopped anywhere."""

import argparse
import dataclasses
import functools
import json
import math
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Optional

import torch
from torch import Tensor

from ..core.command import interrupt, run_command
from ..core.errors import UserError, unknown
from ..core.files import existing_file, output_folder
from ..core.options import shown
from ..formats.reading import reading, require
from ..launch.run_folder import claim
from ..models.bundled import MOTION, RECORD
from ..priors.text_to_motion import load_motion_model
from ..view.run_files import read_json
from . import tokens
from .autoencoder_stage import AutoencoderStage
from .clip_stage import TEXT_PARTS, ClipStage, TextStage
from .judge_stage import SEED_OFFSET, JudgeStage, judge_shards
from .loop import Options, Progress, Stage, Training, is_trained
from .motion_stage import MotionStage
from .points_stage import PointsStage
from .unet_stage import LATENT_SCALE, UNetStage
from .views import Shards

IN_ORDER = TextStage, ClipStage, AutoencoderStage, UNetStage, PointsStage, MotionStage, JudgeStage
STAGES: dict[str, type[Stage]] = {stage.name: stage for stage in IN_ORDER}
"""In the order of training: later ones need earlier ones."""
RANGES = {
    **dict.fromkeys(("images", "batch", "pool"), (1, math.inf)),
    **{"workers": (0, math.inf), "minutes": (0.001, math.inf)},
    "seed": (0, SEED_OFFSET - 1),  # larger ones are of the objects that the judge learns from
}
"""Of the options."""


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.train", description="Train the toybox's models."
    )
    add = parser.add_argument
    add("folder", type=Path, help="pictures, checkpoints and curves; continued if it exists")
    add("--stages", nargs="+", default=list(STAGES), help=f"of {', '.join(STAGES)}; default: all")
    add("--images", type=int, help="a stage's end; default: its own number of pictures")
    add("--minutes", type=float, default=math.inf, help="a stage's end, if that comes earlier")
    add("--from-weights", type=Path, help="folder of toybox.export to start from")
    add("--seed", type=int, default=0)
    add("--device", default="cpu", help="cpu or cuda")
    bfloat16 = "bfloat16: autocast, on a GPU or a CPU that multiplies it"
    add("--precision", choices=["float32", "bfloat16"], default="float32", help=bfloat16)
    add("--batch", type=int, help="pictures of one step; default: the stage's own")
    add("--pool", type=int, default=40, help="shards of 1024 pictures, visited cyclically")
    workers = "processes that render all shards first and make the batches afterwards"
    add("--workers", type=int, default=0, help=workers)
    return parser.parse_args(argv)


def options_of(args: argparse.Namespace) -> Options:
    """Return the checked options."""
    for name in args.stages:
        if name not in STAGES:
            raise unknown("stage", name, STAGES)
    for name, (low, high) in RANGES.items():
        value = getattr(args, name)
        if value is not None and not low <= value <= high:
            raise UserError(f"--{name} {shown(value)}: expected a number from {low} to {high}")
    gpus = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    devices = ["cpu", *["cuda"][: len(gpus)], *gpus]
    if args.device not in devices:
        raise unknown("device", args.device, devices)
    given = {field.name for field in dataclasses.fields(Options)} & set(vars(args))
    return Options(**{name: getattr(args, name) for name in given})


def render_shards(sorts: Sequence[Shards], count: int, workers: int) -> None:
    """Render the missing ones of the first ``count`` shards of each sort, in parallel."""
    jobs = [(shards, index) for shards in sorts for index in range(count)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(Shards.ensure, *zip(*jobs, strict=True)), 1):
            print(f"rendered {done}/{len(jobs)} shards", flush=True)


def train(
    options: Options, stages: Sequence[str], images: Optional[int] = None, seconds=math.inf
) -> None:
    """Train the stages in order, each until ``images`` were seen or ``seconds`` have passed.

    Raises:
        UserError: another process trains one of them in this folder.
        Terminated, KeyboardInterrupt: a signal stopped one, after it wrote its checkpoint."""
    for name in (name for name in STAGES if name in stages):
        # another process's checkpoints would replace these
        busy = f"another process trains the stage {name!r}"
        claimed = claim(options.folder / "locks" / name, busy, ", or give another folder")
        try:
            training = Training(STAGES[name](options))
            progress = training.run(images, seconds)
        finally:
            claimed.release()
        hours = progress.seconds / 3600
        print(f"{name}: {progress.images} images in {hours:.2f} hours", flush=True)
        if training.signum:
            interrupt(training.signum)


def start_from(weights: Path, options: Options, stages: Sequence[str]) -> None:
    """Write checkpoints of ``weights``, a folder that ``toybox.export`` wrote, for the stages up to
    the last of ``stages``, unless the training folder has them. Optimisers start without state;
    attribute classifiers, which aren't published, and new words and classes start at random.

    Raises:
        UserError: a file is missing or damaged, or holds another model."""
    with reading(weights / RECORD, "record of the toybox's weights") as path:
        record = {name: dict(seen) for name, seen in json.loads(path.read_bytes()).items()}
        require(bool(record), "it names no network")
    vocabulary = read_json(existing_file(weights / "clip/vocab.json", "vocabulary"), dict)
    known = tokens.open_tokenizer(options.folder).get_vocab()
    tokens_kept = [(known[token], row) for token, row in vocabulary.items() if token in known]
    for name in list(STAGES)[: 1 + max(map(list(STAGES).index, stages))]:
        if name not in record or is_trained(options.folder, name):
            continue
        training, seen = Training(STAGES[name](options)), record[name]
        try:
            own = training.model.state_dict()
            unpublished = {k: v for k, v in own.items() if "heads." in k or "clip.text_" in k}
            state = grown(read_weights(weights, name), own, tokens_kept)
            training.model.load_state_dict(unpublished | state)
            if name == "unet":
                vae = read_json(weights / "stable-diffusion/vae/config.json", dict)
                training.stage.constants[LATENT_SCALE] = float(vae["scaling_factor"])
            if name == "motion":
                found = load_motion_model(str(weights / MOTION))
                training.stage.constants |= {"mean": found.mean.tolist(), "std": found.std.tolist()}
        except (RuntimeError, KeyError) as error:
            raise UserError(
                f"the weights of {name!r} in {str(weights)!r} are of another model than those "
                f"of this version: {error}"
            ) from error
        training.ema.module.load_state_dict(training.model.state_dict())
        training.ema.n_averaged.fill_(seen["steps"])
        progress = training.progress = Progress(seen["steps"], seen["images"])
        progress.history = [seen["last"]] if seen["last"] else []
        progress.measured, progress.earlier = seen["withheld"], seen["trainings"]
        training.save()


def grown(
    state: dict[str, Tensor], own: dict[str, Tensor], tokens_kept: Sequence[tuple[int, int]]
) -> dict[str, Tensor]:
    """Return weights with embeddings and classifiers of the sizes in ``own``, from which new tokens
    and new classes, which are appended to the others, take their rows.

    Args:
        tokens_kept: the new row and the old one of each known token."""
    found = dict(state)
    for name, value in state.items():
        embeds = "token_embedding" in name
        if embeds or "heads." in name and len(own[name]) > len(value):
            pairs = tokens_kept if embeds else [(row, row) for row in range(len(value))]
            to, of = torch.tensor(pairs).T
            found[name] = own[name].index_copy(0, to, value[of])
    return found


def read_weights(weights: Path, name: str) -> dict[str, Tensor]:
    """Read an export's weights of a stage, float32; of "clip" all but the text encoder."""
    from safetensors.torch import load_file
    from transformers import CLIPModel

    if name in ("text", "clip"):
        state = CLIPModel.from_pretrained(weights / "clip").float().state_dict()
        prefix = "" if name == "text" else "clip."
        kept = (key for key in state if key.startswith(TEXT_PARTS) == (name == "text"))
        return {f"{prefix}{key}": state[key] for key in kept}
    if name == "motion":
        return load_motion_model(str(weights / MOTION)).network.state_dict()
    of_diffusion = "stable-diffusion/{}/diffusion_pytorch_model.safetensors"
    files = {"autoencoder": of_diffusion.format("vae"), "unet": of_diffusion.format("unet")}
    path = existing_file(weights / files.get(name, f"{name}.safetensors"), "weights")
    return {key: value.float() for key, value in load_file(path).items()}


def run(args: argparse.Namespace) -> None:
    """Check the options, and train."""
    options = options_of(args)
    output_folder(options.folder, "FOLDER")
    if args.workers:
        of_judge = judge_shards(options) if JudgeStage.name in args.stages else ()
        workers = min(args.workers, os.cpu_count() or 1)
        render_shards([options.shards, *of_judge], options.pool, workers)
    if args.from_weights:
        start_from(args.from_weights, options, args.stages)
    train(options, args.stages, args.images, 60 * args.minutes)


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
