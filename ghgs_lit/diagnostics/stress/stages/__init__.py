"""Stages of the stress test, by name."""

from ghgs_lit.diagnostics.stress.stages import geometry, heads, photographs, recalibration, rendering, whole

STAGES = {}
for _room in (geometry, heads, recalibration, rendering, photographs, whole):
    STAGES |= {stage.name: stage for stage in _room.STAGES}
