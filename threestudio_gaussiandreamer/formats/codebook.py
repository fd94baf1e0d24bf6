"""Codebooks: few values or vectors that stand for many (Lloyd's algorithm, k-means)."""

import numpy as np
from jaxtyping import Float, Integer

ROUNDS = 12
"""Iterations; later ones hardly reduce the error."""
SHORT_WORK = 10**7
"""Distances that are computed without a progress bar."""
BLOCK = 2048
"""Vectors whose distances to all entries are computed at once."""


def scalar_codebook(
    values: Float[np.ndarray, "*shape"], size: int = 256
) -> tuple[Float[np.ndarray, " size"], Integer[np.ndarray, "*shape"]]:
    """Return ``size`` ascending values and the index of the nearest one for each of ``values``.

    Up to ``size`` different values are kept exactly.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    if not len(ordered):
        return np.zeros(size, np.float32), np.zeros(values.shape, np.uint8)
    distinct = np.unique(ordered)
    if len(distinct) <= size:
        book = np.pad(distinct, (0, size - len(distinct)), "edge")
    else:
        book = _lloyd(ordered, distinct, size)
    book = book.astype(np.float32)
    middles = (book[1:] + book[:-1]) / 2
    return book, np.searchsorted(middles, values).astype(np.uint8)


def _lloyd(
    ordered: Float[np.ndarray, " N"], distinct: Float[np.ndarray, " D"], size: int
) -> Float[np.ndarray, " size"]:
    """Move each value to the mean of what it stands for.

    The start is as dense as the third root of the values' density, the optimum for many values
    (Panter and Dite 1951).
    """
    mass = np.concatenate([[0], np.cumsum(np.diff(distinct) ** (2 / 3))])
    book = np.interp(np.linspace(0, mass[-1], size), mass, distinct)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(ROUNDS):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        book = np.sort(np.where(counts > 0, means, book))
    return book


def vector_codebook(
    vectors: Float[np.ndarray, "N D"], size: int
) -> tuple[Float[np.ndarray, "size D"], Integer[np.ndarray, " N"]]:
    """Return ``size`` vectors and the index of the nearest one for each of ``vectors``; k-means
    from a fixed seed. Up to ``size`` vectors are kept exactly.
    """
    if len(vectors) <= size:
        return vectors, np.arange(len(vectors))
    from tqdm import tqdm

    start = np.random.default_rng(0).choice(len(vectors), size, replace=False)
    book = vectors[np.sort(start)].astype(np.float32)
    rounds = range(ROUNDS // 2)
    short = len(vectors) * size < SHORT_WORK
    for _ in tqdm(rounds, "palette of harmonics", leave=False, disable=short or None):
        nearest = _nearest(vectors, book)
        counts = np.bincount(nearest, minlength=size)[:, None]
        columns = (np.bincount(nearest, column, size) for column in vectors.T)
        means = np.stack(list(columns), axis=1) / np.maximum(counts, 1)
        book = np.where(counts > 0, means, book).astype(np.float32)
    return book, _nearest(vectors, book)


def _nearest(
    vectors: Float[np.ndarray, "N D"], book: Float[np.ndarray, "K D"]
) -> Integer[np.ndarray, " N"]:
    squares = (book**2).sum(axis=1)
    starts = range(0, len(vectors), BLOCK)
    blocks = (vectors[at : at + BLOCK] for at in starts)
    return np.concatenate([(squares - 2 * block @ book.T).argmin(axis=1) for block in blocks])
