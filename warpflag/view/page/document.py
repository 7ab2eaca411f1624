"""The page of a record put together: one HTML file that loads nothing from outside."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from pathlib import Path

from warpflag.base.output import OutputError, whole
from warpflag.record import Record
from warpflag.view.page.content import content

__all__ = ["notebook_frame", "page_of", "write_page"]

_NOTEBOOK_BYTES = 2 << 20  # of a page inside a notebook, which is stored with it
_NOTEBOOK_HEIGHT = 740  # pixels: the page without a scroll bar


def write_page(record: Record, path: str | Path, color_by: str = "flagellum", follow: bool = True) -> None:
    """Writes the page of a record; the file is whole or absent.

    Args:
        record: the run to show.
        path: ends in .html.
        color_by: quantity that colours the flagella at first; the page lets it be changed.
        follow: whether the view goes with the cell at first; the page lets it be changed.

    Raises:
        OutputError: another ending, or an unknown quantity.
        RecordError: a record without frames.
        OSError: the file can't be written.
    """
    path = Path(path)
    if path.suffix not in (".html", ".htm"):
        raise OutputError(f"{path}: a page must end in .html")
    page = page_of(record, color_by, follow)
    with whole(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def page_of(record: Record, color_by: str = "flagellum", follow: bool = True, most_bytes: int | None = None) -> str:
    """The page of a record as text of an HTML file.

    Args:
        record: the run to show.
        color_by: quantity that colours the flagella at first.
        follow: whether the view goes with the cell at first.
        most_bytes: frames are left out evenly until positions and colours take no more than this; None: all stay.

    Raises:
        OutputError: an unknown quantity, or numbers that are not finite where the cell is drawn.
        RecordError: a record without frames.
    """
    shown = content(record, color_by, follow, most_bytes)
    # Within <script> only "</" could end the element.
    written = json.dumps(shown, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    parts = {
        "title": html.escape(shown["name"]),
        "style": _part("page.css"),
        "three": _part("three/three.min.js"),
        "script": "".join(_part(name) for name in ("cell.js", "plots.js", "controls.js")),
        "content": written,
    }
    page = _part("page.html")
    for name, text in parts.items():
        page = page.replace(f"<!-- {name} -->", text, 1)
    return page


def notebook_frame(record: Record) -> str:
    """The page of a record in a frame, as a notebook shows it; a long record with some of its frames only."""
    page = html.escape(page_of(record, most_bytes=_NOTEBOOK_BYTES), quote=True)
    return (
        f'<iframe srcdoc="{page}" width="100%" height="{_NOTEBOOK_HEIGHT}" style="border:0" '
        f'title="{html.escape(str(record.path))}"></iframe>'
    )


def _part(name: str) -> str:
    return files("warpflag.view.page").joinpath(name).read_text(encoding="utf-8")
