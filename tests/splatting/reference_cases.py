"""Helpers of the specification tests."""

SPECIFICATION = {"backend": "reference"}


# float64 against the same formula in another order: rounding only.
ROUNDING = 1e-10
