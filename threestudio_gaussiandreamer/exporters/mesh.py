"""``gaussiandreamer-mesh-exporter``: a closed mesh with a texture, as GLB and as OBJ with its MTL
and PNG. In the built-in host it is ``mesh-exporter`` too.

=============  ===================================================================================
option         meaning
=============  ===================================================================================
save_name      name of the GLB in the export folder; OBJ, MTL and PNG have the same stem
up             the OBJ's up axis: ``y`` (the front faces +z), as most programs that read OBJ expect,
               or ``z`` for this package's world; a GLB has y up by definition
obj            also write the OBJ with its MTL and PNG
unlit          ask viewers to show the texture without lighting
faces          largest number of triangles
texture        width and height of the texture, texels
method         ``fusion`` of rendered depths, or a level set of the summed ``density``
resolution     cells along the longest side of the grid that the surface is extracted from
views          number of renders that the surface and the texture are made from
view_size      width and height of a render, pixels
min_component  connected parts with a smaller share of the surface's area than this are dropped
eps2d          screen-space dilation of the renders, square pixels; by default the run's
antialias      whether the renders are antialiased; by default as in the run
save_video     also render the turntable
=============  ===================================================================================

Needs the extra ``mesh``. ``docs/mesh.md`` lists the PSNR between mesh and cloud by size."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import List

from ..core.errors import UserError
from ..formats.glb import GLB_UP
from ..gaussians.axes import WORLD_UP, rotation_between
from ..host import ExporterOutput, register, register_builtin
from ..surface.options import MeshOptions
from ..surface.textured import mesh_from_gaussians, require_mesh_libraries
from .base import SAVE_NAME, UP, FileExporter


@register("gaussiandreamer-mesh-exporter")
@register_builtin("mesh-exporter")  # the name of threestudio's own exporter of meshes
class MeshExporter(FileExporter):
    """Files of save_type "textured_mesh"; their params are ``{"mesh": Mesh, "unlit": bool}``."""

    @dataclass
    class Config(FileExporter.Config, MeshOptions):
        save_name: str = field(default="mesh.glb", metadata=SAVE_NAME)
        up: str = field(default="y", metadata=UP)
        obj: bool = True
        unlit: bool = False

        @staticmethod
        def check(cfg: "MeshExporter.Config") -> None:
            """Check the name and the options, and that the libraries are installed.

            Raises:
                UserError: one of them is wrong or missing.
            """
            if Path(cfg.save_name).suffix.lower() != ".glb":
                raise UserError(
                    f"save_name: expected the name of a .glb file, got {cfg.save_name!r}"
                )
            MeshOptions.check(cfg)
            require_mesh_libraries()

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        mesh = mesh_from_gaussians(self.gaussians(), self._options())
        ups = {self.cfg.save_name: GLB_UP}
        if self.cfg.obj:
            ups[str(Path(self.cfg.save_name).with_suffix(".obj"))] = self.cfg.up
        return [
            ExporterOutput(
                save_name=name,
                save_type="textured_mesh",
                params={
                    "mesh": mesh._replace(
                        vertices=mesh.vertices @ rotation_between(WORLD_UP, up).T
                    ),
                    "unlit": self.cfg.unlit,
                },
            )
            for name, up in ups.items()
        ]

    def _options(self) -> MeshOptions:
        """Return the options, with ``eps2d`` and ``antialias`` of the run if they aren't given."""
        options = {option.name: getattr(self.cfg, option.name) for option in fields(MeshOptions)}
        of_run = {
            name: value for name, value in self.drawing._asdict().items() if options[name] is None
        }
        return MeshOptions(**options | of_run)
