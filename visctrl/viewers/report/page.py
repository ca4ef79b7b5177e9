"""The frame of an HTML page that needs no other file: style, script, tables, pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path

import cv2
import numpy as np

import visctrl
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_bytes

_JPEG_QUALITY = 82
_MOST_BYTES = 64_000_000


def page(title: str, body: str) -> str:
    """Return a whole document.

    Parameters
    ----------
    title : str
        Plain text.
    body : str
        HTML.
    """
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{part('report.css')}</style></head>\n"
        f"<body><main>{body}</main>\n"
        f"<footer><p>visctrl {escape(visctrl.__version__)}</p></footer>"
        f"<script>{part('report.js')}</script></body></html>\n"
    )


def part(name: str) -> str:
    """Return the text of a file that belongs to the pages."""
    return (resources.files("visctrl.viewers.report") / "page" / name).read_text(encoding="utf-8")


def section(title: str, content: str, *, closed: bool = False) -> str:
    """Return a part of the page under a title; a closed one is opened by a click."""
    head = escape(title)
    if closed:
        return f"<details><summary>{head}</summary>{content}</details>"
    return f"<section><h2>{head}</h2>{content}</section>"


def tiles(items: Iterable[tuple[str, str]]) -> str:
    """Return numbers with what they are, side by side."""
    cells = (f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in items)
    return f'<dl class="tiles">{"".join(cells)}</dl>'


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of HTML cells; the first one of a row is its head."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr><th>{row[0]}</th>{''.join(f'<td>{cell}</td>' for cell in row[1:])}</tr>"
        for row in rows
    )
    rows_of = f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
    return f'<div class="wide"><table>{rows_of}</table></div>'


def verdict(status: str) -> str:
    """Return how a run ended as a coloured word."""
    return f'<span class="verdict {escape(status)}">{escape(status)}</span>'


def picture(file: Path, caption: str) -> str:
    """Return a ``<figure>`` that holds a picture; empty where there is none."""
    try:
        data = np.frombuffer(read_bytes(file, _MOST_BYTES), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except (InputError, cv2.error):
        return ""
    if image is None:
        return ""
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not ok:
        return ""
    high, wide = image.shape[:2]
    encoded = base64.b64encode(data.tobytes()).decode("ascii")
    return (
        f'<figure class="picture"><img alt="{escape(caption)}" width="{wide}" height="{high}" '
        f'src="data:image/jpeg;base64,{encoded}"><figcaption>{escape(caption)}</figcaption></figure>'
    )


def download(name: str, text: str) -> str:
    """Return a link that saves ``text`` as a file."""
    encoded = base64.b64encode(text.encode()).decode("ascii")
    return (
        f'<a class="button" download="{escape(name)}" '
        f'href="data:text/plain;charset=utf-8;base64,{encoded}">Save {escape(name)}</a>'
    )
