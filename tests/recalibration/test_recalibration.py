"""The recalibration stage: neighbours, attention against the equations and the release, options."""

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree

import ghgs_lit.recalibration.recalibration as stage
from ghgs_lit.errors import InputError
from ghgs_lit.recalibration import (
    SIMILARITIES,
    Recalibration,
    SemanticAttention,
    nearest_neighbors,
)
from ghgs_lit.recalibration.neighbors import MODES, Neighbors
from ghgs_lit.recalibration.recalibration import neighbor_cosines
from ghgs_lit.types import Points, Tokens
from tests.helpers.scenes import CASES, fixture

FIXTURES = ["sc3d_n200", "sc3d_b2_n150", "sc3d_small_variance"]


def literal_neighbors(points, view, i, k, mode):
    """Indices of the neighbours of point ``i``, computed from the definition in float64."""
    distance = np.linalg.norm(points.double().numpy() - points[i].double().numpy(), axis=1)
    order = sorted(range(len(points)), key=lambda j: (np.float32(distance[j]), j))
    own, other = ([j for j in order if (view[j] == view[i]) == same] for same in (True, False))
    if mode == "all":
        return order[:k]
    if mode == "other_views":
        return other[:k] or [i]
    k = min(k, len(points))
    from_own = min(len(own), max(k // 2, k - len(other)))
    return own[:from_own] + other[: k - from_own]


def literal_attention(block, x, points, semantic, view, k, mode):
    """Eqs. 3 to 5 and the residual network for one element, one query and one head at a time."""
    normed = block.norm1(x)
    q, key, v = (
        p(normed).unflatten(1, (block.num_heads, -1)) for p in (block.q_proj, block.k_proj, block.v_proj)
    )
    rows = []
    for i in range(len(x)):
        near = literal_neighbors(points, view, i, k, mode)
        heads = []
        for a in range(block.num_heads):
            scores = []
            for j in near:
                score = q[i, a] @ key[j, a] / q.shape[-1] ** 0.5
                s = F.cosine_similarity(semantic[i], semantic[j], dim=0)
                score = {
                    "product": score * s,
                    "product_clamped": score * s.clamp(min=0),
                    "log": score + s.clamp(min=block.s_min).log(),
                    "none": score,
                }[block.similarity]
                scores.append(score)
            heads.append(torch.stack(scores).softmax(0) @ v[near, a])
        rows.append(torch.cat(heads))
    x = x + block.o_proj(torch.stack(rows))
    return x + block.mlp(block.norm2(x))


def scene(counts=((4, 5, 3), (6, 2, 5)), dim=32, grid=(4, 4), seed=0, dtype=torch.float32):
    """Tokens and points; ``counts[b][v]`` tokens are valid in view v of element b."""
    generator = torch.Generator().manual_seed(seed)
    b, v = len(counts), len(counts[0])
    n = b * v * grid[0] * grid[1]
    axes = (torch.arange(m) for m in (b * v, *grid))
    image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    valid = torch.zeros(b * v, grid[0] * grid[1], dtype=torch.bool)
    for index, count in enumerate(c for element in counts for c in element):
        valid[index, torch.randperm(grid[0] * grid[1], generator=generator)[:count]] = True
    latent = tuple(torch.randn(n, dim, generator=generator, dtype=dtype) for _ in range(4))
    semantic = torch.randn(n, 12, generator=generator, dtype=dtype)
    tokens = Tokens(latent, semantic, image, row, column, (b, v, *grid), 2)
    height, width = 2 * grid[0], 2 * grid[1]
    masks = torch.ones(b, v, height, width, dtype=torch.bool)
    points = Points(
        torch.zeros(b, v, height, width, 3),
        masks,
        torch.randn(n, 3, generator=generator),
        valid.flatten(),
        image,
    )
    return tokens, points


def make(dim=32, k=4, num_heads=2, **options):
    torch.manual_seed(2)
    return Recalibration(dim, k=k, num_heads=num_heads, **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", FIXTURES)
def test_attention_matches_the_release(name, dtype):
    """Neighbours, cosines and output reproduce the authors' numbers."""
    options = CASES[name]["constructor"]
    block = SemanticAttention(options["dim"], options["num_heads"], "product_clamped").to(dtype)
    block.load_state_dict(fixture(name, "state", dtype))
    inputs, expected = fixture(name, "in", dtype), fixture(name, "out64", torch.float64)
    neighbors = [
        nearest_neighbors(p, torch.zeros(len(p), dtype=torch.int64), options["k"]) for p in inputs["pos3d"]
    ]
    found = torch.stack([element.index.sort(1).values for element in neighbors])
    assert torch.equal(found, fixture(name, "out")["neighbours_sorted"])
    cosines = [neighbor_cosines(*pair) for pair in zip(inputs["feat_sem"], neighbors, strict=True)]
    out = block(inputs["feats"].flatten(0, 1), neighbors, cosines).reshape(expected["out"].shape)
    ordered = torch.stack([c.gather(1, n.index.argsort(1)) for c, n in zip(cosines, neighbors, strict=True)])
    bounds = CASES[name]["bounds"] if dtype == torch.float32 else {"out": 1e-9, "cosine_sorted": 1e-9}
    torch.testing.assert_close(
        ordered.double(), expected["cosine_sorted"], atol=bounds["cosine_sorted"], rtol=0
    )
    torch.testing.assert_close(out.double(), expected["out"], atol=bounds["out"], rtol=0)


@pytest.mark.parametrize("neighbors", MODES)
@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_recalibration_is_the_literal_equations(similarity, neighbors):
    """Every option equals Eqs. 3 to 5 written as loops."""
    tokens, points = scene()
    module = make(similarity=similarity, neighbors=neighbors).double()
    tokens = dataclasses.replace(tokens, latent=tuple(t.double() for t in tokens.latent))
    found = module(tokens, points)
    for layer, before in zip(found.latent, tokens.latent, strict=True):
        expected = before.clone()
        for b in range(2):
            at = (points.tokens_valid & (tokens.image // 3 == b)).nonzero()[:, 0]
            expected[at] = literal_attention(
                module.block,
                before[at],
                points.tokens[at],
                tokens.semantic[at],
                tokens.image[at],
                4,
                neighbors,
            )
        torch.testing.assert_close(layer, expected, atol=1e-6, rtol=0)  # cosines are float32


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("k", [1, 2, 3, 7, 64])
def test_mixed_neighbors_are_never_too_few(k, dtype):
    """``mixed`` with k = 1, one token, one view or fewer tokens than k gave NaN or dropped neighbours."""
    for counts in ([1], [1, 1], [9], [3, 6], [1, 2, 40], [30, 30, 0, 4]):
        view = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
        points = torch.rand(len(view), 3, dtype=dtype, generator=torch.Generator().manual_seed(1))
        found = nearest_neighbors(points, view, k, "mixed")
        assert found.index.shape == (len(view), min(k, len(view)))
        assert found.valid.all()
        for i, row in enumerate(found.index.tolist()):
            assert row == literal_neighbors(points, view, i, k, "mixed")
    tokens, points = scene(((1, 0, 0), (1, 2, 0)))
    found = make(neighbors="mixed", k=k)(tokens, points)
    assert all(layer.isfinite().all() for layer in found.latent)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
def test_ties_on_the_image_plane_favor_no_view_and_no_side(mode, dtype):
    """Views share their places there, so most distances are equal; lower views had a quarter more."""
    tokens, points = scene(((144, 144, 144, 144),), grid=(12, 12))
    module = make(neighborhood="image_plane", k=48, neighbors=mode)
    position = module.positions(tokens, points).to(dtype)
    near = nearest_neighbors(position, tokens.image, 48, mode, module.places(tokens))
    inside = (tokens.row - 5.5).abs().maximum((tokens.column - 5.5).abs()) < 2
    index = near.index[inside]
    turn = (tokens.image[index] - tokens.image[inside, None]) % 4
    counts = [(turn == t).sum(1) for t in range(4)]
    expected = {"all": [12] * 4, "other_views": [0, 16, 16, 16], "mixed": [24, 8, 8, 8]}[mode]
    assert [c.float().mean().item() for c in counts] == expected
    assert all(c.min() == c.max() for c in counts)
    # The neighbours of one view lie around the query: within one place of balanced.
    offset = position[index] - position[inside, None]
    for t in range(4):
        drift = torch.where((turn == t)[..., None], offset, 0).sum(1) / tokens.patch_size
        assert drift.abs().max() <= 3
    # Distances come first: nothing nearer is left out.
    distance = torch.cdist(position[inside], position)
    if mode == "all":
        farthest = distance.gather(1, index).amax(1)
        assert torch.equal(farthest, distance.sort(1).values[:, 47])


def test_neighbors_on_the_image_plane_are_those_of_whole_photographs():
    """Patches that left must not move the others: the ablation would align the views."""
    tokens, points = scene(((16, 16, 16),))
    module = make(neighborhood="image_plane", k=5)
    left = tokens.image == 1
    left |= tokens.row > 2
    kept = tokens.select(~left)
    place = 2 * torch.stack((kept.row, kept.column), -1) + 1
    assert torch.equal(module.positions(kept, points), place.float())
    assert torch.equal(module.places(kept), module.places(tokens)[~left])


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_neighbors_match_a_kd_tree(offset):
    """Neighbours equal SciPy's k-d tree, also far from the origin."""
    points = (torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 + offset).float()
    found = nearest_neighbors(points, torch.zeros(500, dtype=torch.int64), 16)
    distance, index = cKDTree(points.double().numpy()).query(points.double().numpy(), 17)
    clear = distance[:, 16] - distance[:, 15] > 1e-6
    assert clear.mean() > 0.9
    assert (np.sort(found.index.numpy())[clear] == np.sort(index[:, :16])[clear]).all()
    assert (found.index[:, 0] == torch.arange(500)).all()


def test_ties_go_to_the_lower_index():
    """Equal distances give the same neighbours on every machine."""
    points = torch.zeros(700, 3)
    points[300:] = 1
    found = nearest_neighbors(points, torch.zeros(700, dtype=torch.int64), 5).index
    assert (found[:300] == torch.arange(5)).all()
    assert (found[300:] == torch.arange(300, 305)).all()


def test_blocks_do_not_change_the_neighbors(monkeypatch):
    """Searching in blocks to save memory gives the same neighbours."""
    points = torch.rand(90, 3)
    view = torch.arange(90) % 3
    for mode in MODES:
        expected = nearest_neighbors(points, view, 7, mode)
        monkeypatch.setattr("ghgs_lit.recalibration.neighbors._BLOCK", 1000)
        found = nearest_neighbors(points, view, 7, mode)
        assert torch.equal(found.index, expected.index)
        assert torch.equal(found.valid, expected.valid)
        monkeypatch.undo()


def test_fewer_points_than_k_and_none():
    """Fewer points than ``k``, and elements without points, do not fail or give NaN."""
    found = nearest_neighbors(torch.rand(3, 3), torch.zeros(3, dtype=torch.int64), 64)
    assert found.index.shape == (3, 3)
    assert nearest_neighbors(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 4).index.shape[0] == 0
    for counts in (((0, 0, 0), (3, 0, 0)), ((0, 0, 0), (0, 0, 0))):
        tokens, points = scene(counts)
        for neighbors in MODES:
            found = make(neighbors=neighbors, k=64)(tokens, points)
            assert all(layer.isfinite().all() for layer in found.latent)


def test_points_of_all_sizes_have_neighbors():
    """Huge, tiny and broken points give valid indices, and broken points are never near."""
    points = torch.rand(40, 3) * torch.logspace(-20, 25, 40)[:, None]
    points[7], points[8] = float("nan"), float("inf")
    found = nearest_neighbors(points, torch.zeros(40, dtype=torch.int64), 8)
    assert ((found.index >= 0) & (found.index < 40)).all()
    rest = found.index[[i for i in range(40) if i not in (7, 8)]]
    assert ((rest != 7) & (rest != 8)).all()


def test_other_tokens_pass_unchanged_and_all_takes_them_in():
    """Tokens outside the subject change only with ``tokens=all``."""
    tokens, points = scene()
    found = make()(tokens, points)
    changed = (found.latent[2] != tokens.latent[2]).any(1)
    assert torch.equal(changed, points.tokens_valid)
    every = make(tokens="all")(tokens, points)
    assert (every.latent[2] != tokens.latent[2]).any(1).all()


def test_neighbors_are_searched_once_an_element(monkeypatch):
    """Neighbours are not searched again for each layer."""
    calls = []
    search = stage.nearest_neighbors
    monkeypatch.setattr(stage, "nearest_neighbors", lambda *args: calls.append(1) or search(*args))
    tokens, points = scene()
    make()(tokens, points)
    assert len(calls) == 2


def test_elements_of_a_batch_do_not_mix():
    """A result does not depend on other elements of the batch."""
    tokens, points = scene()
    together = make()(tokens, points)
    moved = dataclasses.replace(points, tokens=points.tokens + 100 * (tokens.image[:, None] < 3))
    other = dataclasses.replace(
        tokens, latent=tuple(torch.where(tokens.image[:, None] < 3, t + 1, t) for t in tokens.latent)
    )
    found = make()(other, moved)
    second = tokens.image >= 3
    torch.testing.assert_close(found.latent[0][second], together.latent[0][second])


def test_order_of_the_views_does_not_matter():
    """Permuting the views only permutes the tokens."""
    tokens, points = scene(((5, 6, 4),))
    order = torch.tensor([2, 0, 1])
    index = (order[:, None] * 16 + torch.arange(16)).flatten()
    swapped = dataclasses.replace(
        tokens, latent=tuple(t[index] for t in tokens.latent), semantic=tokens.semantic[index]
    )
    moved = dataclasses.replace(points, tokens=points.tokens[index], tokens_valid=points.tokens_valid[index])
    for neighbors in MODES:
        expected = make(neighbors=neighbors)(tokens, points)
        found = make(neighbors=neighbors)(swapped, moved)
        torch.testing.assert_close(found.latent[1], expected.latent[1][index], atol=1e-5, rtol=0)


def test_neighborhoods():
    """Only ``xyz`` reads the points; token centres on the image plane are the same in all views."""
    tokens, points = scene(((16, 16, 16),))
    outputs = {name: make(neighborhood=name)(tokens, points) for name in stage.NEIGHBORHOODS}
    far = dataclasses.replace(points, tokens=points.tokens.flip(0))
    for name, before in outputs.items():
        after = make(neighborhood=name)(tokens, far)
        assert torch.equal(after.latent[0], before.latent[0]) == (name != "xyz")
    assert not torch.equal(outputs["image_plane"].latent[0], outputs["feature"].latent[0])
    position = make(neighborhood="image_plane").positions(tokens, points)
    assert torch.equal(position[:16], position[16:32])
    assert position.min() == 1.0  # pixels: half a patch
    assert position.max() == 7.0


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_gradients_are_finite_where_points_coincide(similarity):
    """Coincident points and zero features give finite gradients, and none reach the points."""
    tokens, points = scene()
    points = dataclasses.replace(points, tokens=torch.zeros_like(points.tokens).requires_grad_())
    tokens = dataclasses.replace(
        tokens,
        latent=tuple((1e3 * t).requires_grad_() for t in tokens.latent),
        semantic=torch.zeros_like(tokens.semantic),
    )
    module = make(similarity=similarity)
    sum(t.square().mean() for t in module(tokens, points).latent).backward()
    gradients = [p.grad for p in module.parameters()] + [t.grad for t in tokens.latent]
    assert all(g.isfinite().all() for g in gradients)
    assert points.tokens.grad is None


def test_dissimilar_neighbors_lose_their_weight_in_log_only():
    """``log`` lowers the weight of a dissimilar neighbour; clamping leaves it at 1/2."""
    cosine = torch.tensor([[1.0, -1.0]])
    weights = {
        name: make(similarity=name)
        .block.apply_similarity(torch.zeros(2, 1, 2), cosine)
        .softmax(-1)[0, 0, 1]
        .item()
        for name in ("product_clamped", "log")
    }
    assert weights["product_clamped"] == 0.5
    assert weights["log"] == pytest.approx(0.01 / 1.01)


def test_blocks_of_queries_change_nothing(monkeypatch):
    """Computing a part of the tokens at a time gives the same result."""
    tokens, points = scene()
    module = make(neighbors="mixed")
    expected = module(tokens, points)
    monkeypatch.setattr("ghgs_lit.recalibration.attention._ROWS", 5)
    with torch.no_grad():
        found = module(tokens, points)
    torch.testing.assert_close(found.latent[3], expected.latent[3], atol=1e-6, rtol=0)


def test_autocast_keeps_neighbors_and_the_kind_of_the_tokens():
    """Autocast changes neither the neighbours nor the dtype of the tokens."""
    tokens, points = scene()
    expected = make()(tokens, points)
    with torch.autocast("cpu", torch.bfloat16):
        found = make()(tokens, points)
    assert found.latent[0].dtype == torch.float32
    assert (found.latent[0] - expected.latent[0]).abs().max() < 0.1


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"k": 0}, "recalibration.k"),
        ({"similarity": "cosine"}, "recalibration.similarity: expected one of product"),
        ({"neighborhood": "uv"}, "recalibration.neighborhood"),
        ({"neighbors": "some"}, "recalibration.neighbors"),
        ({"tokens": "most"}, "recalibration.tokens"),
        ({"num_heads": 5}, "recalibration.num_heads"),
        ({"s_min": 0.0}, "recalibration.s_min"),
    ],
)
def test_impossible_options_are_refused(options, key):
    """Impossible options are refused with their key."""
    with pytest.raises(InputError, match=key):
        make(**options)


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_gathered_neighbors_give_what_a_product_of_all_tokens_gives(similarity, monkeypatch):
    """The path of a GPU and of many tokens, in one part and in several, computed again for the gradient."""
    torch.manual_seed(0)
    block = SemanticAttention(64, 2, similarity).double()
    inputs = [torch.randn(40, 16, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    near = nearest_neighbors(torch.rand(40, 3), torch.arange(40) % 3, 9, "other_views")
    near.valid[:, 5:] = False
    cosines = None if similarity == "none" else torch.rand(40, 9, dtype=torch.float64) * 2 - 1

    def results():
        out = block._attend(*inputs, near, cosines)
        return out, *torch.autograd.grad(out.square().sum(), inputs)

    expected = results()
    monkeypatch.setattr("ghgs_lit.recalibration.attention._SCORES", 0)
    for most in (1 << 25, 9 * 16 * 7):
        monkeypatch.setattr("ghgs_lit.recalibration.attention._GATHERED", most)
        for a, b in zip(results(), expected, strict=True):
            torch.testing.assert_close(a, b)


def test_neighbors_of_elements_are_joined_with_invalid_ones_where_there_are_fewer():
    """Indices count the tokens of all elements."""
    elements = [nearest_neighbors(torch.rand(n, 3), torch.zeros(n, dtype=torch.int64), 4) for n in (6, 3)]
    found = Neighbors.join(elements)
    assert torch.equal(found.index[:6], elements[0].index)
    assert torch.equal(found.index[6:, :3], elements[1].index + 6)
    assert found.valid.sum(1).tolist() == [4] * 6 + [3] * 3
