"""The known failures that the stability tests provoke: name, bar, and what other projects do.

Groups: A0 defects in other projects' code, A1 rasteriser, A2 geometry and first cloud, A3
densification, A4 score distillation, A5 runs. A test names its row with `row`; `test_all_rows.py`
fails if a row has no test.
"""

import difflib
from typing import NamedTuple, Optional

import pytest

from tests.stability.faults import FAULTS


class Row(NamedTuple):
    group: str
    name: str
    title: str
    """One line about the defect (A0), or empty."""
    bar: str
    peers: str


def row(group: str, name: str, *, bar: Optional[str] = None) -> pytest.MarkDecorator:
    """Mark a test as one of a row; a ``bar`` of its own needs a docstring that justifies it."""
    if (group, name) not in ROWS:
        near = difflib.get_close_matches(
            name, [other for place, other in ROWS if place == group], n=3, cutoff=0.3
        )
        raise KeyError(f"group {group} has no row {name!r}; near: {near}")
    return pytest.mark.stability(group, name, bar)


GROUPS = {
    "A0": "Defects in other projects' code",
    "A1": "Rasteriser numerics",
    "A2": "Geometry and the first cloud",
    "A3": "Densification",
    "A4": "Score distillation",
    "A5": "Runs",
}

OTHERS = {
    "A1": [
        (
            "At/behind near plane; centred on the camera (z=0)",
            "culled set = {z <= near, not finite}; all finite; culled gradients exactly 0; "
            "same bits as without",
            "graphdeco culls z <= 0.2; gsplat z < near; OpenSplat nothing (F26)",
        ),
        (
            "Edge of image, huge Jacobian",
            "gradients rel <= 1e-6 off the kink; spill <= that of the clamped ellipse",
            "clamp at 1.3 tan(fov/2); gradient wrong in graphdeco (F1)",
        ),
        (
            "Needle, disc, scale 1e-8..1e4",
            "finite; forward <= 2e-5; gradients rel <= 1e-3; log scales in [-20, 10]",
            "brush PR #522: NaN scale gradients on 1 % of splats; gsplat culls det <= 0",
        ),
        (
            "det <= 0, float32 cancellation ac-b^2",
            "float32 keeps float64's visible set",
            "graphdeco `== 0`; OpenSplat clamps 1e-6; torch-splatting `inverse()`",
        ),
        (
            "Zero/denormal quaternion",
            "identity, gradient 0 below 1e-12; no NaN; q, -q, 5q the same image",
            "gsplat: NaN (F7)",
        ),
        (
            "Opacity -> 0 and -> 1",
            "finite; below alpha_min exactly nothing; logits loaded into [-15, 15]",
            "`inverse_sigmoid(1) = inf`; FastGS PR #58: illegal memory access",
        ),
        (
            "Alpha cap and threshold, gradient discontinuity",
            "interior rel 1e-5; flips <= 0.1 % of pixels; jump <= alpha_min",
            "gsplat excludes a boundary band (c927d96c); graphdeco F3",
        ),
        (
            "Fog: thousands of faint Gaussians on a pixel",
            "accurate >= 60 dB on fog(2000); bound N alpha_min",
            "graphdeco, gsplat: 15.2 dB",
        ),
        (
            "Early stop",
            "error <= 1e-4",
            "graphdeco `forward.cu:347`, gsplat: the crossing Gaussian is lost (F4)",
        ),
        (
            "Thousands overlapping one pixel",
            "gradients rel <= 1e-4",
            "T recovered by division; gsplat floors it at 1e-6",
        ),
        (
            "Coincident depths",
            "order (depth, index); same bits over 10 runs and 1/2/4/8 threads",
            "graphdeco, gsplat stable; OpenSplat's sort isn't (F26)",
        ),
        ("Depth key: float bits as uint", "order equals float order", "right for z > 0 only"),
        (
            "0, 1, 2, 3 Gaussians; empty view; all culled",
            "the background bit for bit; alpha 0; zero gradients; the optimiser steps",
            "graphdeco: black and a crash (F2); gsplat since PR #100",
        ),
        (
            "Tiny, non-square, non-multiple of tile",
            "crop of a larger render to 1e-6; circle's axes within 0.5 px",
            "GaussianDreamer's fork: square only (F17); torch-splatting 256 only (F27)",
        ),
        (
            "int32 overflow",
            "int64 total right; named error above a memory budget",
            "gsplat since ffa6d951, a5316070; fvdb-core #708 (F8)",
        ),
        (
            "autocast / fp16 / bf16 inputs",
            "float32, identical to the float32 call",
            "ports switch autocast off or call `.float()`",
        ),
        (
            "NaN/Inf inputs",
            "named error with count and index, or others bit-identical; cost <= 2 % of forward",
            "undefined (F6)",
        ),
        (
            "Gradient check",
            "gradcheck float64; float32 rel L2 <= 1e-4, cos >= 0.99999",
            "gsplat: rtol 1e-4..1.65e-2 with bands",
        ),
        (
            "Determinism of reductions",
            "bit-identical over 10 runs and 1/2/4/8 threads",
            "atomics: graphdeco #89 24.2-28.1 dB; brush #525 405-897 k splats",
        ),
        (
            "Anti-aliasing across resolutions",
            "energy drift <= 5 % over 16x; >= 10 dB better than classic",
            "gsplat PR #117, #140, 421f7698",
        ),
        (
            "Popping",
            "jump <= a1 a2 |c1 - c2|; one frame only",
            "StopThePop sorts per pixel, +4 % time",
        ),
    ],
    "A2": [
        (
            "Duplicate points: distance 0 -> log 0",
            "finite; merged or the median distance of distinct points; O(N log N)",
            "all forks clamp d^2 to 1e-7; simple-knn is O(N^2) here",
        ),
        ("Isolated point: huge scale", "scale <= 10 x the 99th percentile; flagged", "none"),
        ("N<4", "finite; a fraction of the bounding radius", "infinite (F9)"),
        (
            "Empty mesh, zero faces, one vertex",
            "named error, exit code 2, nothing half-written",
            "crash",
        ),
        ("NaN/Inf vertices, NaN colours", "dropped and counted, or an error above 5 %", "silent"),
        ("No colours", "grey 0.5 and the perturbation, said in the log", "KeyError"),
        (
            "Units and pose",
            "accepted share within 1 %; same image within 50 dB after normalisation",
            "fixed 0.01 (F15)",
        ),
        (
            "Flat, needle, point bbox",
            "count <= cap; a flat prior grows a slab",
            "1 M duplicates (F15)",
        ),
        ("No grown point", "the given vertices alone", "crash (F14)"),
        (
            "Non-manifold, duplicate faces, degenerate triangles",
            "zero-area faces ignored; KS uniformity p > 0.01",
            "open3d: zero-area faces give NaN weights",
        ),
        (
            "Colour perturbation",
            "in [0, 1]; zero-mean is an option",
            "ports: mean + 0.1, up to 1.2",
        ),
    ],
    "A3": [
        (
            "Explosion",
            "cap exact at every step; lowest contribution first",
            "loss scale F11; MCMC caps +5 % per 100 steps; random subset F21",
        ),
        (
            "Collapse to 0",
            "floor of 64 kept; warned; exit 0",
            "graphdeco #472, #482; RaySplatting #4; LightGaussian #27",
        ),
        ("N=1 squeeze", "shapes right for N = 1..3", "crash (F13)"),
        (
            "Optimiser state mismatch",
            "moments follow their Gaussian to the bit; new rows 0; no stale tensor",
            "rebuilt by name; TypeError on None",
        ),
        ("Lost step", "identical to no densification, bit for bit", "F18; graphdeco PR #828"),
        (
            "Threshold's meaning",
            "same selection at loss scale 1 and 65 536; >= 90 % overlap at 2x resolution",
            "F11; pixels in one, NDC in another",
        ),
        ("Saturated 0/0", "never seen: not selected, not NaN", "`grads.isnan() = 0`"),
        (
            "Opacity reset",
            "recovers within 0.5 dB in 200 steps, or is off by default",
            "off in both ports; wipes the asset under SDS",
        ),
        (
            "Densify x resume",
            "final cloud's hash equals the uninterrupted run's",
            "statistics not saved (F12)",
        ),
        (
            "MCMC relocation with no live Gaussian / all-zero opacity",
            "handled",
            "gsplat's `multinomial` raises",
        ),
    ],
    "A4": [
        (
            "fp16 overflow in VAE/UNet",
            "bad item masked, others bit-identical; counted; named error after 10",
            "threestudio #330; dreamgaussian #36; diffusers #9844",
        ),
        (
            "GradScaler",
            "rasteriser in float32; skipped steps counted; schedule not advanced silently",
            "65 536 overflows any fp16 gradient > 1",
        ),
        (
            "Guidance 100: over-saturation",
            "none < anneal < clip in dB; share out of gamut reported",
            "NFSD; MVDream rescale; Debiasing 2303.15413",
        ),
        (
            "Clip schedule",
            "exact values; bad lists rejected when parsed",
            "threestudio `C()`: divides by zero when end == start",
        ),
        ("t edges", "clamped to [1, T - 1]; named error for min > max", "F23"),
        (
            "Janus",
            "multi-face rate: prior <= 5 %, random >= 50 %, over 5 seeds",
            "the paper's own ablation",
        ),
        (
            "Colour drift, background shortcut",
            "alpha error mean <= 0.02; PSNR spread over 3 backgrounds <= 1 dB",
            "ports: random backgrounds; released code: black only",
        ),
        (
            "Extreme cameras in a batch",
            "finite; only that item is affected; gradient norm per item logged",
            "look-at degenerates at 90 degrees",
        ),
        ("Empty view in a batch", "the step succeeds", "TypeError in both systems"),
        (
            "Resume mid-schedule",
            "identical continuation",
            "threestudio special-cases `_resumed_eval`",
        ),
        (
            "RNG",
            "stop/resume anywhere equals uninterrupted, bit for bit; validation changes nothing",
            "Lightning doesn't save generators; F16",
        ),
    ],
    "A5": [
        (
            "Crash mid checkpoint",
            "always a loadable last or previous",
            "Lightning #688, #19970, #1150",
        ),
        (
            "Disk full, read-only",
            "named error, exit != 0, earlier file untouched, no temporary left",
            "Lightning #21800: success reported",
        ),
        (
            "Corrupted checkpoint",
            "checksum mismatch with path; never a partial load; fallback only with `resume=auto`",
            "-",
        ),
        (
            "Corrupted/foreign PLY",
            "clean error or correct load; no allocation beyond the file size size",
            "plyfile tracebacks; UnityGS #179, #159; supersplat #41; splatapult #3",
        ),
        (
            "Wrong config keys",
            "rejected with a suggestion; every accepted key is read",
            "dicts are free in OmegaConf; F20",
        ),
        (
            "Prompt as path / YAML",
            "under the root; slug <= 64 bytes and a hash; always text",
            "threestudio #417",
        ),
        (
            "Ctrl-C / SIGTERM",
            "checkpoint written; exit 130/143; resume identical",
            "Lightning goes on to `test`",
        ),
        (
            "Hub offline",
            "fails < 5 s with what to place where; offline guidance needs no network",
            "diffusers #1717, #11447, #14195, #5300",
        ),
        (
            "Untrusted pickle",
            "no reader executes anything",
            "bare `torch.load` in threestudio `launch.py:240`, `misc.py:41`, `base.py:420`",
        ),
        ("Failed custom module", "named error at load", "`load_custom_module` prints and goes on"),
    ],
}

ROWS = {("A0", name): Row("A0", name, *rest) for name, *rest in FAULTS} | {
    (group, name): Row(group, name, "", *rest)
    for group, rows in OTHERS.items()
    for name, *rest in rows
}
