"""Count the package's calls from a training step to the CPU kernel and to the U-Net.

A step of ``toybox.yaml`` is trained. Counted are the frames below ``training_step``, of
comprehensions none, down to the function that calls the library, and to the call of the U-Net.
"""

import sys
import tempfile
from types import FrameType

from tests.architecture import PACKAGE

STEP = (
    "--config toybox.yaml --train --gpu cpu system.geometry.prior_type=random-prior name=frames "
    "trainer.max_steps=1 trainer.enable_progress_bar=false system.exporter.formats=[ply] "
    "data.n_test_views=1 data.eval_width=32 data.eval_height=32 system.geometry.budget=600 "
    "data.width=64 data.height=64 "
    "system.guidance.view_contrast=0 system.prompt_processor.prompt=fox"
).split()


def calls_in_a_step() -> dict[str, int]:
    """Return the number of calls by the name of their line in the table of sizes."""
    from threestudio_gaussiandreamer.launch.experiment import main

    found = {"frames to the kernel": 0, "frames to the U-Net": 0}

    def look(frame: FrameType, event: str, _: object) -> None:
        code, owner = frame.f_code, type(frame.f_locals.get("self")).__name__
        name = ""
        if event == "call" and "splat_forward" in code.co_names and "restype" not in code.co_names:
            name = "frames to the kernel"
        if event == "call" and code.co_name == "forward" and owner == "UNet2DConditionModel":
            name = "frames to the U-Net"
        if name:
            found[name] = max(found[name], depth(frame))

    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(look)
        try:
            code = main([*STEP, f"exp_root_dir={folder}"])
        finally:
            sys.setprofile(None)
    if code or not all(found.values()):
        raise RuntimeError(f"the step ended with {code}; frames: {found}")
    return found


def depth(frame: FrameType | None) -> int:
    """Return the number of the package's frames below ``training_step``; 0 outside of it."""
    count = 0
    while frame is not None and frame.f_code.co_name != "training_step":
        code = frame.f_code
        count += str(PACKAGE) in code.co_filename and code.co_name[0] != "<"
        frame = frame.f_back
    return 0 if frame is None else count
