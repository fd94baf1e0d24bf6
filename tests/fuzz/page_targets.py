"""The files of a run's folder that its index is made of, damaged."""

import json
import tempfile
from html.parser import HTMLParser
from pathlib import Path

from tests.fuzz.target import require
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.view.run_files import RunFiles
from threestudio_gaussiandreamer.view.run_index import write_gallery

MARK = b"\n=====\n"
RUN = {
    "configs/parsed.yaml": b"name: demo\nsystem:\n  renderer: {preset: fast, eps2d: 0.1}\n"
    b"  prompt_processor: {prompt: 'a <b>box</b>'}\n  background: {color: [1.0, 0.5, 0.0]}\n",
    "configs/raw.yaml": b"name: demo\ntag: ${name}\nsystem:\n  renderer: {preset: balanced}\n",
    "save/metrics.json": json.dumps(
        {"seconds": 3.5, "prior": {"step": 0, "psnr": 12.5}, "result": {"step": 7, "psnr": 31.0}}
    ).encode(),
    "times.json": b'[{"stage": "train", "began": "2026-01-01", "seconds": 1.5}]',
    "csv_logs/version_0/metrics.csv": b"dB,loss,step\n1.0,2.0,1\n2.0,1.0,2\n,3.0,3\n",
}


class _Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.add(tag)


def run_folders() -> list[bytes]:
    return [MARK.join(RUN.values())]


def exercise_run_folder(path: Path) -> None:
    """Write index and gallery of a run of these files; none may add an element to them."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        for name, content in zip(RUN, path.read_bytes().split(MARK), strict=False):
            (run / name).parent.mkdir(parents=True, exist_ok=True)
            (run / name).write_bytes(content)
        (run / "configs").mkdir(parents=True, exist_ok=True)
        (run / "configs" / "parsed.yaml").touch()
        gallery = write_gallery(Path(folder))
        for page in (gallery, run / "index.html"):
            require(not _Tags(page.read_text()).tags & {"script", "b"}, "markup of a file is used")
        if not RunFiles(run).config:
            raise UserError("the configuration is damaged: it is left out")
