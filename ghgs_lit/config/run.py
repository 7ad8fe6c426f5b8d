"""A whole configuration as one validated object."""

from collections.abc import Mapping
from typing import Any, Self

from pydantic import PrivateAttr

from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import KINDS, NAMED, read_nodes

#: Entry of a configuration that is neither a key of a verb nor a group: names by which tables identify a run.
CHOSEN = "chosen"


class Run(Options):
    """Configuration of a run: keys of the verb are fields, options of each config group are attributes;
    None if the verb has no such group.

    User-defined kinds must have the attributes of the shipped kinds (:data:`ghgs_lit.config.registry.KINDS`)
    that verbs read. A node without a kind where its group has kinds, such as changes to a checkpoint's data,
    appears only in :attr:`plain`.
    """

    _plain: dict[str, Any] = PrivateAttr(default_factory=dict)
    _nodes: dict[str, Any] = PrivateAttr(default_factory=dict)

    @classmethod
    def begin(cls, config: Mapping[str, Any]) -> Self:
        """Validate only the keys of the verb, which requires no library.

        Args:
            config: The whole configuration as plain data.

        Raises:
            InputError: A key is unknown, or a value has a wrong type or range.
        """
        of_verb = {key: value for key, value in config.items() if key not in KINDS and key != CHOSEN}
        run = cls.read(of_verb, "")
        run._plain = dict(config)
        return run

    def complete(self, config: Mapping[str, Any]) -> Self:
        """Validate the groups, too.

        Args:
            config: The whole configuration as plain data, with the defaults of all nodes.

        Returns:
            This run.

        Raises:
            InputError: The message contains the first wrong key of a node.
        """
        self._plain = dict(config)
        self._nodes = read_nodes(config)
        return self

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Self:
        """Validate a whole configuration.

        Args:
            config: Plain data, with the defaults of all nodes.

        Raises:
            InputError: See :meth:`begin` and :meth:`complete`.
        """
        return cls.begin(config).complete(config)

    def __getattr__(self, name: str) -> Any:
        if name in NAMED:
            parts = ((key.partition("."), node) for key, node in self._nodes.items())
            return {part: node for (group, _, part), node in parts if group == name}
        return self._nodes.get(name) if name in KINDS else super().__getattr__(name)

    @property
    def plain(self) -> dict[str, Any]:
        """The whole configuration as saved, in plain data; must not be modified."""
        return self._plain

    def with_changes(self, **nodes: Mapping[str, Any]) -> Self:
        """Return a copy with some keys of nodes changed; the result is validated.

        Args:
            **nodes: New values by key, as plain data, for groups that the run has.

        Raises:
            InputError: See :meth:`of`.
        """
        return self.replace(**{group: {**self._plain[group], **keys} for group, keys in nodes.items()})

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values of keys or other nodes; the result is validated.

        Args:
            **changes: New values by key and new nodes by group, as plain data.

        Raises:
            InputError: See :meth:`of`.
        """
        return self.of({**self._plain, **changes})
