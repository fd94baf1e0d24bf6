"""Record the studio in Chromium: ``python -m tools.record_studio docs/images/studio.webp``.

A prompt is typed and grows; the result is pruned, and both are shown side by side.
"""

import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from tests.studio.tab import Tab, opened

PROMPT = "a red fox with a green scarf"
SIZE = (1040, 640)
WIDTH = 800
"""Pixels of the recording."""
BETWEEN = 2.0
"""Seconds of the run between two frames."""


def main(path: Path) -> None:
    """Write the recording."""
    frames: list[tuple[Image.Image, int]] = []

    def take(tab: Tab, milliseconds: int) -> None:
        tab.page.session = tab.session
        picture = Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB")
        height = round(picture.height * WIDTH / picture.width)
        frames.append((picture.resize((WIDTH, height), Image.Resampling.LANCZOS), milliseconds))

    with tempfile.TemporaryDirectory() as folder, opened(Path(folder), SIZE) as tab:
        for end in range(4, len(PROMPT) + 4, 4):
            tab.type("prompt", PROMPT[:end])
            take(tab, 120)
        tab.press("start")
        tab.until("state.counts.main > 0")
        while tab.js("state.job !== null"):
            take(tab, 220)
            time.sleep(BETWEEN)
        time.sleep(2)
        take(tab, 1500)
        tab.js("document.querySelector('[aria-label=Budget]').value = 'count'")
        tab.js("document.querySelector('[aria-label=\"Value of the budget\"]').value = '500'")
        tab.press_text("Prune to")
        tab.until("state.counts.beside > 0")
        time.sleep(3)
        take(tab, 3000)
    first, *others = [picture for picture, _ in frames]
    times = [milliseconds for _, milliseconds in frames]
    options = {"append_images": others, "duration": times, "loop": 0, "quality": 70, "method": 6}
    first.save(path, "webp", save_all=True, **options)
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
