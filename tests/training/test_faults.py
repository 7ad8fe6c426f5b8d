"""The first value that is not finite is named by its stage, its place and its sample."""

import dataclasses

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
    """Values that are infinite on purpose would be blamed;
    gradients of the weights must stay untouched."""
    module = make_module(*overrides)
    assert first_fault(module, Step(training_batch(2), 1)) is None
    assert all(p.grad is None for p in module.parameters())
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in module.modules())
    assert not isinstance(module.renderer, type(make_module))


def _nan(value):
    return map_tensors(value, lambda t: t * torch.nan if t.is_floating_point() else t)


def _infinite_slope(value):
    return map_tensors(value, lambda t: t + (t - t.detach()).abs().sqrt() if t.requires_grad else t)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_whose_result_is_not_finite_is_named(stage):
    """Not the stage that the value reaches later."""
    module = make_module()
    after(module, stage, lambda inputs, result: _nan(result))
    fault = first_fault(module, Step(training_batch(), 1))
    assert (fault.where, fault.stage, fault.sample) == ("result of", stage, "p0")
    assert fault.place.startswith(stage)


@pytest.mark.parametrize("stage", [stage for stage in STAGES if stage != "bounds"])
def test_a_stage_whose_gradient_is_not_finite_is_named(stage):
    """Not the stage that the gradient reaches later, on its way back."""
    module = make_module()
    after(module, stage, lambda inputs, result: _infinite_slope(result))
    fault = first_fault(module, Step(training_batch(), 1))
    assert (fault.where, fault.stage) == ("gradient from", stage)


def test_the_sample_is_the_one_that_is_at_fault_alone():
    """Of three subjects the second, whose target is seen from far away, is drawn as NaN."""
    module, batch = make_module(), training_batch(3)
    batch.targets.cameras.extrinsics[1, 0, 2, 3] = 50.0

    def spoil(inputs, result):
        far = inputs[1].extrinsics[:, :, 2, 3, None, None, None] > 40
        return dataclasses.replace(result, image=torch.where(far, torch.nan, result.image))

    after(module, "renderer", spoil)
    fault = first_fault(module, Step(batch, 1))
    assert (fault.stage, fault.place, fault.sample) == ("renderer", "renderer.image", "p1")
    assert str(fault) == (
        f"{3 * 28 * 28} of {9 * 28 * 28} values are not finite in the result of renderer"
        " (renderer.image, subject p1)"
    )


def test_weights_and_data_are_looked_at_first():
    """A stage that gets NaN is not at fault; the model does not look at targets."""
    module, batch = make_module(), training_batch(2)
    batch.targets.images[1, 0, 0, 3, 4] = torch.inf
    fault = first_fault(module, Step(batch, 1))
    assert (fault.where, fault.place, fault.sample) == ("data that enters", "batch.targets.images", "p1")
    name, parameter = next(iter(module.model.recalibration.named_parameters()))
    parameter.data.view(-1)[0] = torch.nan
    fault = first_fault(module, Step(batch, 1))
    assert (fault.where, fault.stage, fault.place) == ("weights of", "recalibration", f"recalibration.{name}")


def test_weights_that_overflow_inside_a_stage_name_the_layer():
    """A layer deep in a stage, not the stage alone."""
    module = make_module()
    header = module.model.gaussian_head.scale_header
    header[0].bias.data.fill_(3e38)
    header[2].weight.data.fill_(3e38)
    fault = first_fault(module, Step(training_batch(), 1))
    assert (fault.where, fault.place) == ("result of", "gaussian_head.scale_header.2")


def test_a_gradient_whose_norm_overflows_names_its_largest_part():
    """Each value is finite, the root of the sum of their squares is not."""
    module = make_module("model=hull")
    first = next(name for name, _ in module.model.depth_head.named_parameters())
    real = module.losses
    weight = module.model.depth_head.get_parameter(first)
    other = next(module.model.gaussian_head.parameters())

    def steep(*inputs):
        total, values = real(*inputs)
        parts = ((3e38, weight.flatten()[0]), (2e38, other.flatten()[0]))
        return total + sum(slope * (value - value.detach()) for slope, value in parts), values

    module.losses = steep
    fault = first_fault(module, Step(training_batch(), 1))
    assert (fault.where, fault.stage) == ("gradient from", "depth_head")
    assert fault.place == f"norm, largest of depth_head.{first}"
