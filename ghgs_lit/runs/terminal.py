"""Tables on the terminal."""

from rich.console import Console
from rich.table import Table


def print_uncut(table: Table) -> None:
    """Print a table; where it is wider than the terminal its lines wrap, and no name or number is cut."""
    needed = Console(width=1000).measure(table).maximum
    Console(width=max(Console().width, needed)).print(table)
