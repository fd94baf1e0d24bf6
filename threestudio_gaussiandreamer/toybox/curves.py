"""Loss curves of a training, as CSV and as a chart."""

from pathlib import Path

import numpy as np

from ..core.files import atomic_file
from ..core.images import write as write_picture


def write_curves(path: Path, history: list[dict[str, float]]) -> None:
    """Write the history as CSV, and as a chart beside it."""
    if not history:
        return
    columns = list(history[-1])
    lines = [
        ",".join(columns),
        *(",".join(str(row.get(name, "")) for name in columns) for row in history),
    ]
    with atomic_file(path, durable=False) as file:
        file.write(("\n".join(lines) + "\n").encode())
    write_picture(
        path.with_suffix(".png"), curve(np.array([[row["images"], row["loss"]] for row in history]))
    )


def curve(points: np.ndarray, size: tuple[int, int] = (640, 320)) -> np.ndarray:
    """Draw (images, loss) with a logarithmic loss axis, uint8 (H, W, 3)."""
    from PIL import Image, ImageDraw

    chart = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(chart)
    x, y = points[:, 0], np.log(np.maximum(points[:, 1], 1e-12))
    left, top, right, bottom = 60, 10, size[0] - 10, size[1] - 25
    place = np.stack(
        [
            left + (right - left) * x / max(x.max(), 1),
            bottom - (bottom - top) * (y - y.min()) / max(np.ptp(y), 1e-9),
        ],
        1,
    )
    draw.rectangle((left, top, right, bottom), outline="grey")
    draw.line([tuple(row) for row in place.tolist()], fill="blue")
    draw.text((4, top), f"{np.exp(y.max()):.3g}", fill="black")
    draw.text((4, bottom - 10), f"{np.exp(y.min()):.3g}", fill="black")
    draw.text((right - 140, bottom + 8), f"{int(x.max())} images", fill="black")
    return np.asarray(chart)
