"""The rows of the matrix."""

from ghgs_lit.diagnostics.stress.stages import geometry, heads, images, recalibration, rendering, whole

STAGES = {
    stage.name: stage
    for room in (geometry, heads, recalibration, rendering, images, whole)
    for stage in room.STAGES
}
