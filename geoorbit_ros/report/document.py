"""A page of HTML that needs no other file: its frame, sections, figures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from geoorbit_ros.core.input_report import InputReport, Treatment


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


def remarks_section(reports: Sequence[InputReport]) -> str:
    """What was left out, repaired or is doubted; the doubts first. Nothing where all is well."""
    told = [
        (remark.treatment is Treatment.DOUBTFUL, f"{Path(report.place).name}: {sentence}")
        for report in reports
        for remark, sentence in zip(report.remarks, report.sentences(), strict=True)
    ]
    if not told:
        return ""
    items = "".join(
        f"<li class='doubt'><b>Doubtful.</b> {escape(text)}</li>"
        if doubt
        else f"<li>{escape(text)}</li>"
        for doubt, text in sorted(told, key=lambda pair: not pair[0])
    )
    return section("Remarks on the inputs", f"<ul>{items}</ul>")
