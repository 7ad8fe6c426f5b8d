"""Making of data: people, rigs of cameras, photographs, scans.

A plug-in of :mod:`ghgs_lit` by the same entry point as a user's: it offers data sets that are
rendered, and the parts of its bodies.
"""

from ghgs_lit.config.registry import PARTS, offer

offer(
    "data",
    scans="ghgs_people.datasets.Scans",
    synthetic="ghgs_people.datasets.Synthetic",
    thuman2="ghgs_people.thuman2.THuman2",
)
offer(PARTS, built_in="ghgs_people.figures.parts.BuiltInParts")
