"""Models published in half precision only: files with "fp16" or "bf16" in their names, or without,
as MVDream's.
"""

import shutil
from pathlib import Path

import pytest
import torch

from tests.helpers import tiny_large_guidance as tiny
from tests.helpers.tiny_guidance import relative, renders

pytest.importorskip("diffusers")
DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16}


def store(folder: Path, variant: str, named: bool) -> Path:
    """Store all weights in half precision, with the variant in the files' names if ``named``."""
    from safetensors.torch import load_file, save_file

    for path in folder.rglob("*.safetensors"):
        tensors = {
            name: value.to(DTYPES[variant]) if value.is_floating_point() else value
            for name, value in load_file(path).items()
        }
        path.unlink()
        new = path.with_name(f"{path.stem}.{variant}.safetensors") if named else path
        save_file(tensors, new, metadata={"format": "pt"})
    return folder


def gradient(kind, folder, prompts):
    azimuth = torch.tensor([0.0, 90.0, 180.0, 270.0])
    batch = tiny.views(elevation=torch.full((4,), 10.0), azimuth=azimuth)
    return tiny.gradient(tiny.guidance(kind, folder), prompts, renders(), **batch)[0]


@pytest.mark.parametrize(
    "kind, variant, named",
    [
        ("stable-diffusion-xl", "fp16", True),
        ("stable-diffusion-3", "bf16", True),
        ("mvdream", "fp16", False),
    ],
)
def test_half_precision_files_are_read(large, kind, variant, named, tmp_path):
    folder, prompts = large(kind)
    full = gradient(kind, folder, prompts)
    copy = Path(shutil.copytree(folder, tmp_path / "model"))
    half = gradient(kind, store(copy, variant, named), prompts)
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert 0 < relative(half, full.double()) < (0.1 if variant == "fp16" else 0.5)
