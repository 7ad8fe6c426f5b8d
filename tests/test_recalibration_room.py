"""``benchmarks/recalibration_room.py``: rows differ as their names describe."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import recalibration_room as room
from ghgs_lit.method.encoder.semantic import SemanticOptions
from ghgs_lit.types import Targets
from tests.helpers.bodies import body_batch


@pytest.fixture(scope="module")
def person():
    batch, _ = body_batch(1, 4, 112, 84)
    torch.manual_seed(0)
    batch = replace(batch, targets=Targets(batch.images, batch.masks, batch.cameras))
    person = room.prepare(SemanticOptions().build(room.PATCH), batch)
    tokens = replace(person.tokens, semantic=torch.rand(len(person.part), 16))
    return replace(person, tokens=tokens)


def test_errors_are_planted_by_part_and_view(person):
    """Between 5 and 15 cm, one value for each part in a view."""
    scene = room.plant(person, np.random.default_rng(0))
    errors = (scene.depth_maps.depth - person.batch.depths)[0]
    masks = person.batch.masks[0]
    assert ((errors[masks].abs() > 0.049) & (errors[masks].abs() < 0.151)).all()
    for view in range(4):
        for part in person.labels[view][masks[view]].unique():
            assert errors[view][masks[view] & (person.labels[view] == part)].std(correction=0) < 1e-5


def test_each_row_trains_and_differs(person, capsys):
    """Two steps of all rows with the same weights, people and errors."""
    changed = []
    scene = room.plant(person, np.random.default_rng(0))
    for row in room.ROWS:
        model = room.train(row, 1, 2, [person])
        values = room.measure(model, [person])
        assert np.isfinite([values["surface_mm"], values["psnr"]]).all()
        changed.append(model.recalibration(model.tokens(scene), scene.points, person.plan).latent[-1])
    for one, other in itertools.combinations(changed, 2):
        assert (one - other).abs().max() > 1e-5
    room.check(person)
    assert "same part: 100% of attention" in capsys.readouterr().out


def test_shares_are_those_of_the_ceiling(capsys):
    """Consecutive rows differ by the same amount; only seeds common to all rows count."""
    results = [{"row": "none", "seed": 2, "surface_mm": [0.0, 0.0], "psnr": [0.0, 0.0]}]
    for number, row in enumerate(room.ROWS):
        values = {"surface_mm": [100.0 - number, 90.0 - number], "psnr": [20.0 + number, 21.0 + number]}
        results.append({"row": row, "seed": 1, **values})
    room.print_table(results, list(room.ROWS))
    printed = capsys.readouterr().out
    assert "| s = 1 | 94.00 | 16.7% (16.7% to 16.7%) | 21.50 | 16.7% (16.7% to 16.7%) |" in printed
    assert "| ceiling | 89.00 | 100.0%" in printed
