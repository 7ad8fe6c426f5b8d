"""Generate data: people, camera rings, renderings of people and of scans.

A plug-in of :mod:`ghgs_lit`, loaded through the same entry point as a user's: it registers data sets of
rendered people, and the body parts of built-in people.
"""

from ghgs_lit.config.registry import PARTS, offer

offer(
    "data",
    scans="ghgs_people.datasets.Scans",
    synthetic="ghgs_people.datasets.Synthetic",
    thuman2="ghgs_people.thuman2.THuman2",
)
offer(PARTS, built_in="ghgs_people.figures.parts.BuiltInParts")
