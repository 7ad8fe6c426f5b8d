"""Tables as Markdown and on a terminal."""

from rich.table import Table as RichTable

from ghgs_lit.evaluation.tables.layouts import Line, Table, arrow, title
from ghgs_lit.evaluation.tables.text import cell_text


def _headings(table: Table, between: str) -> list[str]:
    """The name of each column after that of its group, where the layout has one."""
    named = table.layout.heading != "none"
    return [
        (f"{group.title}{between}" if named else "") + f"{title(metric)} {arrow(metric)}".strip()
        for group, metric in table.columns
    ]


def _entries(table: Table, line: Line) -> list[tuple[str, bool]]:
    """A row's numbers as printed, and whether each is the best of its column."""
    texts = (cell_text(line.cells.get(column), line, column[1]) for column in table.columns)
    return [
        (t.mean + (f" ± {t.spread}" if t.spread else "") + t.tail.replace("*", "\\*"), t.best) for t in texts
    ]


def to_markdown(table: Table) -> str:
    """The table with its caption above and its notes below."""
    names = _headings(table, " ")
    aligned = ":-:" if len(table.stub) > 1 else ":--"
    lines = [
        "| " + " | ".join((*table.stub, *names)) + " |",
        f"|{'|'.join([aligned] * len(table.stub) + ['--:'] * len(names))}|",
    ]
    for block in table.blocks:
        if table.reported_on:
            empty = " |" * (len(table.stub) + len(names) - 1)
            lines.append(f"| *{table.block_title(block)}* |{empty}")
        for line in block:
            cells = [f"**{text}**" if best else text for text, best in _entries(table, line)]
            lines.append("| " + " | ".join((*line.stub, *cells)) + " |")
    return "\n\n".join((table.caption, "\n".join(lines), *table.notes)) + "\n"


def to_terminal(table: Table) -> RichTable:
    """The table for a terminal, without its caption and notes."""
    printed = RichTable(padding=(0, 1, 0, 0))
    short = {"3D Unproj.": "3D\nunp.", "Semantic Cons.": "sem.\ncons."}
    for name in table.stub:
        justify = "center" if name in short else "left"
        printed.add_column(short.get(name, name), justify=justify, no_wrap=True)
    for name in _headings(table, "\n"):
        printed.add_column(name, justify="right", no_wrap=True)
    for block in table.blocks:
        for line in block:
            mark = "† " if line.is_reported else ""
            cells = [
                (f"[bold green]{text}[/]" if best else text).replace("\\*", "*")
                for text, best in _entries(table, line)
            ]
            printed.add_row(mark + line.stub[0], *line.stub[1:], *cells)
        printed.add_section()
    return printed
