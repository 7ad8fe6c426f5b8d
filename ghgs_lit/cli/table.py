"""``ghgs table``: the runs below a directory as the paper's ablation table."""

from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from ghgs_lit.cli.runtime import announce, output_dir, plain
from ghgs_lit.errors import require
from ghgs_lit.experiments.table import caption, collect, notes, to_csv, to_markdown, to_terminal


def run(cfg: DictConfig) -> None:
    config = plain(cfg)
    views, targets = config["evaluation"]["views"], config["evaluation"]["targets"]
    are_counts = isinstance(views, list) and bool(views) and all(isinstance(n, int) for n in views)
    require(are_counts, "evaluation.views", "a list of numbers of views", views)
    targets = [targets] if isinstance(targets, str) else targets
    tables = collect(Path(config["sweep"]).expanduser(), targets)
    text = "\n".join(to_markdown(table, views, config["illustration"]) for table in tables)
    directory = output_dir()
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "table.csv").write_text(to_csv(tables, views))
    (directory / "table.md").write_text(text)
    for table in tables:
        printed = to_terminal(table, views)
        # A number cut short is worse than a line that wraps.
        needed = Console(width=1000).measure(printed).maximum
        console = Console(width=max(Console().width, needed))
        console.print(caption(table).replace("`", ""))
        console.print(printed)
        console.print("\n".join(notes(table, config["illustration"])).replace("**", ""))
    announce(directory / "table.md")
