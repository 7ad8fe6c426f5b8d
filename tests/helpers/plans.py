"""Plans for stages that are called separately."""

import torch

from ghgs_lit.method.plan import make_plan


def plan_of(masks, patch_size=14, pixels="subject", tokens="subject"):
    """The plan of masks [B, V, H, W] if all patches become tokens."""
    b, v, height, width = masks.shape
    kept = torch.ones(b, v, height // patch_size, width // patch_size, dtype=torch.bool)
    return make_plan(masks, patch_size, kept, pixels, tokens)


def with_plan(stage):
    """Make a recalibration stage compute the plan of its points when it is called without one."""

    def given(module, inputs):
        tokens, points, *plan = inputs
        return inputs if plan else (*inputs, plan_of(points.valid, tokens.patch_size, tokens=module.tokens))

    stage.register_forward_pre_hook(given)
    return stage
