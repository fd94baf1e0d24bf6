"""The rotation matrix of a quaternion, once for numbers, arrays and tensors."""

from typing import TypeVar

T = TypeVar("T")
Row = tuple[T, T, T]


def rotation_rows(w: T, x: T, y: T, z: T) -> tuple[Row, Row, Row]:
    """Return the rows of a unit quaternion's rotation matrix, of the arguments' type and shape."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
