"""CLIP similarity of pictures of a result and its prompt, measured as in the paper:
``python -m threestudio_gaussiandreamer.evaluation.clip_similarity RUN_OR_PLY ... --clip FOLDER``

The paper's protocol (appendix; from Instant3D): of 120 views at radius 4 and elevation 15 degrees,
at azimuths -180, -177, ..., 177, ten are drawn at random, and their similarities with the text, 100
times the cosine of CLIP's features, averaged. docs/evaluation.md has what the paper leaves open."""

import argparse
import functools
import math
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import register_parts
from ..cameras import Orbit
from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import existing_file, json_text, output_folder, write_file
from ..core.options import RULE, between, in_range
from ..core.streams import numpy_generator
from ..host import get_device
from ..images import write as write_image
from ..models.bundled import CLIP, NAME, model_part
from ..models.clip import PictureText, clip_source
from ..toybox.views import DISTANCE, FOVY_DEG, SIZE
from ..training.data import MAX_SIDE
from .results import Result, find_result, read_result, render_views
from .t3bench import require_folder_names, write_meshes

FILES = ("clip.json", "clip.png")
PERCENT, THUMBNAIL = 100.0, 160
PIXELS = in_range(1, MAX_SIDE, "pixels")


class Protocol(NamedTuple):
    """The views that are compared: the paper's; the released code's where the paper gives none."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    views: int = 120
    drawn: int = 10
    radius: float = 4.0
    elevation_deg: float = 15.0
    fovy_deg: float = 70.0
    size: int = 1024

    @property
    def orbit(self) -> Orbit:
        return self.at(-180 + 360 * torch.arange(self.views) / self.views)

    def at(self, azimuth: Float[Tensor, " V"]) -> Orbit:
        """Return the cameras at these azimuths, degrees."""
        ones = torch.ones_like(azimuth)
        fovy = math.radians(self.fovy_deg) * ones
        return Orbit(self.elevation_deg * ones, azimuth, self.radius * ones, fovy)

    def draw(self, seed: int, item: int) -> Int[np.ndarray, " drawn"]:
        """Draw the indices of the views of result number ``item``, distinct and ascending."""
        generator = numpy_generator(seed, "clip-views", item=item)
        return np.sort(generator.choice(self.views, self.drawn, replace=False))


def has_own_cameras(clip: Optional[str]) -> bool:
    """Return whether a CLIP, as given to :func:`open_clip`, is the toybox's."""
    return bool(clip) and model_part(clip, CLIP) != clip


def protocol_for(clip: Optional[str], **options: Any) -> Protocol:
    """Return the paper's protocol with options replaced; the toybox's CLIP has its own cameras."""
    if has_own_cameras(clip):
        options |= {"radius": sum(DISTANCE) / 2, "fovy_deg": FOVY_DEG, "size": SIZE}
    return Protocol(**options)


def open_clip(folder: str) -> PictureText:
    """Load the CLIP in a local folder in transformers' format, or the bundled one."""
    if folder != NAME and not Path(folder).expanduser().is_dir():
        command = "`hf download openai/clip-vit-large-patch14 --local-dir clip`"
        raise UserError(f"--clip {folder}: expected a folder, for instance after {command}")
    source = clip_source(folder, option="--clip", allow_bin=True)
    return PictureText(source, get_device(), allow_bin=True)


def score(
    result: Result, prompt: str, item: int, clip: PictureText, protocol: Protocol
) -> tuple[Float[np.ndarray, " S"], list[np.ndarray]]:
    """Return a result's score for each seed, and the views of the first one, uint8."""
    from PIL import Image

    draws = [protocol.draw(seed, item) for seed in protocol.seeds]
    needed = np.unique(np.concatenate(draws))
    orbit = protocol.orbit.rows(needed)
    similarity, thumbnails = np.full(protocol.views, np.nan), {}
    left = iter(needed)
    how = {"background": result.background, "antialias": result.antialiased}
    views = orbit.c2w, orbit.fovy, protocol.size
    for images in render_views(read_result(result), *views, **how):
        rows = list(islice(left, len(images)))
        similarity[rows] = PERCENT * clip.similarities(images, prompt)
        for row, image in zip(rows, images, strict=True):
            small = Image.fromarray((image * 255).round().astype(np.uint8))
            thumbnails[row] = np.asarray(small.resize((THUMBNAIL, THUMBNAIL), Image.LANCZOS))
    means = np.array([similarity[draw].mean() for draw in draws])
    return means, [thumbnails[row] for row in draws[0]]


def _mean_and_spread(per_seed: Float[np.ndarray, " S"]) -> dict[str, Any]:
    spread = float(per_seed.std(ddof=1)) if len(per_seed) > 1 else None
    return {"mean": float(per_seed.mean()), "std": spread, "per_seed": per_seed.tolist()}


def prompts_for(
    results: Sequence[Result], prompt: Optional[str], prompts_file: Optional[str]
) -> list[str]:
    """Return the prompt of each result: ``prompt``, the file's non-empty lines in the order of the
    results, such as T3Bench's ``data/prompt_single.txt``, or the prompts of their runs.
    """
    if prompts_file is not None:
        file = existing_file(prompts_file, "list of prompts")
        try:
            text = file.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise UserError(f"--prompts-file {prompts_file} is no UTF-8 text: {error}") from error
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if len(lines) != len(results):
            said = f"has {len(lines)} prompts for {len(results)} results: give a line for each"
            raise UserError(f"--prompts-file {prompts_file} {said}")
        return lines
    prompts = [prompt if prompt is not None else result.prompt for result in results]
    if None in prompts:
        file = str(results[prompts.index(None)].file)
        raise UserError(f"what was {file!r} made from? Give --prompt or --prompts-file")
    return prompts


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    paper = Protocol()
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.clip_similarity",
        description="CLIP similarity, as in the paper.",
    )
    add = parser.add_argument
    add("results", nargs="+", help="a run's folder, or a PLY of Gaussians")
    add("--clip", help="CLIP folder in transformers' format, or toybox (bundled)")
    texts = parser.add_mutually_exclusive_group()
    texts.add_argument("--prompt", help="the text of all; default: what each run was asked for")
    texts.add_argument("--prompts-file", help="one prompt for each result, a line each")
    add("--output", default="evaluation", help="folder for clip.json and clip.png")
    add("--seeds", type=int, nargs="+", default=list(paper.seeds))
    add("--size", type=int, help=f"width and height, pixels (default: {paper.size})")
    add("--fovy", type=float, help=f"vertical field of view, degrees (default: {paper.fovy_deg:g})")
    meshes = "also write a mesh of every result for T3Bench's scripts; see docs/evaluation.md"
    add("--t3bench", metavar="FOLDER", help=meshes)
    groups = ["single", "surr", "multi"]
    add("--t3bench-group", default="single", choices=groups, help="the list of its prompts")
    add("--t3bench-method", default="gaussiandreamer", help="its name for what made the results")
    return parser.parse_args(argv)


def protocol_of(args: argparse.Namespace) -> Protocol:
    """Check the options and return them as a :class:`Protocol`."""
    given = {"seeds": tuple(args.seeds)}
    for option, name, rule in (("size", "size", PIXELS), ("fovy", "fovy_deg", between(0, 180))):
        if (value := getattr(args, option)) is not None:
            rule[RULE](f"--{option}", value)
            given[name] = value
            if has_own_cameras(args.clip):
                raise UserError(f"--{option} has no effect with --clip {args.clip}")
    return protocol_for(args.clip, **given)


def run(args: argparse.Namespace) -> None:
    """Evaluate the results; options, results and prompts are checked before the first render."""
    register_parts()
    protocol = protocol_of(args)
    results = [find_result(place) for place in args.results]
    prompts = prompts_for(results, args.prompt, args.prompts_file)
    if not (args.clip or args.t3bench):
        raise UserError("nothing to do: give --clip FOLDER, --t3bench FOLDER, or both")
    if args.t3bench:
        require_folder_names(args.t3bench_method, prompts)
        output_folder(args.t3bench, "--t3bench")
    if args.clip:
        output = output_folder(args.output, "--output", FILES)
        evaluate(results, prompts, args.clip, protocol, output)
    if args.t3bench:
        folder, name = Path(args.t3bench), f"{args.t3bench_method}_{args.t3bench_group}"
        write_meshes(folder.expanduser(), name, results, prompts)


def evaluate(
    results: Sequence[Result],
    prompts: Sequence[str],
    clip_folder: str,
    protocol: Protocol,
    output: Path,
) -> None:
    """Score all results, print the scores, and write ``clip.json`` and ``clip.png``."""
    from PIL import Image, ImageDraw

    clip, scores, each, rows = open_clip(clip_folder), [], [], []
    for item, (result, prompt) in enumerate(zip(results, prompts, strict=True)):
        per_seed, views = score(result, prompt, item, clip, protocol)
        scores.append(per_seed)
        numbers = _mean_and_spread(per_seed)
        text = f"{numbers['mean']:.2f}  {prompt}"
        canvas = Image.fromarray(np.concatenate(views, axis=1))
        ImageDraw.Draw(canvas).text((2, 0), text, fill="black", stroke_width=1, stroke_fill="white")
        rows.append(canvas)
        each.append({"result": str(result.file), "prompt": prompt, **numbers})
        print(f"{numbers['mean']:6.2f}  {prompt}  {result.file}", flush=True)
    total = _mean_and_spread(np.mean(scores, axis=0))
    about = {"clip": clip_folder, "unit": "100 * cosine", "protocol": protocol._asdict()}
    text = json_text({**about, **total, "results": each}, indent=2, ensure_ascii=False)
    write_file(output / "clip.json", text)
    write_image(output / "clip.png", np.concatenate(rows, axis=0))
    spread = total["std"] and f" +- {total['std']:.2f} over {len(protocol.seeds)} seeds"
    print(f"{total['mean']:6.2f}{spread or ''}: {output / 'clip.json'}, {output / 'clip.png'}")


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
