"""The section of ``gpu_check`` that prunes a cloud."""

import argparse
from typing import Any

from benchmarks.splatting.gpu_processes import in_process


def prune(args: argparse.Namespace) -> dict[str, Any]:
    return in_process("prune_twice", args)


def prune_twice(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.quality.large_prune import surface
    from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
    from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
    from threestudio_gaussiandreamer.host import get_device
    from threestudio_gaussiandreamer.prune import PruneOptions, prune_to_budget
    from threestudio_gaussiandreamer.prune.pipeline import views_of

    stored = StoredCloud(surface(800 if args.small else 100_000))
    options = PruneOptions(
        count=len(stored.gaussians.means) // 4,
        size=48 if args.small else 256,
        steps=4 if args.small else 60,
    )
    first, second = (prune_to_budget(stored, options, ".ply", "") for _ in range(2))
    before, after = (cloud.gaussians.tensors(get_device()) for cloud in (stored, first.after))
    views = views_of(stored, options)[-1]
    same = all(
        a.tobytes() == b.tobytes()
        for a, b in zip(first.after.gaussians, second.after.gaussians, strict=True)
    )
    return {
        "gaussians": [len(before.means), len(after.means)],
        "psnr": round(psnr_to_original(after, views, render_all(before, views)), 2),
        "seconds": [round(done.seconds, 2) for done in (first, second)],
    } | ({} if same else {"failed": "pruning the same cloud again gave other bits"})
