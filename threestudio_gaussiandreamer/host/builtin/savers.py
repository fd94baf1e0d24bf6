"""Write results into the ``save`` folder of a run, by methods with threestudio's names."""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Optional

import numpy as np
from torch import Tensor

from ... import images as pictures
from ...core.errors import UserError
from ...core.files import atomic_file, json_text, write_file

MP4 = (
    *("-codec:v", "libx264", "-crf", "25", "-pix_fmt", "yuv420p"),
    # put the index first, so that a browser can start to play before it has the whole file
    *("-movflags", "+faststart"),
    # ffmpeg takes BT.601's matrix and says nothing; players assume BT.709's above 720 lines
    *("-vf", "scale=ceil(iw/2)*2:ceil(ih/2)*2:out_color_matrix=bt709:out_range=tv"),
    *("-colorspace", "bt709", "-color_primaries", "bt709"),
    *("-color_trc", "bt709", "-color_range", "tv"),
)


@dataclass
class WandbOptions:
    enable: bool = False
    project: Optional[str] = ""
    name: Optional[str] = ""


@dataclass
class LoggerOptions:
    wandb: WandbOptions = field(default_factory=WandbOptions)


class SaverMixin:
    """``save_*`` methods take a name relative to the save folder, and return the full path."""

    _save_dir: Optional[str] = None
    _wandb_logger: Any = None

    def set_save_dir(self, save_dir: str) -> None:
        self._save_dir = str(save_dir)

    def get_save_dir(self) -> str:
        if self._save_dir is None:
            raise ValueError("the save folder isn't set yet: call set_save_dir first")
        return self._save_dir

    def get_save_path(self, filename: str) -> str:
        """Return the full path of a file below the save folder, and make its folder."""
        path = os.path.join(self.get_save_dir(), filename)
        if os.path.relpath(path, self.get_save_dir()).startswith(os.pardir):
            raise UserError(f"the file name {filename!r} is outside of {self.get_save_dir()}")
        os.makedirs(os.path.dirname(path), exist_ok=True)
        return path

    def create_loggers(self, loggers: Any) -> None:
        """Make the Weights & Biases logger if ``loggers.wandb.enable``; needs the package wandb."""
        if loggers.wandb.enable:
            from lightning.pytorch.loggers import WandbLogger

            if find_spec("wandb") is None:
                raise UserError("system.loggers.wandb.enable: install wandb (pip install wandb)")
            options = loggers.wandb
            self._wandb_logger = WandbLogger(project=options.project, name=options.name)

    def get_loggers(self) -> list:
        return [self._wandb_logger] if self._wandb_logger else []

    def convert_data(self, data: Any) -> Any:
        """Convert tensors to numpy arrays, also inside of dicts and lists."""
        if isinstance(data, dict):
            return {key: self.convert_data(item) for key, item in data.items()}
        if isinstance(data, list):
            return [self.convert_data(item) for item in data]
        return data.detach().cpu().numpy() if isinstance(data, Tensor) else data

    def save_image_grid(
        self, filename: str, imgs: list, name: Optional[str] = None, step: Optional[int] = None
    ) -> str:
        """Save a row of ``{"type": "rgb"|"grayscale", "img": ..., "kwargs": {...}}``, or a list of
        rows, as an image; ``kwargs`` as for the functions of this name in ``images.py``.
        """
        path = self.get_save_path(filename)
        pictures.write(path, pictures.grid(self.convert_data(imgs)))
        self._log_file("Image", path, name, step)
        return path

    def save_img_sequence(
        self,
        filename: str,
        img_dir: str,
        matcher: str,
        save_format: str = "mp4",
        fps: int = 30,
        name: Optional[str] = None,
        step: Optional[int] = None,
    ) -> str:
        """Save a video of the pictures in ``img_dir``, a folder below the save folder, whose names
        match the regular expression ``matcher``, sorted by the number in its first group.
        """
        if save_format not in ("mp4", "gif"):
            raise UserError(f"unknown video format {save_format!r}: expected 'mp4' or 'gif'")
        if not filename.endswith(save_format):
            filename += f".{save_format}"
        path, folder = self.get_save_path(filename), Path(self.get_save_dir(), img_dir)
        matches = [(re.search(matcher, picture.name), picture) for picture in folder.iterdir()]
        frames = sorted((int(match[1]), picture) for match, picture in matches if match)
        if not frames:
            raise FileNotFoundError(f"no picture in {folder} matches {matcher}")
        write_video(path, [picture for _, picture in frames], fps=fps)
        self._log_file("Video", path, name, step)
        return path

    def save_data(self, filename: str, data: Any) -> str:
        """Save a dict of arrays as npz, anything else as npy."""
        data = self.convert_data(data)
        extension, save = (".npz", np.savez) if isinstance(data, dict) else (".npy", np.save)
        path = self.get_save_path(filename.removesuffix(extension) + extension)
        with atomic_file(path) as file:
            save(file, **data) if isinstance(data, dict) else save(file, data)
        return path

    def save_obj(
        self, filename: str, mesh: Any, save_vertex_color: bool = False, **unused: Any
    ) -> list[str]:
        """Save ``v_pos`` (V,3), ``t_pos_idx`` (F,3) and, if asked, ``v_rgb`` (V,3) as an OBJ."""
        path = self.get_save_path(f"{filename.removesuffix('.obj')}.obj")
        vertices, faces = self.convert_data(mesh.v_pos), self.convert_data(mesh.t_pos_idx)
        if save_vertex_color:
            vertices = np.concatenate([vertices, self.convert_data(mesh.v_rgb)], axis=1)
        with atomic_file(path) as file:
            np.savetxt(file, vertices, fmt="v" + " %.9g" * vertices.shape[1])
            # OBJ counts vertices from 1
            np.savetxt(file, faces + 1, fmt="f %d %d %d")
        return [path]

    def save_file(self, filename: str, src_path: str) -> str:
        path = self.get_save_path(filename)
        with open(src_path, "rb") as source, atomic_file(path) as file:
            shutil.copyfileobj(source, file)
        return path

    def save_json(self, filename: str, payload: Any) -> str:
        path = self.get_save_path(filename)
        write_file(path, json_text(payload))
        return path

    def _log_file(self, kind: str, path: str, name: Optional[str], step: Optional[int]) -> None:
        if name and self._wandb_logger:
            import wandb

            self._wandb_logger.experiment.log(
                {name: getattr(wandb, kind)(path), "trainer/global_step": step}
            )


def write_video(path: str, frames: list[Path], *, fps: int) -> None:
    """Write the images as an mp4 (H.264, yuv420p, index first; scaled to an even size) or gif;
    raise UserError if the disk is full, or there is no ffmpeg.
    """
    if path.endswith(".gif"):
        pictures.write_animation(path, frames, None, len(frames) / fps)
        return
    part = Path(path).with_name(f".part-{Path(path).name}")
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        command = [get_ffmpeg_exe(), "-v", "error", "-xerror", "-y", "-framerate", str(fps)]
        command += ["-i", "-", *MP4, str(part.absolute())]
        content = b"".join(frame.read_bytes() for frame in frames)
        subprocess.run(command, input=content, capture_output=True, check=True)
        os.replace(part, path)
    except (ImportError, OSError, RuntimeError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", b"").decode(errors="replace").strip() or str(error)
        why = "no ffmpeg: pip install imageio-ffmpeg" if isinstance(error, ImportError) else said
        raise UserError(f"the video {path} could not be written: {why.splitlines()[0]}") from error
    finally:
        part.unlink(missing_ok=True)
