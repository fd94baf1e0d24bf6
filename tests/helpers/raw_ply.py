"""PLY files of Gaussians with any values, also those that the package's writer leaves out."""

from pathlib import Path

from threestudio_gaussiandreamer.formats.ply import gaussian_columns, gaussian_properties
from threestudio_gaussiandreamer.formats.ply_table import write_table
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


def write_raw_gaussians(path: Path, gaussians: Gaussians, comments: tuple[str, ...] = ()) -> None:
    """Write Gaussians as they are, NaN and infinity included."""
    properties = gaussian_properties(gaussians.sh.shape[1])
    write_table(path, properties, gaussian_columns(gaussians), comments)
