"""How many pairs of a splat and a block the CPU kernel blends, and in how many of their pixels.

    python -m benchmarks.splatting.block_pairs

Counts what the kernel's lists hold, with plain torch, so that blocks of any build are counted on
any machine: pairs of a splat and a block of pixels where the ellipse of alpha >= alpha_min reaches
the rectangle of the block's pixel centres, up to the batch of four after which all pixels of the
block have stopped; and the pixels that get a weight, per pair. Only that the kernel's batches begin
again with every 512 splats of a tile is left out. Writes ``benchmarks/results/block_pairs.csv``."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT, commit
from benchmarks.splatting.pairs import DEMO, Case, make_case
from threestudio_gaussiandreamer.splatting import reference
from threestudio_gaussiandreamer.splatting.options import RasterizeOptions
from threestudio_gaussiandreamer.splatting.projection import project
from threestudio_gaussiandreamer.splatting.validation import as_scene, named

RESULTS = ROOT / "benchmarks/results/block_pairs.csv"
COLUMNS = ("scene", "gaussians", "views", "size", "block", "pairs", "pixels", "commit")
CASES = ("surface 512", "demo 256", f"{DEMO} 256")
BLOCKS = {"v4": (4, 4), "v3": (4, 2)}
"""Width and height of a block in each build."""
BATCHES = {"v4": 8, "v3": 4}
"""Splats that each build blends at a time."""


class Splats(NamedTuple):
    """The M visible splats of one view, front to back."""

    means: Tensor
    """(M, 2) pixels."""
    conics: Tensor
    """(M, 3): a, k, c of projection.Splats."""
    opacities: Tensor
    """(M,)."""
    extents: Tensor
    """(M, 2): half the box around alpha >= alpha_min, pixels."""


class Blocks(NamedTuple):
    """Blocks of ``width`` times ``height`` pixels that tile a square image."""

    width: int
    height: int
    columns: int
    rows: int

    def centres(self, blocks: Tensor) -> tuple[Tensor, Tensor]:
        """Return x and y (P,) of the first pixel centre of each block."""
        column, row = blocks % self.columns, blocks // self.columns
        return column * self.width + 0.5, row * self.height + 0.5


def main() -> None:
    rows: list[dict[str, Any]] = []
    for name in CASES:
        case = make_case(name)
        for build, (width, height) in BLOCKS.items():
            pairs, weights = count(case, width, height, BATCHES[build])
            row = {"scene": case.name, "gaussians": len(case.cloud.means)}
            row |= {"views": len(case.viewmats), "size": case.size, "block": f"{width} × {height}"}
            row |= {"pairs": pairs, "pixels": f"{weights / pairs:.2f}", "commit": commit()}
            print(row, flush=True)
            rows.append(row)
    write(RESULTS, COLUMNS, rows)


@torch.no_grad()
def count(case: Case, width: int, height: int, batch: int) -> tuple[int, int]:
    """Return the pairs of all views, and the pixels in them that get a weight; blocks must tile the
    image.
    """
    assert case.size % width == case.size % height == 0
    tensors = named(*case.cloud, case.viewmats, case.Ks, background=None)
    projected = project(as_scene(tensors, case.size, case.size), case.options)
    grid = Blocks(width, height, case.size // width, case.size // height)
    pairs = weights = 0
    for view in range(len(case.viewmats)):
        ids = reference.sort(projected, case.cloud.colors[None].expand(view + 1, -1, -1), view).ids
        splats = Splats(*(projected[i][view, ids] for i in (0, 1, 2, 4)))
        owners, blocks = pairs_of(splats, grid, case.options.alpha_min)
        alphas = alphas_of(splats, owners, blocks, grid, case.options)
        live = transmittances(alphas, blocks) >= case.options.stop
        pairs += blended(blocks, live.any(1), batch)
        weights += int((live & (alphas > 0)).sum())
    return pairs, weights


def blended(blocks: Tensor, live: Tensor, batch: int) -> int:
    """Return how many pairs are blended, if the list of a block ends with the batch after which no
    pixel is live.
    """
    listed, needed = blocks.bincount(), blocks.bincount(live.double()).long()
    return int(torch.minimum(listed, -(-needed // batch) * batch).sum())


def pairs_of(splats: Splats, grid: Blocks, alpha_min: float) -> tuple[Tensor, Tensor]:
    """Return splats and blocks (P,) of all pairs, those of a block front to back."""
    limit = torch.tensor([grid.columns, grid.rows])
    shape = torch.tensor([grid.width, grid.height])
    low = ((splats.means - splats.extents - 0.5) / shape).floor().long().clamp(min=0)
    high = ((splats.means + splats.extents - 0.5) / shape).floor().long() + 1
    size = (torch.minimum(high, limit) - low).clamp(min=0)
    counts = size.prod(1)
    owners = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(owners)) - (counts.cumsum(0) - counts)[owners]
    column = low[owners, 0] + within % size[owners, 0]
    blocks = (low[owners, 1] + within // size[owners, 0]) * grid.columns + column
    found = reaches(splats, owners, blocks, grid, alpha_min).nonzero()[:, 0]
    blocks, order = blocks[found].sort(stable=True)
    return owners[found][order], blocks


def reaches(
    splats: Splats, owners: Tensor, blocks: Tensor, grid: Blocks, alpha_min: float
) -> Tensor:
    """Return for each pair whether alpha >= alpha_min somewhere between the block's pixel centres,
    as tiles.py does for tiles: the largest alpha is at the splat's centre or on one of the two
    sides nearest to it.
    """
    a, k, c = splats.conics[owners].unbind(1)
    x0, y0 = (p - m for p, m in zip(grid.centres(blocks), splats.means[owners].T, strict=True))
    x1, y1 = x0 + (grid.width - 1), y0 + (grid.height - 1)
    zero = torch.zeros_like(x0)
    x, y = zero.clamp(x0, x1), zero.clamp(y0, y1)
    other_x, other_y = (k * y).clamp(x0, x1), (x * (a * k / (a * k * k + c))).clamp(y0, y1)
    q = torch.minimum(
        a * (other_x - k * y) ** 2 + c * y**2, a * (x - k * other_y) ** 2 + c * other_y**2
    )
    return q <= 2 * torch.log(splats.opacities[owners] / alpha_min)


def alphas_of(
    splats: Splats, owners: Tensor, blocks: Tensor, grid: Blocks, options: RasterizeOptions
) -> Tensor:
    """Return the alphas of each pair at its block's pixels, (P, width * height)."""
    pixels = torch.arange(grid.width * grid.height)
    left, top = grid.centres(blocks)
    x = left[:, None] + pixels % grid.width - splats.means[owners, :1]
    y = top[:, None] + pixels // grid.width - splats.means[owners, 1:]
    a, k, c = splats.conics[owners][:, None].unbind(-1)
    alphas = splats.opacities[owners, None] * torch.exp(-0.5 * (a * (x - k * y) ** 2 + c * y**2))
    return torch.where(alphas >= options.alpha_min, alphas.clamp(max=options.alpha_max), 0)


def transmittances(alphas: Tensor, blocks: Tensor) -> Tensor:
    """Return the transmittance before each pair, whose blocks are sorted, at each of its pixels."""
    logarithms = torch.log1p(-alphas.double())
    before = logarithms.cumsum(0) - logarithms
    return torch.exp(before - before[torch.searchsorted(blocks, blocks)])


def table() -> str:
    """Return pairs, and pixels with a weight, for each scene and shape of block."""
    builds = {f"{width} × {height}": build for build, (width, height) in BLOCKS.items()}
    lines = [
        (
            f"{row['scene']}, {int(row['gaussians']):,} Gaussians, {row['views']} × {row['size']}²",
            f"{row['block']} (`{builds[row['block']]}`)",
            f"{int(row['pairs']) / 1e6:.2f}",
            f"{float(row['pixels']):.1f} of {width * height}",
        )
        for row in read(RESULTS)
        for width, height in [BLOCKS[builds[row["block"]]]]
    ]
    head = ("scene", "block (build)", "million pairs", "pixels of a pair with a weight")
    return markdown(head, lines)


if __name__ == "__main__":
    main()
