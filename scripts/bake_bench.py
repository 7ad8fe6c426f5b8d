"""Write the thumbnails of the frozen people of ``data=synthetic split=bench`` into the package.

    python scripts/bake_bench.py

Only after ``version`` in ``ghgs_lit/synthesis/bench/definition.json`` went up: results on the old version can
not be compared with those on the new one. Takes a few minutes.
"""

import tempfile
from pathlib import Path

import numpy as np

from ghgs_lit.data.layout import Layout
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.synthesis import bench
from ghgs_lit.synthesis.jobs import RenderOptions, SyntheticSource, everything, render_people
from ghgs_lit.synthesis.rig import Rig


def main() -> None:
    data = bench.definition()["data"]
    seed, rig = data["people_seed"], Rig(height=data["rig"]["height"])
    wanted = data["render"]
    settings = RenderOptions(
        size=bench.definition()["size"],
        positions=bench.POSITIONS,
        views=(RING_VIEW,),
        samples=wanted["samples"],
        quality=wanted["quality"],
    )
    bench.check_settings({"people_seed": seed, **everything(rig, settings)})
    with tempfile.TemporaryDirectory() as folder:
        root, people = Path(folder), {bench.SPLIT: bench.names()}
        render_people(root, people, SyntheticSource(seed), rig, settings, seed)
        reader = Layout(root, bench.SPLIT, bench.names())
        found = [
            [
                bench.thumbnail(reader.read_view(name, position, RING_VIEW, False))
                for position in bench.POSITIONS
            ]
            for name in bench.names()
        ]
    np.savez_compressed(bench.FOLDER / "thumbnails.npz", thumbnails=np.array(found))


if __name__ == "__main__":
    main()
