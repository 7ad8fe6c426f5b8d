"""Pretext training: labels of patches compared with loops over pixels, loss and metric, and its command."""

import dataclasses
import functools
import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.runs import model_variant
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.method.encoder.semantic import SemanticOptions
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training.pretext import (
    PARTS,
    Pretext,
    cross_entropy,
    neighbor_shows_part,
    part_shares,
    parts_of_points,
)
from ghgs_people.figures.body import BODY_VERTICES, load_body
from ghgs_people.figures.parts import vertex_parts
from tests.helpers.bodies import body_batch
from tests.helpers.models import load_model
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs

SIZE = 14
scene = functools.cache(body_batch)


def kept_of(batch):
    return KeptPatches(patches_around_subject(batch.masks, SIZE, 0), torch.device("cpu"))


def test_parts_lie_where_a_person_has_them():
    """Sides must not be swapped (the rig's left is +x), nor bones be assigned to wrong parts."""
    points = load_body().mean[:BODY_VERTICES]
    names = np.array(PARTS)[vertex_parts()]
    assert set(names) == set(PARTS)
    assert names[points[:, 1].argmax()] == "head"
    assert names[points[:, 0].argmax()] == "left hand"
    assert names[points[:, 0].argmin()] == "right hand"
    heights = {part: points[names == part, 1].mean() for part in PARTS}
    for side in ("left", "right"):
        order = ["head", "chest", "abdomen", "hips", *(f"{side} {p}" for p in ("thigh", "shin", "foot"))]
        assert sorted(order, key=heights.get, reverse=True) == order
        arm = [abs(points[names == f"{side} {p}", 0].mean()) for p in ("upper arm", "forearm", "hand")]
        assert arm == sorted(arm)
    for part in ("upper arm", "forearm", "hand", "thigh", "shin", "foot"):
        assert abs((names == f"left {part}").sum() - (names == f"right {part}").sum()) <= 2


def test_a_point_has_the_part_of_the_nearest_vertex():
    """Parts equal those from all distances; a body with another number of vertices is rejected."""
    vertices = torch.from_numpy(load_body().mean[:BODY_VERTICES])
    g = torch.Generator().manual_seed(0)
    points = vertices[torch.randint(BODY_VERTICES, (50,), generator=g)] + 0.05 * torch.randn(
        50, 3, generator=g
    )
    nearest = (points[:, None].double() - vertices).square().sum(-1).argmin(1)
    assert parts_of_points(points.float(), vertices.float()).tolist() == vertex_parts()[nearest].tolist()
    with pytest.raises(
        InputError, match="vertices of the body: expected those of a body whose parts are known"
    ):
        parts_of_points(points.float(), vertices[:-1].float())


def test_shares_are_those_of_a_patchs_pixels():
    """Shares equal those counted from the vertex that each pixel shows."""
    batch, shown = scene(2, 2, 84, 70)
    kept = kept_of(batch)
    shares = part_shares(batch, SIZE)[kept.index]
    expected = torch.zeros(len(kept.index), len(PARTS))
    for n, (image, row, column) in enumerate(zip(kept.image, kept.row, kept.column, strict=True)):
        patch = shown.flatten(0, 1)[image, SIZE * row : SIZE * (row + 1), SIZE * column : SIZE * (column + 1)]
        for vertex in patch[patch >= 0].tolist():
            expected[n, vertex_parts()[vertex]] += 1
    expected /= expected.sum(1, keepdim=True)
    torch.testing.assert_close(shares.sum(1), torch.ones(len(expected)))
    everywhere = torch.zeros(2 * 2 * 6 * 5, dtype=torch.bool)
    everywhere[kept.index] = True
    assert torch.equal(part_shares(batch, SIZE).any(1), everywhere)
    # A vertex is not exactly at its pixel's centre, so at a border of parts another one may be nearer.
    assert (shares - expected).abs().sum(1).mean() < 0.05


@pytest.mark.parametrize(
    ("missing", "message"), [("depths", "data: expected true depths"), ("body_vertices", "data: ")]
)
def test_photographs_without_labels_are_refused(missing, message):
    """Images of real people have no labels of parts."""
    batch, _ = scene(2, 2, 84, 70)
    with pytest.raises(InputError, match=message):
        part_shares(dataclasses.replace(batch, **{missing: None}), SIZE)


def test_the_nearest_neighbour_of_another_view_is_asked():
    """The result equals a loop over pairs with PyTorch's cosine similarity, whatever the lengths of
    features."""
    g = torch.Generator().manual_seed(0)
    features = torch.randn(40, 6, generator=g) * torch.logspace(-3, 3, 40)[:, None]
    parts, views = torch.randint(4, (40,), generator=g), torch.randint(3, (40,), generator=g)
    expected = []
    for i in range(40):
        others = [j for j in range(40) if views[j] != views[i]]
        best = max(others, key=lambda j, i=i: float(F.cosine_similarity(features[i], features[j], dim=0)))
        expected.append(bool(parts[best] == parts[i]))
    found = neighbor_shows_part(features, parts, views)
    assert found.tolist() == expected
    assert 0 < found.float().mean() < 1


def test_without_another_view_nothing_is_right():
    """A single view and an empty set of patches have defined results."""
    one = torch.zeros(3, dtype=torch.long)
    assert not neighbor_shows_part(torch.ones(3, 2), one, one).any()
    assert neighbor_shows_part(torch.ones(0, 2), one[:0], one[:0]).shape == (0,)


def test_patches_without_a_part_do_not_count():
    """The loss equals PyTorch's cross-entropy of the other patches; without any it is 0."""
    g = torch.Generator().manual_seed(0)
    logits, shares = torch.randn(10, 5, generator=g), torch.rand(10, 5, generator=g)
    shares /= shares.sum(1, keepdim=True)
    shares[::3] = 0
    known = shares.any(1)
    found = cross_entropy(logits.log_softmax(1), shares)
    torch.testing.assert_close(found, F.cross_entropy(logits[known], shares[known]))
    assert cross_entropy(logits.log_softmax(1), 0 * shares) == 0


def test_a_branch_learns_a_scene():
    """The loss has a gradient for every parameter of the branch, and decreases."""
    batch, _ = body_batch(1, 2, 56, 42)
    torch.manual_seed(0)
    branch = SemanticOptions(width=32, depth=1, heads=2, channels=8).build(14)
    assert branch.parts == len(PARTS)  # with another number, parts would be confused
    model = Pretext(branch)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    losses = []
    for _ in range(20):
        loss = cross_entropy(*model(batch)[:2])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(p.grad is not None and p.grad.any() for p in model.parameters())
    assert losses[-1] < 0.6 * losses[0]


BRANCH = "encoder.semantic={width: 16, depth: 1, heads: 2, channels: 8}"
TINY = ["encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8", "recalibration.num_heads=2"]
TINY += ["evaluation.views=[3]", "evaluation.pictures=0", "logger=none", "callbacks=none"]
TINY += ["evaluation.targets=[release]", "trainer.limit_val_batches=0"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Boxes with the vertices of built-in people; their labels do not matter here."""
    folder = tmp_path_factory.mktemp("bodies")
    render_boxes(folder / "rendered", folder / "scans", train=2, val=1)
    vertices = load_body().mean[:BODY_VERTICES].astype(np.float32)
    for path in (folder / "rendered").glob("*/smpl/*/vertices.npy"):
        np.save(path, vertices)
    return ["data=scans", f"data.root={folder / 'rendered'}", "data.size=42", "data.batch_size=2"]


@pytest.fixture(scope="module")
def pretrained(data, tmp_path_factory):
    """Directory of a pretext run of four steps."""
    directory = tmp_path_factory.mktemp("pretext") / "run"
    steps = ["trainer.max_steps=4", "trainer.val_check_interval=2"]
    assert ghgs("pretext", *data, BRANCH, *steps, f"hydra.run.dir={directory}") == 0
    return directory


def read(path):
    return torch.load(path, weights_only=True)


def test_the_checkpoint_holds_the_branch_and_its_configuration(pretrained):
    """Names of tensors are those of full models, and the configuration contains the origin of the features
    for tables."""
    checkpoint = read(pretrained / "checkpoints" / "last.ckpt")
    beginnings = {".".join(name.split(".")[:3]) for name in checkpoint["state_dict"]}
    assert beginnings == {"model.encoder.semantic"}
    assert checkpoint["config"]["encoder"]["weights"] == "pretext"
    assert checkpoint["config"]["encoder"]["semantic"]["width"] == 16
    assert (pretrained / "checkpoints" / "best.ckpt").is_file()
    assert (pretrained / "config.yaml").is_file()
    assert "val/part_accuracy" in (pretrained / "csv" / "metrics.csv").read_text().splitlines()[0]


def test_a_model_starts_from_it_and_leaves_it_as_it_is(pretrained, data, tmp_path):
    """Training leaves the pretrained branch unchanged, and tables list it as semantic."""
    source = pretrained / "checkpoints" / "last.ckpt"
    options = [
        *data,
        BRANCH,
        *TINY,
        f"init_from={source}",
        "trainer.max_steps=1",
        f"hydra.run.dir={tmp_path}",
    ]
    assert ghgs("train", *options) == 0
    before, after = (read(path)["state_dict"] for path in (source, tmp_path / "checkpoints" / "last.ckpt"))
    branch = [name for name in before if name.startswith("model.encoder.semantic.")]
    assert len(branch) > 10
    for name in branch:
        assert torch.equal(before[name], after[name]), name
    model = load_model(tmp_path / "checkpoints" / "last.ckpt")
    for name, value in model.encoder.semantic.named_parameters():
        assert torch.equal(value, before[f"model.encoder.semantic.{name}"]), name
        assert not value.requires_grad
    config = json.loads((tmp_path / "metrics.json").read_text())["provenance"]["config"]
    variant = model_variant(config, "metrics.json")
    assert variant.has_semantics
    assert variant.encoder.endswith("semantic branch")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["encoder.semantic=null"],
            "encoder.semantic: expected the options of a branch to train; found None",
        ),
        ([BRANCH, "data.size=50"], "data.size: expected sides divisible by the patch size 14"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(data, tmp_path, capsys, overrides, message):
    """The error names the wrong setting."""
    steps = ["trainer.max_steps=1", "logger=none", "callbacks=none"]
    assert ghgs("pretext", *data, *steps, *overrides, f"hydra.run.dir={tmp_path}") == 1
    assert message in capsys.readouterr().err
