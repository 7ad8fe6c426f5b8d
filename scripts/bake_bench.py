"""Write the thumbnails of a frozen split of ``data=synthetic`` into the package.

    python scripts/bake_bench.py bench

Run it only after increasing ``version`` in ``ghgs_people/bench/<split>.json``: results of different
versions are not comparable. Takes a few minutes.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from ghgs_lit.data.layout import Layout
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.errors import require_choice
from ghgs_people import bench
from ghgs_people.jobs import RenderOptions, SyntheticSource, everything, render_people
from ghgs_people.rig import Rig


def main(split: str) -> None:
    require_choice("split", split, bench.SPLITS)
    made, names, positions = bench.definition(split), bench.names(split), bench.POSITIONS
    seed, rig = made["data"]["people_seed"], Rig(height=made["data"]["rig"]["height"])
    wanted = made["data"]["render"]
    settings = RenderOptions(
        size=made["size"],
        positions=positions,
        views=(RING_VIEW,),
        samples=wanted["samples"],
        quality=wanted["quality"],
    )
    bench.check_settings(split, {"people_seed": seed, **everything(rig, settings)})
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        render_people(root, {split: names}, SyntheticSource(seed), rig, settings, seed)
        reader = Layout(root, split, names)
        found = [
            [
                bench.thumbnail(reader.read_view(name, position, RING_VIEW, False))
                for position in bench.POSITIONS
            ]
            for name in names
        ]
    np.savez_compressed(bench.FOLDER / f"{split}.npz", thumbnails=np.array(found))


if __name__ == "__main__":
    main(sys.argv[1])
