r"""One configuration against itself: how often ``ghgs table`` marks one half of its seeds against the other.

    ghgs train -m experiment=demo trainer.max_steps=60 data.people.val=12 seed=1,2,3,4,5,6 \
        hydra.sweep.dir=runs/same
    python benchmarks/one_configuration.py runs/same

Every division of the seeds into halves, each as two rows of a table, in every pairing of their seeds. A table
of chance alone may have a star in as many of a hundred as its level says.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations
from pathlib import Path

import pandas as pd

from ghgs_lit.evaluation.tables import LAYOUTS, PairedTest, TableOptions, build_tables, read_sweep
from ghgs_lit.evaluation.tables.records import Sweep


def halves(rows: pd.DataFrame) -> Iterator[tuple[tuple, pd.DataFrame]]:
    """Each division of the seeds, and the rows under two names with common seeds, in every pairing."""
    seeds = sorted(rows["seed"].unique())
    own = rows["variant"].iloc[0]
    other = replace(own, switches=(False, False))
    for half in combinations(seeds, len(seeds) // 2):
        if half[0] != seeds[0]:
            continue  # the same division, the other way round
        rest = [seed for seed in seeds if seed not in half]
        for order in permutations(rest):
            paired = {seed: i for part in (half, order) for i, seed in enumerate(part)}
            variants = [own if seed in half else other for seed in rows["seed"]]
            yield half, rows.assign(variant=variants, seed=rows["seed"].map(paired))


def main(folder: str) -> None:
    sweep = read_sweep([Path(folder)])
    tables, cells, least, divisions = [], [], [], set()
    for against in ("full", "best"):
        options = TableOptions(LAYOUTS["ablation"], test=PairedTest(against=against))
        for half, rows in halves(sweep.rows):
            for table in build_tables(Sweep(rows, [], sweep.configs), [], options):
                marked = table.cells["marked"]
                compared = [test for test in table.cells["test"] if test is not None and test.p is not None]
                tables.append(bool(marked.any()))
                cells += [test.corrected < options.test.alpha for test in compared]
                least.append(min(test.corrected for test in compared))
                divisions |= {half} if marked.any() else set()
    print(f"marked: {sum(tables)} of {len(tables)} tables, {sum(cells)} of {len(cells)} cells")
    print(f"divisions with a mark: {len(divisions)}")
    print(f"least corrected p {min(least):.3f}; level {PairedTest().alpha}")
    seeds = sweep.rows.groupby(["targets", "views", "seed"])["psnr"].mean().groupby(["targets", "views"])
    print(seeds.agg(["mean", "std"]).round(3))


if __name__ == "__main__":
    main(sys.argv[1])
