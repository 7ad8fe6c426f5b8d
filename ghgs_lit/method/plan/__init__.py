"""The plan of a batch: what its scene needs of every stage, decided once and in one place.

A person covers a tenth to a fifth of the frame. Which patches become tokens, which tokens are
recalibrated, which pixels become Gaussians, and the windows of the maps that dense heads compute,
follow from the masks and from the preset of ``skip`` in force. :func:`make_plan` reads all of it
with one device-to-host synchronisation and returns a :class:`Plan`: indices and counts. Stages are
functions of tensors of known size: they take the plan and decide nothing of the kind.

* :mod:`ghgs_lit.method.plan.presets`: the presets. A new one is a file in ``conf/skip``.
* :mod:`ghgs_lit.method.plan.plan`: the plan, and the one place where masks are read.
* :mod:`ghgs_lit.method.plan.patches`: patches that become tokens, and their places among packed ones.
* :mod:`ghgs_lit.method.plan.rows`: rows of tokens or pixels that count, and shape buckets of their number.
* :mod:`ghgs_lit.method.plan.window`: windows of maps,
  and what their layers need for a window of their result.

Something else that a scene does not need is left out in three steps: a field of the preset says so,
the plan holds what is left, and the stage works on that."""

from ghgs_lit.method.plan.plan import MaskStatistics, Plan, Sizes, make_plan
from ghgs_lit.method.plan.presets import SkipOptions

__all__ = ["MaskStatistics", "Plan", "Sizes", "SkipOptions", "make_plan"]
