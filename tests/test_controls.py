"""The experiment with controls in ``examples/controls``: rows that must lose or win implement what their
names describe."""

import dataclasses
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit import GHGS
from ghgs_lit.config import compose, registry
from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.stages import STAGES
from ghgs_lit.training.pretext import PARTS
from tests.helpers.models import predict
from tests.helpers.scenes import training_batch

FOLDER = Path(__file__).parents[1] / "examples" / "controls"
OWN = ("residual", "shuffled", "relative")


@pytest.fixture
def controls(monkeypatch):
    """The plug-in, with random body parts, which these bodies lack."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    monkeypatch.setenv(registry.VARIABLE, str(FOLDER / "controls.py"))
    registry.load_plugins()
    module = sys.modules["controls"]
    shares = torch.rand(2 * 3 * 4 * 4, len(PARTS), generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(module, "part_shares", lambda batch, patch_size: shares)
    yield module
    sys.modules.pop("controls", None)


def config(*overrides):
    """Model nodes of the experiment."""
    small = ["encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8", "recalibration.num_heads=2"]
    searched = f"hydra.searchpath=[file://{FOLDER / 'conf'}]"
    return OmegaConf.to_container(compose("train", [searched, "sweep=controls", *small, *overrides]))


def model_of(**recalibration):
    """The experiment's model with some keys of the recalibration changed."""
    nodes = config()
    nodes["recalibration"] |= recalibration
    torch.manual_seed(0)
    nodes = {name: nodes[name] for name in (*STAGES, "skip", "model")}
    return GHGS.from_config(OmegaConf.to_container(OmegaConf.create(nodes), resolve=True)).eval()


def calls_of(model, batch):
    """Inputs and result of the recalibration in a prediction."""
    calls = []
    hook = model.recalibration.register_forward_hook(lambda stage, inputs, out: calls.append((*inputs, out)))
    with torch.no_grad():
        predict(model, batch)
    hook.remove()
    ((tokens, points, _, result),) = calls
    return tokens, points, result


def test_the_rows_are_the_papers_and_three_more(controls):
    """Each row is one configuration, which differs from the full method only as its name describes."""
    composed = {name: config(f"ablation={name}") for name in (*ABLATIONS.values(), *OWN)}
    rows = composed["full"]["recalibration"]
    assert (rows["kind"], rows["control"], rows["k"], rows["positions"]) == ("control", "none", 0.1, "none")
    assert composed["full"]["gaussian_head"]["offset_limit"] is None
    differing = {}
    for name, nodes in composed.items():
        changed = {key: value for key, value in nodes["recalibration"].items() if value != rows[key]}
        rest = {key: value for key, value in nodes.items() if key != "recalibration"}
        assert rest == {key: composed["full"][key] for key in rest}
        differing[name] = changed
    assert differing["residual"] == {"control": "residual"}
    assert differing["shuffled"] == {"control": "shuffled"}
    assert differing["relative"] == {"positions": "relative"}
    assert len({str(changed) for changed in differing.values()}) == 7


def test_without_the_plug_in_nobody_meets_a_control():
    for node in ({"kind": "control"}, {"kind": "semantic", "control": "shuffled"}):
        with pytest.raises(InputError, match=r"recalibration"):
            registry.read_node(node, "recalibration")


def test_the_residual_is_that_of_the_true_surface(controls):
    """Zero for predictions of the true depths; 1 % of the distance for depths that are 1 % too large."""
    batch = training_batch(2, 56)
    tokens, points, result = calls_of(model_of(control="residual"), batch)
    unproject = controls.KnownUnprojection()
    maps = controls.DepthMaps(batch.depths, batch.masks, torch.ones_like(batch.depths))
    assert unproject(maps, tokens, batch).residual.abs().max() < 1e-6
    far = unproject(dataclasses.replace(maps, depth=1.01 * batch.depths), tokens, batch)
    where = far.tokens_valid
    centers = batch.cameras.centers.flatten(0, 1)[tokens.image]
    expected = 0.01 / 1.01 * (centers - far.tokens)
    torch.testing.assert_close(far.residual[where], expected[where], atol=1e-5, rtol=0)
    # Adding the tokens' residual moves predicted points to the surface.
    surface = unproject_maps(batch.depths, batch.cameras).flatten(0, 3)
    moved = (points.tokens + points.residual)[where]
    seen = surface[batch.masks.flatten()]
    assert torch.cdist(moved, seen).min(1).values.max() < 0.05
    assert torch.cdist(points.tokens[where], seen).min(1).values.max() > 0.1
    said = points.residual / controls.RESIDUAL_UNIT
    for layer in result.latent:
        assert torch.equal(layer[:, : 3 * controls.COPIES], said.repeat(1, controls.COPIES))


def test_shuffled_tokens_are_those_of_the_same_subject_elsewhere(controls):
    """A permutation of the full method's tokens; nothing else changes."""
    batch = training_batch(2, 56)
    tokens, points, whole = calls_of(model_of(), batch)
    _, _, shuffled = calls_of(model_of(control="shuffled"), batch)
    element = tokens.image // 3
    for before, after in zip(whole.latent, shuffled.latent, strict=True):
        outside = ~points.tokens_valid
        assert torch.equal(after[outside], before[outside])
        for number in range(2):
            own = points.tokens_valid & (element == number)
            distance = torch.cdist(after[own], before[own], compute_mode="donot_use_mm_for_euclid_dist")
            source = distance.min(1).indices
            assert distance.min(1).values.max() == 0
            assert source.sort().values.tolist() == list(range(int(own.sum())))
            assert (source != torch.arange(len(source))).float().mean() > 0.5


def test_attention_knows_the_true_parts(controls, monkeypatch):
    """Other parts give other weights, unless similarity is switched off."""
    batch = training_batch(2, 56)
    shares = torch.rand(2 * 3 * 4 * 4, len(PARTS), generator=torch.Generator().manual_seed(1))
    for similarity in ("product", "none"):
        model = model_of(similarity=similarity)
        tokens, points, result = calls_of(model, batch)
        assert torch.equal(tokens.semantic, points.shares.sqrt())
        results = [result.latent[3]]
        with monkeypatch.context() as patched:
            patched.setattr(controls, "part_shares", lambda batch, patch_size: shares)
            results.append(calls_of(model, batch)[2].latent[3])
        assert torch.equal(*results) == (similarity == "none")
