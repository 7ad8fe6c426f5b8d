"""A whole configuration as one validated object."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

from pydantic import PrivateAttr

from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import KINDS, NAMED, read_nodes

if TYPE_CHECKING:  # they import large libraries
    from ghgs_lit.config.nodes import Calibration, EvaluationOptions
    from ghgs_lit.data.augmentation import Augmentation
    from ghgs_lit.data.dataset import DataOptions
    from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol
    from ghgs_lit.execution.options import ModelOptions
    from ghgs_lit.losses import Losses
    from ghgs_lit.method.encoder import VGGTOptions
    from ghgs_lit.method.plan import SkipOptions
    from ghgs_lit.metrics import MetricsOptions
    from ghgs_lit.rendering import Renderer
    from ghgs_lit.training import Optimization
    from ghgs_lit.training.features import DiskFeatureCache
    from ghgs_lit.training.trainer import TrainerOptions

#: Entry of a configuration that is neither a key of a verb nor a group: names by which tables identify a run.
CHOSEN = "chosen"


def _is_of_verb(key: str) -> bool:
    return key not in KINDS and key != CHOSEN


class Run(Options):
    """Configuration of a run: keys of the verb are fields, options of each config group are attributes;
    None if the verb has no such group.

    The types are those of the shipped kinds that verbs read; user-defined kinds must have the same
    attributes. A node without a kind where its group has kinds, such as changes to a checkpoint's data,
    appears only in :attr:`plain`.
    """

    if TYPE_CHECKING:
        augmentation: Augmentation
        calibration: Calibration
        callbacks: Mapping[str, Options]
        data: DataOptions
        encoder: VGGTOptions
        evaluation: EvaluationOptions
        feature_cache: DiskFeatureCache
        logger: Mapping[str, Options]
        loss: Losses
        metrics: MetricsOptions
        model: ModelOptions
        optimizer: Optimization
        renderer: Renderer
        skip: SkipOptions
        targets: TargetProtocol
        trainer: TrainerOptions
        views: ViewProtocol

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
        run = cls.read({key: config[key] for key in config if _is_of_verb(key)}, "")
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
        config = {**self._plain, **changes}
        run = self.begin(config) if any(map(_is_of_verb, changes)) else self.model_copy()
        return run.complete(config)
