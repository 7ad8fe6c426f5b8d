"""Stages of the stress test, by name."""

from ghgs_lit.diagnostics.stress.stages import geometry, heads, photographs, recalibration, rendering, whole

STAGES = {
    stage.name: stage
    for room in (geometry, heads, recalibration, rendering, photographs, whole)
    for stage in room.STAGES
}
