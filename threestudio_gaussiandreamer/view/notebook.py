"""Show a cloud in a notebook's output (Jupyter, Colab, Kaggle): the page of ``page.py``, embedded,
which needs no server and is stored with the notebook."""

import html
import os
from typing import Any, NamedTuple

from ..core.errors import UserError
from ..core.files import is_folder
from .page import cloud_page, page
from .run_files import cloud_file

MAX_BYTES = 20_000_000
"""Colab doesn't show an output that is larger."""


class EmbeddedPage(NamedTuple):
    """HTML that a notebook shows in the output of a cell; ``height`` in pixels."""

    content: str
    height: int

    def _repr_html_(self) -> str:
        # ASCII, so that the scripts keep the hashes of their policy in any encoding; the sandbox
        # keeps the page from the notebook's own content
        content = html.escape(self.content).encode("ascii", "xmlcharrefreplace").decode()
        return (
            f'<iframe srcdoc="{content}" allow="fullscreen" '
            f'sandbox="allow-scripts allow-downloads" width="100%" height="{int(self.height)}" '
            'style="border: 0"></iframe>'
        )

    def __repr__(self) -> str:
        return f"EmbeddedPage of {len(self.content) / 1e6:.2f} MB, which only a notebook shows"


def show(path: str | os.PathLike, *, height: int = 480, **options: Any) -> EmbeddedPage:
    """Return the interactive view of a cloud, for the last line of a cell.

    Args:
        path: the folder of a run, of which the last exported cloud is shown; or a file of Gaussians
            or a checkpoint.
        height: pixels.
        options: of :func:`.page.cloud_page`.

    Raises:
        UserError: also if the run has exported no cloud, or the page is too large for a notebook.
    """
    source = cloud_file(path)
    written = source.with_name("view.html")
    if is_folder(path) and not options and written.is_file():
        content = written.read_text(encoding="utf-8")  # shows the first cloud too
    else:
        content = page(*cloud_page(source, **options))
    if len(content) > MAX_BYTES:
        raise UserError(
            f"the page of {source} has {len(content) / 1e6:.0f} MB, more than the "
            f"{MAX_BYTES / 1e6:.0f} of a notebook's output: prune the cloud first, or write the "
            f"page to a file by `python -m threestudio_gaussiandreamer.view {source} --html`"
        )
    return EmbeddedPage(content, height)
