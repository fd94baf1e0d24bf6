"""Fill the templates of pages in ``web/``, which escape every value."""

import os
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..core.files import atomic_file

WEB = Path(__file__).with_name("web")


@cache
def _environment() -> Any:
    import jinja2  # only where a page is written

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(WEB),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def fill(template: str, **values: Any) -> str:
    """Return the page of a template."""
    return _environment().get_template(template).render(values)


def write_static(path: Path, template: str, **values: Any) -> None:
    """Write the page of a template that has no scripts.

    Raises:
        UserError: it can't be written.
    """
    content = fill(template, **values).encode(errors="replace")  # names of files needn't be UTF-8
    with atomic_file(path, durable=False) as file:
        file.write(content)


def address(path: Path, page_folder: Path) -> str:
    """Return the relative address of a file from a page in ``page_folder``."""
    # as bytes, since a name needn't be UTF-8
    return quote(os.fsencode(os.path.relpath(path, page_folder).replace(os.sep, "/")))
