"""Fewer Gaussians of a finished cloud: dB to the original, in the test views of the prune command,
by that command, by ``splat-transform --decimate``, and by the highest contributions or opacities.

    npm install @playcanvas/splat-transform    # its rows are left out where it isn't on the PATH
    python -m benchmarks.quality.decimate CLOUD.ply [--counts 10000 5000 2500 1250]"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.markdown import markdown
from threestudio_gaussiandreamer.gaussians.simplify import keep_best
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_with_contribution
from threestudio_gaussiandreamer.prune.options import PruneOptions
from threestudio_gaussiandreamer.prune.pipeline import read, views_of

PROGRAM = "splat-transform"
PRUNE = [sys.executable, "-m", "threestudio_gaussiandreamer.prune"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cloud", help="a PLY of Gaussians")
    parser.add_argument("--counts", type=int, nargs="+", default=[10000, 5000, 2500, 1250])
    arguments = parser.parse_args()
    stored = read(arguments.cloud)
    original, (_, seen, unseen) = stored.gaussians.tensors("cpu"), views_of(stored, PruneOptions())
    truth, _ = render_with_contribution(original, unseen)
    _, contribution = render_with_contribution(original, seen)
    scores = {"highest contribution": contribution, "highest opacity": original.logit_opacities}
    commands = {"prune --count": [*PRUNE, arguments.cloud, "OUT", "--count", "COUNT"]}
    if shutil.which(PROGRAM):
        decimate = [PROGRAM, "--overwrite", arguments.cloud, "--decimate", "COUNT", "OUT"]
        commands[f"{PROGRAM} --decimate"] = decimate
    else:
        print(f"{PROGRAM} isn't on the PATH: its rows are left out", file=sys.stderr)
    rows = []
    for count in arguments.counts:
        fewer = {name: keep_best(original, score, count) for name, score in scores.items()}
        fewer |= {name: written(command, count) for name, command in commands.items()}
        for name, cloud in fewer.items():
            psnr = psnr_to_original(cloud, unseen, truth)
            rows.append((name, f"{len(cloud.means):,}", f"{psnr:.2f}"))
    print(
        markdown(("what", "Gaussians", "dB to the original"), sorted(rows, key=lambda row: row[0]))
    )


def written(command: list[str], count: int):
    """Run a command that writes the file OUT with COUNT Gaussians; return them."""
    with tempfile.TemporaryDirectory() as folder:
        words = {"OUT": str(Path(folder) / "out.ply"), "COUNT": str(count)}
        subprocess.run([words.get(word, word) for word in command], check=True, stdout=sys.stderr)
        return read(words["OUT"]).gaussians.tensors("cpu")


if __name__ == "__main__":
    main()
