"""Write a cloud as one HTML file that shows it in any browser with WebGL2, from disk and without a
network request. Its sources are in ``web/``: the renderer executes the image model of
``splatting/reference.py``; the content security policy forbids every script but its own."""

import base64
import hashlib
import io
import math
import os
import re
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Optional
from urllib.parse import quote

import numpy as np

from ..core.errors import UserError
from ..core.files import write_file
from ..formats.gaussian_files import StoredCloud, notes_of
from ..formats.ply import NORMALS, gaussian_columns, gaussian_properties, header_bytes
from ..formats.spz import SPZ_UP, spz_bytes
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.views import NEAR, bounds
from ..splatting import PRESETS, RasterizeOptions
from .render import (
    WHITE,
    Color,
    Pose,
    RenderSettings,
    backdrop,
    first_pose,
    hex_color,
    picture,
    require_gaussians,
)
from .run_files import RunFiles, read_any, step_of

WEB = Path(__file__).with_name("web")
SCRIPTS = ("camera.js", "sorter.js", "cloud.js", "renderer.js", "controls.js", "main.js")
SHADERS = ("splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl")
MAX_GAUSSIANS = 2_000_000
"""A browser takes minutes to open a page with more, or runs out of memory."""
POSTER_SIZE = 320
"""Width and height in pixels of the picture that a browser without WebGL2 shows."""
COARSE_MEANS = 1024
"""Steps of coarse positions along the longest side of the cloud."""


class Shown(NamedTuple):
    """A cloud of a page, its label there, and its PSNR and the views on which that was measured."""

    cloud: StoredCloud
    label: str
    quality: str = ""


class PageOptions(NamedTuple):
    """What is common to the clouds of a page; ``name``, without extension, of the files that it
    saves; whether the object may vanish on the background, since the user has chosen it."""

    title: str
    name: str
    settings: RenderSettings
    background: Color = WHITE
    keep_background: bool = False


def write_page(path: Path, *shown: Any) -> None:
    """Write the page of :func:`page`; raises UserError also if the file can't be written."""
    content = page(*shown)
    # a title may be a file's name, whose bytes needn't be UTF-8
    write_file(path, content.encode(errors="replace"))


def page(shown: Shown, options: PageOptions, before: Optional[Shown] = None) -> str:
    """Return the page of a cloud, which can save its PLY and SPZ files.

    Args:
        before: a second cloud to compare with, such as the prior; it is stored in lower precision.

    Raises:
        UserError: there are too many Gaussians or none, or they reach too far for float32.
    """
    clouds = [_checked(shown, options.name)]
    if before is not None:
        before = _checked(before, before.label)
        gaussians = coarse(before.cloud.gaussians)
        clouds.append(before._replace(cloud=before.cloud._replace(gaussians=gaussians)))
    cloud = clouds[0].cloud
    pose = first_pose(cloud)
    poster = picture(cloud, options.settings, pose, POSTER_SIZE)
    if not options.keep_background:
        options = options._replace(background=backdrop(poster, options.background))
    script, style = sources(*SCRIPTS), sources("page.css")
    blocks = {f"cloud-{i}": packed(shown.cloud.gaussians) for i, shown in enumerate(clouds)}
    blocks["spz"] = spz_bytes(cloud.in_axes(SPZ_UP).gaussians, notes_of(cloud, ".spz"))
    return template("page.html").render(
        policy=policy(script, style),
        title=options.title,
        style=style,
        script=script,
        meta=_meta(clouds, options, pose),
        poster=_poster(poster, options.background),
        data={name: base64.b64encode(block).decode() for name, block in blocks.items()},
        shaders={name: sources(name) for name in SHADERS},
    )


def require_page_size(count: int, name: str) -> None:
    """Raise UserError if a page can't show this number of Gaussians."""
    require_gaussians(count, name)
    if count > MAX_GAUSSIANS:
        raise UserError(
            f"{name} has {count:,} Gaussians, and a page shows at most {MAX_GAUSSIANS:,}: prune it "
            "first, for instance by `python -m threestudio_gaussiandreamer.prune IN small.ply "
            "--count 200000`, and view small.ply"
        )


def _checked(shown: Shown, name: str) -> Shown:
    """Drop what can't be drawn, as the exporters do, and check how many are left."""
    gaussians = finite(shown.cloud.gaussians.arrays(), name)
    require_page_size(len(gaussians.means), name)
    return shown._replace(cloud=shown.cloud._replace(gaussians=gaussians))


def _meta(clouds: Sequence[Shown], options: PageOptions, pose: Pose) -> dict[str, Any]:
    """Return the facts that the page's scripts read."""
    cloud, settings = clouds[0].cloud, options.settings
    properties = gaussian_properties(cloud.gaussians.sh.shape[1])
    vertices = ("vertex", len(cloud.gaussians.means), properties)
    header = header_bytes([vertices], notes_of(cloud, ".ply"))
    return {
        "title": options.title,
        "name": options.name,
        "background": hex_color(options.background),
        "camera": pose._asdict(),
        "clouds": [
            {
                "label": shown.label,
                "quality": shown.quality,
                "count": len(shown.cloud.gaussians.means),
                "degree": shown.cloud.gaussians.sh_degree,
                "toWorld": rotation_between(shown.cloud.up, WORLD_UP).tolist(),
            }
            for shown in clouds
        ],
        "plyHeader": header.decode("ascii"),
        "settings": {
            "eps2d": settings.eps2d,
            "antialias": settings.antialias,
            "alphaMin": settings.alpha_min,
            "alphaMax": RasterizeOptions.alpha_max,
            "boundColors": settings.bound_colors,
            "near": settings.near,
            "far": min(settings.far, float(np.finfo(np.float32).max)),
        },
    }


def packed(gaussians: Gaussians) -> bytes:
    """Compress the columns of a PLY file of Gaussians (arrays) but the normals to the bit, each as
    four planes (the lowest bytes of all values, then the next ones, ...).
    """
    names = [name for name, _ in gaussian_properties(gaussians.sh.shape[1])]
    stored = [number for number, name in enumerate(names) if name not in NORMALS]
    columns = np.ascontiguousarray(gaussian_columns(gaussians)[:, stored].T, dtype="<f4")
    planes = columns.view(np.uint8).reshape(*columns.shape, 4).transpose(0, 2, 1)
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)


def coarse(gaussians: Gaussians) -> Gaussians:
    """Round the attributes of a cloud, without harmonics above degree 0, to multiples of powers of
    two, whose lowest bytes vanish when packed.
    """
    side = float(np.ptp(gaussians.means, axis=0).max(initial=0))
    steps = {"means": 2.0 ** np.ceil(np.log2(max(side, 1e-30) / COARSE_MEANS)), "quats": 1 / 32}
    steps |= {"log_scales": 1 / 8, "logit_opacities": 1 / 8, "sh": 1 / 16}
    found = gaussians._replace(sh=gaussians.sh[:, :1])._asdict().items()
    return Gaussians(
        **{name: np.float32(np.rint(values / steps[name]) * steps[name]) for name, values in found}
    )


def _poster(poster: Any, background: Color) -> str:
    """Return the first view as the address of an embedded WebP picture."""
    file, opaque = io.BytesIO(), poster.copy()
    opaque.paste(hex_color(background), (0, 0, *poster.size))
    opaque.alpha_composite(poster)
    opaque.convert("RGB").save(file, "webp", quality=75)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


@cache
def sources(*names: str) -> str:
    """Join files of ``web/`` without indentation, blank lines and comment lines; scripts become one
    script in strict mode, with one global scope.
    """
    texts = [(WEB / name).read_text(encoding="utf-8") for name in names]
    lines = (line.strip() for text in texts for line in text.splitlines())
    joined = "\n".join(line for line in lines if line and not line.startswith("//"))
    return f'"use strict";\n{joined}' if names[0].endswith(".js") else joined


def policy(script: str, style: str) -> str:
    """Return the content security policy of a page with one script and one style sheet."""
    digests = (hashlib.sha256(x.encode()).digest() for x in (script, style))
    ours, looks = (base64.b64encode(digest).decode() for digest in digests)
    return (
        f"default-src 'none'; script-src 'sha256-{ours}'; style-src 'sha256-{looks}'; "
        "img-src data:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def decibels(psnr: Optional[float]) -> str:
    """Format the PSNR of a cloud on held-out views; empty if it isn't known."""
    known = psnr is not None and math.isfinite(psnr)
    return f"{psnr:.1f} dB on held-out views" if known else ""


@cache
def template(name: str) -> Any:
    """Open a template of ``web/``, which escapes every value."""
    import jinja2  # only where a page is written

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(WEB),
        undefined=jinja2.StrictUndefined,
        **{"autoescape": True, "trim_blocks": True, "lstrip_blocks": True},
    ).get_template(name)


def write_static(path: Path, name: str, **values: Any) -> None:
    """Write the page of a template that has no scripts; raises UserError if it can't be written."""
    content = template(name).render(values).encode(errors="replace")  # a name needn't be UTF-8
    write_file(path, content, durable=False)


def address(path: Path, page_folder: Path) -> str:
    """Return the relative address of a file from a page in ``page_folder``."""
    # as bytes, since a name needn't be UTF-8
    return quote(os.fsencode(os.path.relpath(path, page_folder).replace(os.sep, "/")))


# ---- the page of a file --------------------------------------------------------------------------


def cloud_page(
    source: Path,
    *,
    title: Optional[str] = None,
    eps2d: Optional[float] = None,
    preset: Optional[str] = None,
    antialias: Optional[bool] = None,
    bound_colors: Optional[bool] = None,
    background: Optional[str] = None,
    up: Optional[str] = None,
) -> tuple[Shown, PageOptions]:
    """Read a file of Gaussians or a checkpoint, and return the arguments of :func:`page`. Options
    that aren't given are those of the run whose folder contains the file, else defaults.

    Args:
        title: by default the prompt of the run, or the file's name.
        eps2d: screen-space dilation, square pixels.
        preset: of the rasteriser, for the smallest alpha that is drawn.
        background: RRGGBB; by default the run's or white, unless the object would vanish on it.
        up: the axis of the file that is up; by default from the file or its format's convention.

    Raises:
        UserError: an option is invalid, or the file can't be read, or has no or too many Gaussians.
    """
    if background is not None and not re.fullmatch("#?[0-9a-fA-F]{6}", background):
        raise UserError(f"--background: expected RRGGBB, such as ff8000, got {background!r}")
    color = background and tuple(x / 255 for x in bytes.fromhex(background.removeprefix("#")))
    if eps2d is not None and not 0 <= eps2d < 1e6:
        raise UserError(f"--eps2d: expected a number of square pixels from 0 on, got {eps2d:g}")
    stored, run = read_any(source, up), RunFiles.around(source)
    require_page_size(len(stored.gaussians.means), str(source))
    # the scores are those of the last export
    quality = decibels(run and run.psnr("result", step_of(source.resolve().parent)))
    if run:
        settings = run.settings
    else:  # the cloud's units aren't known
        near = NEAR * bounds(stored.gaussians.tensors())[1]
        settings = RenderSettings(near=near, far=math.inf, antialias=stored.antialiased)
    given = {"eps2d": eps2d, "antialias": antialias, "bound_colors": bound_colors}
    given["alpha_min"] = preset and PRESETS[preset]
    options = PageOptions(
        title=title or (run.prompt if run else source.name),
        name=source.stem,
        settings=settings._replace(**{name: x for name, x in given.items() if x is not None}),
        background=color or (run and run.background) or WHITE,
        keep_background=bool(color or (run and run.background_is_given)),
    )
    return Shown(stored, "result", quality), options
