"""Reads columns, headings, rules and rows of a LaTeX ``tabular``."""

import re


def unbraced(text: str) -> str:
    """Without commands around a cell's text: ``\\textbf{1.0}`` is ``1.0``."""
    before = None
    while before != text:
        before = text
        text = re.sub(r"\\(?:textbf|emph)\{([^{}]*)\}", r"\1", text)
    return re.sub(r"\s+", " ", text).strip()


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)&", row)]


def _headings(cells: list[str]) -> list[list]:
    """``[text, span]`` of each heading; ``\\multirow`` is one of span 1."""
    found = []
    for cell in cells:
        span = re.match(r"\\multicolumn\{(\d+)\}\{[^}]*\}\{(.*)\}$", cell, re.S)
        text = span[2] if span else cell
        text = re.sub(r"^\{?\\multirow\{\d+\}\{\*\}(?:\[[^]]*\])?\{(.*?)\}+$", r"\1", text, flags=re.S)
        found.append([unbraced(text), int(span[1]) if span else 1])
    return found


def read_tabular(text: str) -> dict:
    """The first ``tabular`` of ``text``: ``columns``, ``headings``, ``cmidrules``, ``metrics``,
    ``rows``.

    ``rows`` are the rows of numbers, as ``[cells, indices of bold cells]``.
    """
    columns, inside = re.search(r"\\begin\{tabular\}\{([^}]*)\}(.*?)\\end\{tabular\}", text, re.S).groups()
    inside = re.sub(r"(?m)%.*$", "", inside)
    cmidrules = [[int(a), int(b)] for a, b in re.findall(r"\\cmidrule\(lr\)\{(\d+)-(\d+)\}", inside)]
    inside = re.sub(r"\\(?:toprule|midrule|bottomrule|hline|cmidrule\(lr\)\{[^}]*\})", "", inside)
    rows = [r for r in (_cells(row) for row in inside.split("\\\\")) if any(r)]
    where = next(i for i, row in enumerate(rows) if any("PSNR" in cell for cell in row))
    return {
        "columns": re.sub(r"\s", "", columns),
        "headings": [_headings(row) for row in rows[:where]],
        "cmidrules": cmidrules,
        "metrics": [text for text, _ in _headings(rows[where]) if text],
        "rows": [
            [[unbraced(c) for c in row], [i for i, c in enumerate(row) if "\\textbf" in c]]
            for row in rows[where + 1 :]
            if len(row) > 1
        ],
    }


def check_balance(text: str) -> None:
    """Assert that braces and environments are closed in order and special characters
    are escaped."""
    assert text.count("{") - text.count("\\{") == text.count("}") - text.count("\\}")
    opened = []
    for kind, name in re.findall(r"\\(begin|end)\{([^}]*)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    assert text.isascii()
    assert not re.search(r"(?<!\\)[#_]", re.sub(r"\\(?:label|begin|end)\{[^}]*\}", "", text))
