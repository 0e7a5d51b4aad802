"""A page of HTML that needs no other file: its frame, sections, figures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files


def document(title: str, body: str) -> str:
    """The whole page around ready markup."""
    css = files("geoorbit_ros.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{css}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )


def section(title: str, body: str) -> str:
    """A part of the page with a heading."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def figure(svg: str, caption: str, css: str) -> str:
    """A drawing with the sentence below it."""
    note = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="{css}"><div class="drawing">{svg}</div>{note}</figure>'


def bullets(sentences: Sequence[str]) -> str:
    """A list, or nothing."""
    items = "".join(f"<li>{escape(x)}</li>" for x in sentences)
    return f"<ul>{items}</ul>" if items else ""
