"""CPU seconds in which the bundled models are loaded, after the libraries are imported.

    python -m benchmarks.models.loading [--rounds 5]

Files are compared with their digests and read from a warm cache of the operating system. The prompt
processor also encodes a prompt with its views, the prior samples ten points in one step. Writes the
medians of the rounds to ``benchmarks/results/loading.csv``."""

import argparse
import statistics
import time
from collections.abc import Callable

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT, commit, machine
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.models.bundled import NAME
from threestudio_gaussiandreamer.toybox import recognition

RESULTS = ROOT / "benchmarks/results/loading.csv"
COLUMNS = ("part", "cpu_seconds", "machine", "commit")
PROMPT = "a red fox with a green scarf"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    register_parts()
    times: dict[str, list[float]] = {name: [] for name in LOADERS}
    for _ in range(rounds + 1):  # the first one imports the libraries, and isn't counted
        for name, load in LOADERS.items():
            start = time.process_time()
            load()
            times[name].append(time.process_time() - start)
    common = {"machine": machine(), "commit": commit()}
    write(RESULTS, COLUMNS, (row_of(name, own[1:]) | common for name, own in times.items()))


def row_of(name: str, times: list[float]) -> dict[str, str]:
    return {"part": name, "cpu_seconds": f"{statistics.median(times):.3f}"}


def load_prompt_processor() -> None:
    options = {"prompt": PROMPT, "negative_prompt": "", "use_cache": False}
    find("gaussiandreamer-stable-diffusion-prompt-processor")(options | MODELS)


def load_guidance() -> None:
    find("gaussiandreamer-stable-diffusion-guidance")(MODELS)


def load_prior() -> None:
    options = {"checkpoint": NAME, "clip": NAME, "upsampler": None}
    find("point-e-prior")(options | {"num_steps": 1, "num_points": 10})(PROMPT)


def load_judge() -> None:
    recognition.load_judge(NAME)


MODELS = {"pretrained_model_name_or_path": NAME}
LOADERS: dict[str, Callable[[], None]] = {
    "prompt processor: tokenizer, text encoder": load_prompt_processor,
    "guidance: autoencoder, U-Net": load_guidance,
    "prior: points, CLIP's text tower": load_prior,
    "judge": load_judge,
}


def table() -> str:
    """Return CPU seconds by part, and their sum."""
    rows = read(RESULTS)
    lines = [(row["part"], f"{float(row['cpu_seconds']):.2f}") for row in rows]
    lines += [("all", f"{sum(float(row['cpu_seconds']) for row in rows):.1f}")]
    return f"{markdown(('part', 'CPU seconds'), lines)}\n\n{rows[0]['machine']}."


if __name__ == "__main__":
    main()
