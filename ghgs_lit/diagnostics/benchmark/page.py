"""``benchmark.html``: the figure, whose points say what they are when one points at them, and the tables."""

import html
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

from ghgs_lit.diagnostics.benchmark.plot import Drawing
from ghgs_lit.diagnostics.benchmark.report import Table

_SVG = "http://www.w3.org/2000/svg"
_STYLE = (
    "body { font: 14px sans-serif; margin: 2em; } svg { max-width: 100%; height: auto; }"
    " table { border-collapse: collapse; margin: 1em 0; } td, th { padding: 3px 9px; text-align: right;"
    " border-bottom: 1px solid #ddd; } td:first-child, th:first-child { text-align: left; }"
    " .hint { cursor: pointer; } .hint:hover { opacity: 0.5; }"
)


def to_page(drawing: Drawing, tables: Sequence[Table], notes: Sequence[str]) -> str:
    """A page that needs no other file.

    Args:
        drawing: the figure.
        tables: below it.
        notes: between the two.
    """
    parts = ["<!DOCTYPE html>", '<html lang="en"><head><meta charset="utf-8"><title>Benchmark</title>']
    parts += [f"<style>{_STYLE}</style></head><body>", "<h1>Benchmark</h1>", with_hints(drawing)]
    parts += [f"<p>{html.escape(note)}</p>" for note in notes]
    for table in tables:
        parts += [f"<h2>{html.escape(table.title)}</h2>", "<table>", _line(table.header, "th")]
        parts += [_line(line, "td") for line in table.lines] + ["</table>"]
    return "\n".join([*parts, "</body></html>", ""])


def with_hints(drawing: Drawing) -> str:
    """The figure as SVG whose elements have their hints as titles, which browsers show."""
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", "http://www.w3.org/1999/xlink")
    root = ElementTree.fromstring(drawing.svg())
    for element in root.iter(f"{{{_SVG}}}g"):
        hint = drawing.hints.get(element.get("id", ""))
        if hint is not None:
            element.set("class", "hint")
            title = ElementTree.Element(f"{{{_SVG}}}title")
            title.text = hint
            element.insert(0, title)
    return ElementTree.tostring(root, encoding="unicode")


def _line(cells: Sequence[str], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"
