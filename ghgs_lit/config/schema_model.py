"""The type and range of every key of the model's configuration (:mod:`ghgs_lit.config.schema`)."""

from ghgs_lit.config.kinds import (
    Kind,
)

MODEL: dict[str, Kind] = {}
