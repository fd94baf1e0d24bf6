"""Static HTML: pages without scripts, of escaped text, tables, and links to files beside them."""

import html
import os
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from urllib.parse import quote

from .poster import backdrop_of_file, hex_color

WEB = Path(__file__).with_name("web")
POLICY = "script-src 'none'; object-src 'none'; base-uri 'none'; form-action 'none'"


@cache
def _style() -> str:
    return (WEB / "static.css").read_text(encoding="utf-8")


def document(title: str, parts: Iterable[str]) -> str:
    """Return a whole page of parts that are HTML already."""
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<title>{html.escape(title)}</title><link rel="icon" href="data:,">',
            f"<style>{_style()}</style></head><body>",
            *parts,
            "</body></html>\n",
        ]
    )


def is_own_page(path: Path) -> bool:
    """Return whether a file is a page that :func:`document` made."""
    with open(path, encoding="utf-8", errors="replace") as file:
        return POLICY in file.read(1000)


def element(name: str, text: str, **attributes: str) -> str:
    """Return an element that holds a text, which is escaped, as attributes are."""
    return f"<{name}{_attributes(attributes)}>{html.escape(text)}</{name}>"


def media(name: str, **attributes: str) -> str:
    """Return an element without content, such as a picture."""
    return f"<{name}{_attributes(attributes)}>"


def section(title: str, *parts: str) -> str:
    """Return a section with a heading, or nothing if all its parts are empty."""
    content = "".join(parts)
    return f"<section>{element('h2', title)}{content}</section>" if content else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts; nothing if it has no rows."""
    body = "".join(f"<tr>{''.join(element('td', cell) for cell in row)}</tr>" for row in rows)
    heads = "".join(element("th", cell) for cell in head)
    return f"<table><tr>{heads}</tr>{body}</table>" if body else ""


def address(path: Path, page_folder: Path) -> str:
    """Return the relative address of a file from a page in ``page_folder``."""
    # as bytes, since a name needn't be UTF-8
    return quote(os.fsencode(os.path.relpath(path, page_folder).replace(os.sep, "/")))


def backdrop_style(picture: Path) -> dict[str, str]:
    """Return the attribute that keeps a picture's object from vanishing on the page's white."""
    color = backdrop_of_file(picture)
    return {"style": f"background: {hex_color(color)}"} if color else {}


def link(path: Path, page_folder: Path, text: str) -> str:
    return element("a", text, href=address(path, page_folder))


def _attributes(attributes: dict[str, str]) -> str:
    # a trailing underscore or none: "class_" is the attribute "class"
    return "".join(
        f' {name.rstrip("_")}="{html.escape(value)}"' for name, value in attributes.items()
    )
