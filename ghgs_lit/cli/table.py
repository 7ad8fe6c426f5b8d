"""``ghgs table``: the runs below a directory as the paper's ablation table."""

from pathlib import Path

import rich
from omegaconf import DictConfig
from rich.markdown import Markdown

from ghgs_lit.cli.runtime import announce, output_dir, plain
from ghgs_lit.errors import require
from ghgs_lit.experiments.table import collect, to_csv, to_markdown


def run(cfg: DictConfig) -> None:
    config = plain(cfg)
    views, targets = config["views"], config["targets"]
    are_counts = isinstance(views, list) and bool(views) and all(isinstance(n, int) for n in views)
    require(are_counts, "views", "a list of numbers of views", views)
    targets = [targets] if isinstance(targets, str) else targets
    tables = collect(Path(config["sweep"]).expanduser(), targets)
    text = "\n".join(to_markdown(table, views, config["illustration"]) for table in tables)
    directory = output_dir()
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "table.csv").write_text(to_csv(tables, views))
    (directory / "table.md").write_text(text)
    rich.print(Markdown(text))
    announce(directory / "table.md")
