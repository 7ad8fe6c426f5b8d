"""The plan of a batch: the patches, tokens and pixels that every stage computes, determined once.

A person covers a tenth to a fifth of the frame. Which patches become tokens, which tokens are
recalibrated, which pixels become Gaussians, and the windows of the maps that dense heads compute,
follow from the masks and the preset ``skip``. :func:`make_plan` reads the masks with one
device-to-host synchronisation and returns a :class:`Plan` of indices and counts. Given the plan,
stages work on tensors of known size.

* :mod:`ghgs_lit.method.plan.presets`: the presets. A new one is a file in ``conf/skip``.
* :mod:`ghgs_lit.method.plan.plan`: the plan, and the only place where masks are read.
* :mod:`ghgs_lit.method.plan.patches`: kept patches and their positions among packed tokens.
* :mod:`ghgs_lit.method.plan.rows`: rows of valid tokens or pixels, padded to shape buckets.
* :mod:`ghgs_lit.method.plan.window`: windows of maps, and the input windows that layers need for an
  output window.

To skip further work, add a field to the preset, add the remaining work to the plan, and restrict the
stage to it."""

from ghgs_lit.method.plan.plan import MaskStatistics, Plan, Sizes, make_plan
from ghgs_lit.method.plan.presets import SkipOptions

__all__ = ["MaskStatistics", "Plan", "Sizes", "SkipOptions", "make_plan"]
