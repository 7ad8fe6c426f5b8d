"""Attention of one token: its weights are those of the recalibration, and pictures show them at the right
patches."""

import dataclasses

import numpy as np
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.method.recalibration.inspection import attention_of
from ghgs_lit.visualization.attention import attention_sheet, choose_token
from ghgs_lit.visualization.pictures import clouds
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch


def seen(model, batch):
    """The recalibration's arguments and result, and the prediction."""
    kept = []
    hook = model.recalibration.register_forward_hook(
        lambda _, inputs, output: kept.append((inputs[:2], output))
    )
    with torch.no_grad():
        prediction = predict(model, batch)
    hook.remove()
    return *kept[0], prediction


@pytest.mark.parametrize(
    "overrides",
    [
        [f"recalibration.similarity={s}", f"recalibration.tokens={t}"]
        for s, t in [
            ("product", "subject"),
            ("product_clamped", "subject"),
            ("log", "subject"),
            ("none", "all"),
        ]
    ],
    ids=lambda o: o[0].split("=")[1],
)
def test_the_weights_are_those_of_the_forward(overrides):
    """The reported weights reproduce the output of the recalibration."""
    model, batch = make_model("skip=none", *overrides).eval(), make_batch(2, 3)
    (tokens, points), output, _ = seen(model, batch)
    block = model.recalibration.block
    for query in [choose_token(tokens, points, element) for element in range(2)]:
        attention = attention_of(model.recalibration, tokens, points, query)
        assert torch.allclose(attention.weights.sum(-1), torch.ones(()), atol=1e-5)
        used, block.similarity = block.similarity, "none"
        plain = attention_of(model.recalibration, tokens, points, query).weights
        block.similarity = used
        assert torch.equal(attention.plain, plain)
        assert torch.equal(attention.plain, attention.weights) == (used == "none")
        for layer, weights in enumerate(attention.weights):
            x = tokens.latent[layer]
            v = block.v_proj(block.norm1(x[attention.neighbors])).unflatten(-1, (block.num_heads, -1))
            y = x[query] + block.o_proj(torch.einsum("ak,kad->ad", weights, v).flatten())
            expected = y + block.mlp(block.norm2(y))
            assert torch.allclose(output.latent[layer][query], expected, atol=2e-5)


def test_the_chosen_token_is_of_its_element_and_has_a_point():
    """The query belongs to its subject, and a position outside the grid is rejected."""
    model, batch = make_model("skip=none").eval(), make_batch(2, 3)
    (tokens, points), _, _ = seen(model, batch)
    for element in range(2):
        query = choose_token(tokens, points, element)
        assert int(tokens.image[query]) == element * 3
        assert points.tokens_valid[query]
    # no token there: the nearest one with a point
    query = choose_token(tokens, points, 1, (2, 0, 0))
    assert int(tokens.image[query]) == 5
    with pytest.raises(InputError, match=r"callbacks\.pictures\.token"):
        choose_token(tokens, points, 0, (3, 0, 0))
    background = int((~points.tokens_valid).nonzero()[0])
    assert attention_of(model.recalibration, tokens, points, background) is None


@pytest.mark.parametrize("skip", ["none", "balanced"])
def test_attention_is_drawn_on_the_tokens_it_names(skip):
    """Coloured patches are at the rows and columns of the neighbours."""
    model, batch = make_model(f"skip={skip}").eval(), make_batch(1, 3, height=56, width=70, zoom=0.5)
    (tokens, points), _, _ = seen(model, batch)
    attention = attention_of(model.recalibration, tokens, points, choose_token(tokens, points, 0))
    dark = dataclasses.replace(batch, images=torch.zeros_like(batch.images))
    picture = attention_sheet(dark, tokens, attention)
    scale, gap = 4, 2
    width, height = 70 * scale, 56 * scale
    # A row per layer, with consistency and then for s = 1; captions of one or two lines
    rows = 1 + len(attention.weights)
    captions = len(picture) - rows * (height + gap)
    assert captions in range(16 * rows, 2 * 16 * rows + 1)
    assert picture.shape[1] == 6 * width + 5 * gap
    caption = int((picture[:, 0] == 0).all(-1).argmax())
    first = picture[caption : caption + height, : 3 * width + 2 * gap]  # the neighbours
    drawn = set()
    for view in range(3):
        tile = first[:, view * (width + gap) : view * (width + gap) + width].astype(int).sum(-1)
        patches = tile.reshape(4, 14 * scale, 5, 14 * scale).transpose(0, 2, 1, 3)[..., 8:-8, 8:-8]
        drawn |= {(view, *place) for place in np.argwhere(patches.max((-1, -2)) > 0).tolist()}
    named = {
        (int(tokens.image[t]), int(tokens.row[t]), int(tokens.column[t]))
        for t in attention.neighbors.tolist()
    }
    assert drawn == named


def test_clouds_are_the_subjects_points_and_its_body():
    """Clouds belong to one subject, keep their colours and respect the limit."""
    model, batch = make_model().eval(), make_batch(2, 3)
    body = [torch.rand(9, 3), torch.rand(4, 3)]
    batch = dataclasses.replace(batch, body_vertices=body)
    _, _, prediction = seen(model, batch)
    found = clouds(batch, prediction, 1, limit=50)
    assert list(found) == ["points", "body", "points_and_body"]
    positions, colors = found["points"]
    assert 25 < len(positions) <= 50
    assert positions.shape == colors.shape
    valid = prediction.points.valid[1] & batch.masks[1]
    assert torch.equal(positions[0], prediction.points.pixels[1][valid][0])
    assert torch.equal(colors[0], batch.images[1].movedim(1, -1)[valid][0])
    assert torch.equal(found["body"][0], body[1])
    assert len(found["points_and_body"][0]) == len(positions) + 4
    nothing = dataclasses.replace(batch, masks=torch.zeros_like(batch.masks), body_vertices=None)
    assert clouds(nothing, prediction, 0) == {}
