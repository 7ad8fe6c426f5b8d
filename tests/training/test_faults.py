"""The first value that is not finite is named by its place."""

import pytest
import torch
from torch import nn

from ghgs_lit.rendering import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.faults import Step, first_fault
from ghgs_lit.types import map_tensors
from tests.helpers.losses import losses_of
from tests.helpers.models import config, make_model
from tests.helpers.scenes import training_batch

LOSSES = {"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 1.0}
STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")
STAGES += ("renderer", "losses")


def make_module(*overrides) -> GHGSModule:
    renderer = Renderer(backend="cpu")
    module = GHGSModule(
        make_model(*overrides), renderer, losses_of(LOSSES), Optimization(lr=0.01), config(*overrides)
    )
    return module.train()


def after(module, name, change):
    """Let ``change`` have the last word on the result of a stage."""
    owner = module if name in ("renderer", "losses") else module.model
    stage = getattr(owner, name)
    if isinstance(stage, nn.Module):
        stage.register_forward_hook(lambda part, inputs, result: change(inputs, result))
    else:
        setattr(owner, name, lambda *inputs: change(inputs, stage(*inputs)))


@pytest.mark.parametrize("overrides", [(), ("model=paper", "skip=none"), ("skip=balanced",)])
def test_an_ordinary_step_has_no_fault(overrides):
    """Values that are infinite on purpose would be blamed; gradients of the weights must stay untouched."""
    module = make_module(*overrides)
    assert first_fault(module, Step(training_batch(2), 1)) is None
    assert all(p.grad is None for p in module.parameters())
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in module.modules())
    assert not isinstance(module.renderer, type(make_module))


def _nan(value):
    return map_tensors(value, lambda t: t * torch.nan if t.is_floating_point() else t)


def _nan_slope(value):
    return map_tensors(value, lambda t: t + (0 * (t - t.detach())).sqrt() if t.requires_grad else t)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_whose_result_is_not_finite_is_named(stage):
    """Not the stage that the value reaches later."""
    module = make_module()
    after(module, stage, lambda inputs, result: _nan(result))
    assert f"values are not finite in the result of {stage}" in first_fault(module, Step(training_batch(), 1))


@pytest.mark.parametrize("stage", ["depth_head", "renderer"])
def test_an_operation_whose_gradient_is_nan_is_named(stage):
    """Not what the gradient reaches later, on its way back."""
    module = make_module()
    after(module, stage, lambda inputs, result: _nan_slope(result))
    assert first_fault(module, Step(training_batch(), 1)) == "NaN in the gradient of the operation Sqrt"
    assert not torch.is_anomaly_enabled()


def test_weights_and_data_are_looked_at_first():
    """A stage that gets NaN is not at fault; the model does not look at targets."""
    module, batch = make_module(), training_batch(2)
    batch.targets.images[1, 0, 0, 3, 4] = torch.inf
    assert first_fault(module, Step(batch, 1)).endswith("are not finite in the batch.targets.images")
    name, parameter = next(iter(module.model.recalibration.named_parameters()))
    parameter.data.view(-1)[0] = torch.nan
    assert first_fault(module, Step(batch, 1)).endswith(f"not finite in the weights.recalibration.{name}")


def test_weights_that_overflow_inside_a_stage_name_the_layer():
    """A layer deep in a stage, not the stage alone."""
    module = make_module()
    header = module.model.gaussian_head.scale_header
    header[0].bias.data.fill_(3e38)
    header[2].weight.data.fill_(3e38)
    fault = first_fault(module, Step(training_batch(), 1))
    assert fault.endswith("not finite in the result of gaussian_head.scale_header.2")


@pytest.mark.parametrize(("steepness", "place"), [(3e38, "the norm of the gradient"), (3e39, "depth_head.")])
def test_a_gradient_that_overflows_is_named(steepness, place):
    """Each value may be finite, and the root of the sum of their squares not."""
    module = make_module("model=hull")
    real, weights = module.losses, [next(module.model.depth_head.parameters())]
    weights.append(next(module.model.gaussian_head.parameters()))

    def steep(*inputs):
        total, values = real(*inputs)
        moved = sum(weight.flatten()[0] - weight.flatten()[0].detach() for weight in weights)
        return total + moved * 1e30 * (steepness / 1e30), values

    module.losses = steep
    assert place in first_fault(module, Step(training_batch(), 1))
