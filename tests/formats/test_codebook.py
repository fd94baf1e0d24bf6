"""Codebooks keep few values exactly and many closely."""

import numpy as np

from threestudio_gaussiandreamer.formats.sog import scalar_codebook, vector_codebook


def test_few_values_are_kept_exactly():
    values = np.float32([[3, -1, 3], [2.5, 2.5, -1]])
    book, rows = scalar_codebook(values)
    np.testing.assert_array_equal(book[rows], values)
    assert len(book) == 256 and (np.diff(book) >= 0).all()


def test_many_values_are_kept_better_than_by_equal_steps():
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32) ** 3
    book, rows = scalar_codebook(values)
    steps = np.linspace(values.min(), values.max(), 256)
    equal = steps[np.abs(values[:, None] - steps).argmin(1)]
    assert ((book[rows] - values) ** 2).mean() < 0.2 * ((equal - values) ** 2).mean()
    nearest = np.abs(values[:500, None] - book).argmin(1)
    np.testing.assert_allclose(book[rows[:500]], book[nearest])


def test_no_values():
    book, rows = scalar_codebook(np.zeros((0, 3), np.float32))
    assert book.shape == (256,) and rows.shape == (0, 3)


def test_vectors_in_groups_are_found():
    rng = np.random.default_rng(1)
    centres = rng.normal(size=(8, 5)) * 10
    vectors = (centres[rng.integers(0, 8, 4000)] + rng.normal(size=(4000, 5)) * 0.01).astype("f4")
    book, rows = vector_codebook(vectors, 64)
    assert book.shape == (64, 5) and np.abs(book[rows] - vectors).max() < 0.2
    exact, rows = vector_codebook(vectors[:64], 64)
    np.testing.assert_array_equal(exact[rows], vectors[:64])
