"""A GPU computes the same as the CPU in float64: run ``pytest -m gpu`` there. The CPU in float32 must
meet the same limits, which tests this file."""

from dataclasses import replace

import pytest
import torch

from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.precision import exact, has_bfloat16
from ghgs_lit.runtime.watching import Watcher, watch_stages
from tests.helpers.models import ATTRIBUTES, make_model
from tests.helpers.scenes import make_batch
from tests.helpers.splats import relative_error

DEVICES = [torch.device("cpu"), pytest.param(torch.device("cuda"), marks=pytest.mark.gpu)]
#: Maximum relative error of a stage. In float32 it is 1e-6 on a CPU; another order of summation may select
#: the other of two equally distant neighbours, which moves one token. The other precisions round every
#: product: 8 times one rounding.
LIMITS = {"float32": 1e-4, "tf32": 2.0**-8, "bfloat16": 2.0**-5, "float16": 2.0**-8}
#: Maximum relative error of the gradient of all weights, which jumps where rounding moves a unit across 0 or
#: a token to another neighbour; at least one of three models has no such jump.
GRADIENT_LIMIT = 1e-2
SEEDS = range(3)


class Results(Watcher):
    """Last result of each stage by name."""

    def __init__(self):
        self.results = {}

    def end(self, stage, result=None):
        self.results[stage] = result


def double(batch):
    return replace(batch, images=batch.images.double(), cameras=batch.cameras.to(torch.float64))


@torch.no_grad()
def results(predictor, batch):
    """Results of the stages for the subject by name, on the CPU."""
    seen = Results()
    with watch_stages(predictor.model, {name: name for name in ("encoder", "recalibration")}, seen):
        prediction = predictor(batch).to("cpu")
    bounds, masks = prediction.depth_maps.bounds, batch.masks.cpu()
    found = {
        "bounds": torch.stack((bounds.near[masks], bounds.far[masks])),
        "depth_head": prediction.depth[masks],
        "unprojection": prediction.points.tokens[prediction.points.tokens_valid],
    }
    found |= {stage: torch.stack(tokens.latent).cpu() for stage, tokens in seen.results.items()}
    return found | {name: getattr(prediction.gaussians, name) for name in ATTRIBUTES}


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("device", DEVICES)
def test_stages_compute_as_a_cpu_in_float64(device, precision):
    """The first stage that fails contains the error."""
    if device.type == "cpu" and precision in ("tf32", "float16"):
        pytest.skip("CUDA's alone")
    if precision == "bfloat16" and not has_bfloat16(device):
        pytest.skip("no bfloat16 here")
    batch = make_batch(2, 3, 56, 56)
    expected = results(Predictor(make_model().eval().double()), double(batch))
    predictor = Predictor(make_model().eval().to(device), precision=precision)
    found = results(predictor, batch.to(device))
    for stage, value in expected.items():
        limit = LIMITS["float32" if stage == "bounds" else precision]  # geometry is always in float32
        assert relative_error(found[stage], value) <= limit, stage


@pytest.mark.gpu
@torch.no_grad()
def test_a_captured_prediction_is_the_eager_one():
    predictor = Predictor(make_model().eval().cuda(), precision="float32")
    batch = make_batch(2, 3, 56, 56).to("cuda")
    expected, _, found = (predictor(batch).gaussians.means for _ in range(3))
    assert predictor.graphs.counts["replayed"], predictor.graphs.reasons
    assert relative_error(found, expected) <= LIMITS["float32"]


def gradient(model, batch):
    """Gradient of a number that depends on all attributes with respect to all weights [n], in float64 on
    the CPU."""
    gaussians = Predictor(model.train())(batch).gaussians
    total = 0.0
    for name in ATTRIBUTES:  # weights of both signs: the squares of a unit quaternion sum to 1
        values = getattr(gaussians, name).flatten()
        weights = torch.arange(len(values), device=values.device).cos().to(values.dtype)
        total = total + (values * weights).mean()
    total.backward()
    rows = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
    return torch.cat([row.cpu().double().flatten() for row in rows])


@pytest.mark.parametrize("device", DEVICES)
def test_the_gradient_of_all_weights_is_a_cpus_in_float64(device):
    batch = make_batch(2, 3, 56, 56)
    errors = []
    for seed in SEEDS:
        expected = gradient(make_model(seed=seed).double(), double(batch))
        with exact(device.type):
            found = gradient(make_model(seed=seed).to(device), batch.to(device))
        errors.append(relative_error(found, expected))
    assert min(errors) <= GRADIENT_LIMIT
