"""The target protocols that an evaluation measures."""

from collections.abc import Mapping
from typing import Any

from ghgs_lit.config.groups import read_option


def target_protocols(config: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The protocols that ``evaluation.targets`` lists, by name.

    Each has the values of its own file in ``conf/targets``, and the file's name; the one that ``targets=``
    selects has the configured values, overrides included. InputError: there is no such file.
    """
    configured = config["targets"]
    protocols = {
        name: configured if name == configured["name"] else read_option("targets", name, "evaluation.targets")
        for name in config["evaluation"]["targets"]
    }
    return {
        name: {**values, "kind": values.get("kind") or values["name"], "name": name}
        for name, values in protocols.items()
    }
