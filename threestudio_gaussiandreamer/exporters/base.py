"""What every exporter starts from.

An exporter is one file: a subclass of the host's ``Exporter`` registered as ``<format>-exporter``, whose call returns a list
of ``ExporterOutput(save_name, save_type, params)``; the system writes each with its ``save_<save_type>(name, **params)``.
"""

from ..host import BaseGeometry
from ..ply import GaussianArrays


def gaussian_arrays(geometry: BaseGeometry) -> GaussianArrays:
    """The parameters of a geometry as float32 arrays on the CPU."""
    return GaussianArrays(*(getattr(geometry, name).detach().float().cpu().numpy() for name in GaussianArrays._fields))
