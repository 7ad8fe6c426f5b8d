"""Tables as Markdown and for a terminal."""

from rich.table import Table as RichTable

from ghgs_lit.tables.layouts import Column, Line, Table, arrow, title
from ghgs_lit.tables.text import cell_text


def heading(column: Column, table: Table) -> str:
    """A column's name with its group's, where the layout has one."""
    group, metric = column
    name = f"{title(metric)} {arrow(metric)}".strip()
    return name if table.layout.heading == "none" else f"{group.title} {name}"


def _entries(table: Table, line: Line) -> list[tuple[str, bool]]:
    """A row's numbers as printed, and whether each is the best of its column."""
    texts = (cell_text(line.cells.get(column), line, column[1]) for column in table.columns)
    return [
        (t.mean + (f" ± {t.spread}" if t.spread else "") + t.tail.replace("*", "\\*"), t.best) for t in texts
    ]


def block_title(table: Table) -> str:
    """What stands above reported rows."""
    return f"as reported on {table.reported_on}, not measured here"


def to_markdown(table: Table) -> str:
    """The table with its caption above and its notes below."""
    names = [heading(column, table) for column in table.columns]
    aligned = ":-:" if len(table.stub) > 1 else ":--"
    lines = [
        "| " + " | ".join((*table.stub, *names)) + " |",
        f"|{'|'.join([aligned] * len(table.stub) + ['--:'] * len(names))}|",
    ]
    for block in table.blocks:
        reported = block[0].variant.kind == "reported"
        if reported:
            lines.append("| *" + block_title(table) + "* |" + " |" * (len(table.stub) + len(names) - 1))
        for line in block:
            cells = [f"**{text}**" if best else text for text, best in _entries(table, line)]
            lines.append("| " + " | ".join((*line.stub, *cells)) + " |")
        if reported and len(table.blocks) > 1:
            lines.append("| *measured here* |" + " |" * (len(table.stub) + len(names) - 1))
    return "\n\n".join((table.caption, "\n".join(lines), *table.notes)) + "\n"


def to_terminal(table: Table) -> RichTable:
    """The table alone, for a terminal."""
    printed = RichTable(padding=(0, 1, 0, 0))
    short = {"3D Unproj.": "3D\nunp.", "Semantic Cons.": "sem.\ncons."}
    for name in table.stub:
        justify = "center" if name in short else "left"
        printed.add_column(short.get(name, name), justify=justify, no_wrap=True)
    for group, metric in table.columns:
        above = "" if table.layout.heading == "none" else f"{group.title}\n"
        printed.add_column(f"{above}{title(metric)} {arrow(metric)}".strip(), justify="right", no_wrap=True)
    for block in table.blocks:
        for line in block:
            mark = "† " if line.variant.kind == "reported" else ""
            cells = [
                (f"[bold green]{text}[/]" if best else text).replace("\\*", "*")
                for text, best in _entries(table, line)
            ]
            printed.add_row(mark + line.stub[0], *line.stub[1:], *cells)
        printed.add_section()
    return printed
