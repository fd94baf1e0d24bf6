"""Write a cloud as one HTML file that shows it in any browser with WebGL2, from disk and without a
network request.

The sources of the page are in ``web/``: the renderer executes the image model of
``splatting/reference.py``. Its content security policy forbids every request and every script but
its own."""

import base64
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file
from ..formats.gaussian_files import StoredCloud, ply_notes, spz_note
from ..formats.ply import gaussian_properties, header_bytes
from ..formats.spz import SPZ_UP, spz_bytes
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.gaussians import finite
from ..splatting.options import RasterizeOptions
from .page_data import coarse, packed
from .poster import WHITE, Color, backdrop, hex_color, picture
from .render import Pose, RenderSettings, first_pose, require_gaussians

WEB = Path(__file__).with_name("web")
SCRIPTS = ("camera.js", "sorter.js", "cloud.js", "renderer.js", "controls.js", "main.js")
SHADERS = ("splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl")
MAX_GAUSSIANS = 2_000_000
"""A browser takes minutes to open a page with more, or runs out of memory."""
POSTER_SIZE = 320
"""Width and height in pixels of the picture that a browser without WebGL2 shows."""


class Shown(NamedTuple):
    """A cloud of a page."""

    cloud: StoredCloud
    label: str
    """Its name in the page's list of clouds."""
    quality: str = ""
    """Its PSNR and the views on which that was measured; empty if unknown."""


class PageOptions(NamedTuple):
    """What is common to the clouds of a page."""

    title: str
    name: str
    """Name, without extension, of the files that the page saves."""
    settings: RenderSettings
    background: Color = WHITE
    keep_background: bool = False
    """Whether the object may vanish on it, since the user has chosen it."""


def write_page(
    path: Path, shown: Shown, options: PageOptions, before: Optional[Shown] = None
) -> None:
    """Write the page of a cloud, which can save its PLY and SPZ files.

    Args:
        before: a second cloud to compare with, such as the prior; it is stored in lower precision.

    Raises:
        UserError: there are too many Gaussians or none, they reach too far for float32, or the file
            can't be written.
    """
    content = page(shown, options, before)
    with atomic_file(path) as file:
        # a title may be a file's name, whose bytes needn't be UTF-8
        file.write(content.encode(errors="replace"))


def page(shown: Shown, options: PageOptions, before: Optional[Shown] = None) -> str:
    """Make the page of :func:`write_page`; same arguments and errors."""
    shown = _checked(shown, options.name)
    clouds = [shown]
    if before is not None:
        before = _checked(before, before.label)
        clouds.append(before._replace(cloud=_coarse(before.cloud)))
    pose = first_pose(shown.cloud)
    poster = picture(shown.cloud, options.settings, pose, POSTER_SIZE)
    if not options.keep_background:
        options = options._replace(background=backdrop(poster, options.background))
    script = sources(SCRIPTS)
    style = sources(["page.css"])
    fields = {
        "policy": policy(script, style),
        "title": html.escape(options.title),
        "style": style,
        "script": script,
        "meta": _script_json(_meta(clouds, options, pose)),
        "poster": _poster(poster, options.background),
        "data": _data_blocks(clouds),
        **{name: sources([name]) for name in SHADERS},
    }
    # in one pass, so that a prompt that holds "{{data}}" stays as it is
    template = (WEB / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{([\w.]+)\}\}", lambda match: fields[match[1]], template)


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
    """Drop what can't be drawn, as the exporters do, and check the number that is left."""
    gaussians = finite(shown.cloud.gaussians.arrays(), name)
    require_page_size(len(gaussians.means), name)
    return shown._replace(cloud=shown.cloud._replace(gaussians=gaussians))


def _coarse(cloud: StoredCloud) -> StoredCloud:
    return cloud._replace(gaussians=coarse(cloud.gaussians))


def _meta(clouds: Sequence[Shown], options: PageOptions, pose: Pose) -> dict[str, Any]:
    """Return the facts that the page's scripts read."""
    cloud, settings = clouds[0].cloud, options.settings
    properties = gaussian_properties(cloud.gaussians.sh.shape[1])
    header = header_bytes(properties, len(cloud.gaussians.means), ply_notes(cloud))
    return {
        "title": options.title,
        "name": options.name,
        "background": hex_color(options.background),
        "camera": pose._asdict(),
        "clouds": [_facts(shown) for shown in clouds],
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


def _facts(shown: Shown) -> dict[str, Any]:
    gaussians = shown.cloud.gaussians
    return {
        "label": shown.label,
        "quality": shown.quality,
        "count": len(gaussians.means),
        "degree": gaussians.sh_degree,
        "toWorld": rotation_between(shown.cloud.up, WORLD_UP).tolist(),
    }


def _data_blocks(clouds: Sequence[Shown]) -> str:
    blocks = {f"cloud-{i}": packed(shown.cloud.gaussians) for i, shown in enumerate(clouds)}
    stored = clouds[0].cloud
    blocks["spz"] = spz_bytes(
        stored.in_axes(SPZ_UP).gaussians,
        comment=spz_note(stored),
        antialiased=stored.antialiased,
    )
    return "\n".join(
        f'<script type="text/plain" id="{name}">{base64.b64encode(data).decode()}</script>'
        for name, data in blocks.items()
    )


def _poster(poster: Any, background: Color) -> str:
    """Return the first view as the address of an embedded WebP picture."""
    file, opaque = io.BytesIO(), poster.copy()
    opaque.paste(hex_color(background), (0, 0, *poster.size))
    opaque.alpha_composite(poster)
    opaque.convert("RGB").save(file, "webp", quality=75)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


# ---- the page's own sources ----------------------------------------------------------------------


@cache
def _source(name: str) -> str:
    """Read a file of ``web/``; drop indentation, blank lines and comment lines."""
    lines = (line.strip() for line in (WEB / name).read_text(encoding="utf-8").splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


def sources(names: Sequence[str]) -> str:
    """Join files of ``web/``; scripts become one script in strict mode, with one global scope."""
    joined = "\n".join(map(_source, names))
    return f'"use strict";\n{joined}' if names[0].endswith(".js") else joined


def policy(script: str, style: str) -> str:
    """Return the content security policy of a page with one script and one style sheet."""
    hashes = [
        base64.b64encode(hashlib.sha256(x.encode()).digest()).decode() for x in (script, style)
    ]
    return (
        f"default-src 'none'; script-src 'sha256-{hashes[0]}'; style-src 'sha256-{hashes[1]}'; "
        "img-src data:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def _script_json(content: Any) -> str:
    """Encode as JSON for a script element; escape what could end the element, such as "<"."""
    text = json.dumps(content, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def decibels(psnr: Optional[float]) -> str:
    """Format the PSNR of a cloud on held-out views; empty if it isn't known."""
    known = psnr is not None and math.isfinite(psnr)
    return f"{psnr:.1f} dB on held-out views" if known else ""
