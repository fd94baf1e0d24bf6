"""From prompts to clouds with the bundled models, as a demonstration.

``demo [PROMPT ...] [key=value ...]`` trains configs/toybox.yaml on each prompt, or
configs/toybox-avatar.yaml where a person does something. It writes a contact sheet (the prior, of a
person pose and body; the result; what the 2D model itself draws) and a table of what the judge
recognises into a new folder of ``outputs/demo``. After Ctrl-C the same command continues."""

import argparse
import functools
import math
import re
import subprocess
import sys
import textwrap
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .. import images, register_parts
from ..cameras import Orbit
from ..core.command import interrupt, raised_signals, run_command
from ..core.errors import Terminated, UserError
from ..core.files import json_text, output_folder, write_file
from ..core.streams import generator
from ..diffusion import sds
from ..evaluation.asset_metrics import ATTRIBUTES, Scores, prior_of, rendered, result_of
from ..formats.array_files import read_arrays
from ..host import find
from ..launch.run_folder import RunFolder, claim, claim_new
from ..models.bundled import MOTION, NAME, is_export, model_part
from ..priors.body_pose import JOINTS, PARENTS, Z_UP, facing
from ..priors.motion_text import motion_sentence, reduced_prompt
from ..priors.text_to_motion import load_motion_model
from ..view.run_files import read_json
from . import recognition
from .views import BACKGROUND, SIZE
from .words import NOUNS

PROMPTS = (
    "a red fox with a green scarf",
    "a blue mug with white dots",
    "a person in a blue shirt and red trousers kicks with the right leg",
)
"""The last is of a combination that the models were not trained on."""
OBJECT, AVATAR = "toybox.yaml", "toybox-avatar.yaml"
PEOPLE = "|".join((*NOUNS["person"], "someone", "persons", "people", "men", "women"))
PERSON = re.compile(rf"\b({PEOPLE})\b", re.IGNORECASE)
SHOWN = [1, 3, 5]
"""Which of the judge's views the sheet has: from the front, the left and the back."""
GUIDANCE, SAMPLE_STEPS = 3.0, 25
"""Guidance scale and steps of the 2D model's own pictures."""
RECORD, SHEET, TABLE = "demo.json", "sheet.png", "table.md"
STAGES = ("prior", "result", "2D model")
LINE = 11
"""Pixels from line to line of the sheet's texts."""
Stages = dict[str, tuple[Float[Tensor, "V 3 s s"], dict[str, float]]]
"""Pictures and scores of one prompt, by stage."""


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line; arguments of the form key=value are options of the runs."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.toybox.demo",
        description="From prompts to clouds with the bundled models.",
    )
    add = parser.add_argument
    add("prompts", nargs="*", metavar="PROMPT|KEY=VALUE", help="default: three prompts")
    add("--models", default=NAME, help="toybox, or a folder of toybox.export")
    add("--output", default="outputs/demo", help="folder for a new folder of results")
    args = parser.parse_intermixed_args(argv)
    # a prompt has a space before its first =, if any
    args.options = [word for word in args.prompts if re.match(r"[^ ]*=", word)]
    args.prompts = [word for word in args.prompts if word not in args.options] or list(PROMPTS)
    return args


def run(args: argparse.Namespace) -> int:
    """Train the prompts that aren't finished, then write sheet and table; return the exit code."""
    for prompt in args.prompts:
        if not prompt.strip():
            raise UserError(f'a prompt is empty: give one such as "{PROMPTS[0]}"')
        if prompt.encode(errors="replace").decode() != prompt:
            raise UserError(f"the prompt {prompt!r} isn't valid UTF-8")
    if args.models != NAME and not is_export(Path(args.models).expanduser()):
        raise UserError(f"--models {args.models}: expected {NAME}, or a folder of toybox.export")
    for prompt in args.prompts:
        if config_of(prompt) == AVATAR:  # as the run does, but before the others' training
            motion_sentence(prompt, load_motion_model(model_part(args.models, MOTION)).known)
    root = output_folder(args.output, "--output")
    recognition.load_judge(args.models)  # a missing file is reported before the training
    claimed = open_folder(root, {key: vars(args)[key] for key in ("prompts", "options", "models")})
    names = (re.sub(r"[^a-z0-9]+", "_", p.lower())[:40] for p in args.prompts)
    try:
        runs = [claimed.path / "runs" / f"prompt{i}_{name}" for i, name in enumerate(names, 1)]
        for index in range(len(runs)):
            if code := train(claimed.path, index, runs[index], args):
                return code
        register_parts()
        write_results(claimed.path, args, runs)
    finally:
        claimed.release()
    return 0


def open_folder(root: Path, record: dict[str, Any]) -> RunFolder:
    """Lock the newest unfinished folder of the same prompts and options, or else a new one."""
    for path in sorted(root.glob(f"*/{RECORD}"), reverse=True):
        if read_json(path, dict) == record and not (path.parent / SHEET).exists():
            print(f"continuing {path.parent}", flush=True)
            return claim(path.parent, "another demo is working", "")
    claimed = claim_new(root / datetime.now().strftime("%Y%m%d-%H%M%S"))
    write_file(claimed.path / RECORD, json_text(record, indent=1))
    return claimed


# ---- training ------------------------------------------------------------------------------------


def train(folder: Path, index: int, place: Path, args: argparse.Namespace) -> int:
    """Train one prompt unless that is done; return the launcher's exit code."""
    prompt, text = args.prompts[index], folder / f"prompt{index + 1}.txt"
    record = read_json(place.with_suffix(".json"), dict)
    if record.get("finished"):
        return 0
    write_file(text, prompt, durable=False)
    print(f"\n{index + 1}/{len(args.prompts)}: {prompt}", flush=True)
    place.parent.mkdir(exist_ok=True)
    start, code = time.monotonic(), None
    try:
        code = launch(config_of(prompt), [
            f"exp_root_dir={folder}",
            "name=runs",
            f"tag={place.name}",
            "use_timestamp=false",
            "resume=auto",
            f"system.prompt_processor.prompt_file={text}",
            f"system.guidance.pretrained_model_name_or_path={args.models}",
            *args.options,
        ])  # fmt: skip
    finally:
        seconds = round(record.get("seconds", 0.0) + time.monotonic() - start, 1)
        done = json_text({"seconds": seconds, "finished": code == 0})
        write_file(place.with_suffix(".json"), done)
    return code


def config_of(prompt: str) -> str:
    """Return the configuration: that of avatars for a prompt with a person and a verb of motion."""
    return AVATAR if PERSON.search(prompt) and reduced_prompt(prompt) else OBJECT


def launch(config: str, options: list[str]) -> int:
    """Run the launcher in a process of its own, and wait for it even after Ctrl-C: it has received
    the signal too, and writes a checkpoint. Return its exit code."""
    program = [sys.executable, "-m", "threestudio_gaussiandreamer.launch.experiment"]
    with raised_signals() as received:
        process = subprocess.Popen([*program, "--config", config, "--train", *options])
        code = None
        while code is None:
            try:
                code = process.wait()
            except KeyboardInterrupt:
                pass
            except Terminated:
                process.terminate()
    if received:
        print("the same command continues", flush=True)
        interrupt(received[0])
    return code


# ---- results -------------------------------------------------------------------------------------


def write_results(folder: Path, args: argparse.Namespace, runs: list[Path]) -> None:
    """Write the table and the contact sheet, and print where everything is."""
    scores, pairs = Scores(args.models), zip(args.prompts, runs, strict=True)
    stages = [stages_of(prompt, place, args.models, scores) for prompt, place in pairs]
    text = table(args.prompts, runs, stages)
    write_file(folder / TABLE, f"{text}\n")
    pictures = torch.cat([each[name][0] for each in stages for name in STAGES])
    shown = {OBJECT: STAGES, AVATAR: ("pose, body", *STAGES[1:])}
    first = [f"{name}: {prompt}" for prompt in args.prompts for name in shown[config_of(prompt)]]
    texts = [text for one in first for text in (one, *[""] * (len(SHOWN) - 1))]
    sheet = contact_sheet(pictures, texts, columns=len(STAGES) * len(SHOWN))
    images.write(folder / SHEET, sheet)
    print(f"\n{text}\n\n{folder / SHEET}\n{folder / TABLE}")
    for place in runs:
        print(*(str(path) for path in sorted(place.glob("save/it*-export/view.html"))))


def stages_of(prompt: str, place: Path, models: str, scores: Scores) -> Stages:
    """Draw and score the prior, the result and the 2D model's own samples."""
    result = result_of(place, prompt)
    assets = {"prior": prior_of(place, result), "result": result}
    found, views = {}, recognition.views()
    for name, asset in assets.items():
        pictures = rendered(asset, views.rows(SHOWN), SIZE, background=BACKGROUND)
        found[name] = torch.from_numpy(pictures).movedim(-1, 1), scores.of_asset(asset)
    arrays = read_arrays(place / "save/prior/points.npz", "prior", [], ["joints"])
    if "joints" in arrays:  # of a motion
        pose = stick_figure(arrays["joints"], views.azimuth[SHOWN[0]])
        body, rates = found["prior"]
        found["prior"] = torch.cat([pose[None], body[:-1]]), rates
    own = samples(models, prompt, views, guidance_scale=GUIDANCE)
    return found | {"2D model": (own[SHOWN], scores.of_pictures(own, prompt))}


def stick_figure(joints: Float[np.ndarray, "K 3"], azimuth: float) -> Float[Tensor, "3 s s"]:
    """Draw a pose (y up) as seen from this azimuth, degrees: its left blue, its right red."""
    from PIL import Image, ImageDraw

    places, angle = joints[:, Z_UP] @ facing(joints).T, math.radians(azimuth)
    flat = places @ np.array([[-math.sin(angle), 0], [math.cos(angle), 0], [0, -1]])
    low, high = flat.min(0), flat.max(0)
    flat = SIZE * (0.5 + 0.8 * (flat - (low + high) / 2) / (high - low).max())
    picture = Image.new("RGB", (SIZE, SIZE), tuple(round(255 * value) for value in BACKGROUND))
    for joint, parent in enumerate(PARENTS[1:], 1):
        color = {"left": "blue", "right": "red"}.get(JOINTS[joint].split()[0], "white")
        ends = [tuple(flat[joint]), tuple(flat[parent])]
        ImageDraw.Draw(picture).line(ends, fill=color, width=SIZE // 40)
    return torch.from_numpy(np.asarray(picture) / np.float32(255)).movedim(-1, 0)


@torch.no_grad()
def samples(
    model: str, prompt: str, orbit: Orbit, *, guidance_scale: float, seed: int = 0
) -> Float[Tensor, "V 3 s s"]:
    """Draw a picture in [0, 1] with the 2D model itself for the direction of each view, by DDIM;
    prompts name left and right.

    Args:
        model: ``toybox``, a folder or a hub id.
        guidance_scale: of classifier-free guidance; 1 is none."""
    named = {"pretrained_model_name_or_path": model}
    texts = {"prompt": prompt, "negative_prompt": "", "view_dependent_left_and_right": True}
    processor = find("gaussiandreamer-stable-diffusion-prompt-processor")
    prompts = processor({**named, **texts, "use_cache": False})
    guidance = find("gaussiandreamer-stable-diffusion-guidance")(
        {**named, "guidance_scale": guidance_scale}
    )
    condition = guidance.condition(
        prompts(), elevation=orbit.elevation, azimuth=orbit.azimuth, camera_distances=orbit.distance
    )
    side = guidance.image_size // 2 ** (len(guidance.vae.config.block_out_channels) - 1)
    shape = (len(orbit.azimuth), guidance.vae.config.latent_channels, side, side)
    noise = torch.randn(shape, generator=generator(seed, "toybox-samples")).to(guidance.device)
    abar = guidance.alphas_cumprod.to(guidance.device)
    t = torch.full((len(noise),), len(abar) - 1, device=guidance.device)
    latents = sds.ddim_sample(
        lambda z, t: guidance.predict_noise(z, t, condition), noise, t, abar, steps=SAMPLE_STEPS
    )
    return guidance.decode(latents).cpu()


def contact_sheet(
    images: Float[Tensor, "N 3 H W"], texts: Sequence[str] = (), columns: int = 10
) -> UInt8[np.ndarray, "h w 3"]:
    """Arrange pictures (values in [0, 1]) in rows, each with its whole text below it."""
    from PIL import Image, ImageDraw

    height, width = images.shape[-2:]
    wrapped = [textwrap.wrap(text, width // 6) for text in texts] or [[]] * len(images)
    most = max(map(len, wrapped), default=0)
    cell = height + (most * LINE + 3 if most else 0)
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * width, rows * cell), "white")
    draw = ImageDraw.Draw(sheet)
    pixels = (images.clamp(0, 1) * 255).round().byte().movedim(1, -1).cpu().numpy()
    for index, image in enumerate(pixels):
        x, y = index % columns * width, index // columns * cell
        sheet.paste(Image.fromarray(image), (x, y))
        for line, words in enumerate(wrapped[index]):
            draw.text((x + 2, y + height + line * LINE), words, fill="black")
    return np.asarray(sheet)


def table(prompts: Sequence[str], runs: Sequence[Path], stages: Sequence[Stages]) -> str:
    """Return a Markdown table with a line for each prompt and stage."""
    known = {key for each in stages for _, scores in each.values() for key in scores}
    names = [*ATTRIBUTES, *(name for name in ("action", "sides") if name in known)]
    head = ("prompt", "", *names, "multi-face", "seconds")
    lines = [head, ("---",) * len(head)]
    for prompt, place, each in zip(prompts, runs, stages, strict=True):
        seconds = read_json(place.with_suffix(".json"), dict).get("seconds", math.nan)
        for name in STAGES:
            scores = each[name][1]
            found = [scores.get(key, math.nan) for key in names]
            cells = ["" if math.isnan(value) else "yes" if value else "no" for value in found]
            rate = scores.get("multi_face", math.nan)
            took = f"{seconds:.0f}" if name == "result" else ""
            text = textwrap.shorten(prompt, 60, placeholder=" ...").replace("|", "\\|")
            lines.append((text, name, *cells, "" if math.isnan(rate) else f"{rate:.0%}", took))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
