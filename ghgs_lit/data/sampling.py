"""Which photographs make a sample: input views and targets, in training and in evaluation.

A photograph is named by its ring position ``pid`` and view ``vid`` (see :mod:`ghgs_lit.synthesis.rig`);
inputs are ring cameras (vid 0). Every draw is a function of (seed, step, index in the batch) alone,
so that a run goes on exactly where it stopped, whatever the number of workers.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ghgs_lit.errors import InputError, choice, require

VIEW_IDS = (0, 1, 2, 3, 4)
RING_VID, MIDDLE_VID = 0, 3
# Streams of random numbers that must not repeat one another.
_ORDER, _COUNT, _SAMPLE = 0, 1, 2

Photo = tuple[int, int]


def subject_rng(seed: int, name: str) -> np.random.Generator:
    """Random numbers of one subject, the same whichever other subjects there are."""
    digest = hashlib.sha256(name.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


@dataclass(frozen=True)
class Draw:
    """One sample: ``(pid, vid)`` of the inputs and of the targets of a subject."""

    subject: str
    inputs: tuple[Photo, ...]
    targets: tuple[Photo, ...]


def photo_name(photo: Photo) -> str:
    """``<pid>/<vid>`` as in the layout's paths: ``004/3`` is view 3 of position 4."""
    return f"{photo[0]:03d}/{photo[1]}"


@dataclass(frozen=True)
class ViewProtocol:
    """Input views. ``training_counts``: how many, one count drawn for each step; ``evaluation_count``.

    ``training``: ``any`` ring cameras in random order, or ``even``: evenly spaced from a random start.
    """

    name: str
    training_counts: tuple[int, ...]
    evaluation_count: int
    training: str = "any"

    def __post_init__(self) -> None:
        object.__setattr__(self, "training_counts", tuple(self.training_counts))
        valid = len(self.training_counts) > 0 and min(self.training_counts) >= 2
        require(valid, "views.training_counts", "counts of at least 2", list(self.training_counts))
        require(self.evaluation_count >= 2, "views.evaluation_count", "at least 2", self.evaluation_count)
        choice("views.training", self.training, ("any", "even"))

    def draw(self, available: Sequence[int], count: int, ring: int, rng: np.random.Generator) -> list[int]:
        """Positions of a training sample's inputs."""
        if self.training == "even":
            start = int(rng.integers(ring))
            return [(start + pid) % ring for pid in even_positions(ring, count)]
        return [int(pid) for pid in rng.choice(np.asarray(available), count, replace=False)]


def even_positions(ring: int, count: int) -> list[int]:
    """``count`` evenly spaced positions, floor(i * ring / count): 0, 5, 10 for 3 of 16."""
    return [i * ring // count for i in range(count)]


def middle(first: int, second: int, ring: int) -> Photo:
    """The photograph half-way from position ``first`` on to ``second``: of a ring camera or between two."""
    doubled = 2 * first + (second - first) % ring
    return doubled // 2 % ring, MIDDLE_VID if doubled % 2 else RING_VID


@dataclass(frozen=True)
class TargetProtocol:
    """Target views.

    ``kind`` of the evaluation: ``release``, view ``vid`` at an input's position (3: 11.25 degrees from
    it); ``midway``, half-way between an input and the next; ``random``, any of ``training_vids`` at
    any position, fixed by the seed; ``cameras``, view ``vid`` at the ``positions`` (null: all) that are
    no inputs. ``per_subject``: how many in evaluation, the first ones (``all``: one beside every input,
    or every camera). Training draws ``per_step`` photographs with ``training_vids``.
    """

    name: str
    kind: str | None = None
    vid: int = MIDDLE_VID
    positions: tuple[int, ...] | None = None
    per_subject: int | str = 1
    training_vids: tuple[int, ...] = (0, 2, 3, 4)
    per_step: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", self.kind or self.name)
        object.__setattr__(self, "training_vids", tuple(self.training_vids))
        choice("targets.kind", self.kind, ("release", "midway", "random", "cameras"))
        if self.positions is not None:
            object.__setattr__(self, "positions", tuple(self.positions))
            require(
                self.kind == "cameras",
                "targets.positions",
                "null unless targets.kind=cameras",
                self.positions,
            )
        choice("targets.vid", self.vid, VIEW_IDS)
        known = len(self.training_vids) > 0 and set(self.training_vids) <= set(VIEW_IDS)
        require(known, "targets.training_vids", f"some of {list(VIEW_IDS)}", list(self.training_vids))
        require(self.per_step >= 1, "targets.per_step", "at least 1", self.per_step)
        many = self.per_subject == "all" or (isinstance(self.per_subject, int) and self.per_subject >= 1)
        require(many, "targets.per_subject", "a number of at least 1 or all", self.per_subject)

    @property
    def vids(self) -> set[int]:
        """Every vid that training or evaluation may ask for."""
        evaluated = {"midway": {RING_VID, MIDDLE_VID}, "random": set()}.get(self.kind, {self.vid})
        return evaluated | set(self.training_vids)

    def draw(
        self, available: Sequence[int], inputs: Sequence[int], count: int, rng: np.random.Generator
    ) -> tuple[Photo, ...]:
        """``count`` different photographs at ``available`` positions that are not inputs."""
        taken = {(pid, RING_VID) for pid in inputs}
        pool = [p for pid in available for vid in self.training_vids if (p := (pid, vid)) not in taken]
        if len(pool) < count:
            raise InputError(
                f"targets: expected at least {count} photographs to draw from; found {len(pool)}"
            )
        return tuple(pool[i] for i in rng.choice(len(pool), count, replace=False))

    def evaluation(
        self, available: Sequence[int], inputs: Sequence[int], ring: int, rng: np.random.Generator
    ) -> tuple[Photo, ...]:
        """The targets of a sample with these inputs."""
        if self.kind == "cameras":
            return self._cameras(available, inputs)
        count = len(inputs) if self.per_subject == "all" else int(self.per_subject)
        if self.kind == "random":
            return self.draw(available, inputs, count, rng)
        require(
            count <= len(inputs), "targets.per_subject", f"at most the {len(inputs)} inputs, or all", count
        )
        if self.kind == "release":
            return tuple((pid, self.vid) for pid in inputs[:count])
        pairs = zip(inputs, [*inputs[1:], inputs[0]], strict=True)
        return tuple(middle(a, b, ring) for a, b in pairs)[:count]

    def _cameras(self, available: Sequence[int], inputs: Sequence[int]) -> tuple[Photo, ...]:
        listed = available if self.positions is None else self.positions
        if lacking := sorted(set(listed) - set(available)):
            raise InputError(f"targets.positions: expected some of {list(available)}; found {lacking[0]}")
        taken = {(pid, RING_VID) for pid in inputs}
        photos = [photo for pid in listed if (photo := (pid, self.vid)) not in taken]
        require(len(photos) > 0, "targets.positions", "a camera that is no input", list(listed))
        return tuple(photos if self.per_subject == "all" else photos[: int(self.per_subject)])


#: Every camera that is no input, for rigs whose cameras all stand still.
CAMERAS = TargetProtocol("cameras", vid=RING_VID, per_subject="all", training_vids=(RING_VID,))


@dataclass(frozen=True)
class TrainingDraws:
    """The endless sequence of training batches over ``subjects`` (name to available positions)."""

    subjects: Mapping[str, tuple[int, ...]]
    views: ViewProtocol
    targets: TargetProtocol
    ring: int
    batch_size: int
    seed: int

    def __post_init__(self) -> None:
        need = max(self.views.training_counts)
        for name, pids in self.subjects.items():
            if len(pids) < need or (self.views.training == "even" and len(pids) < self.ring):
                wanted = self.ring if self.views.training == "even" else need
                raise InputError(
                    f"views.training_counts: expected {wanted} ring positions of subject {name} to draw "
                    f"{need} views from; found {len(pids)}"
                )

    def batch(self, step: int, rank: int = 0, world: int = 1) -> list[Draw]:
        """Samples of process ``rank`` of ``world`` at ``step``; every count is the same on all."""
        count = int(np.random.default_rng([self.seed, _COUNT, step]).choice(self.views.training_counts))
        first = (step * world + rank) * self.batch_size
        return [self._sample(step, first + i, count) for i in range(self.batch_size)]

    def _sample(self, step: int, index: int, count: int) -> Draw:
        """Sample number ``index`` of the run: all subjects once in random order, then in another."""
        names = list(self.subjects)
        epoch, place = divmod(index, len(names))
        name = names[np.random.default_rng([self.seed, _ORDER, epoch]).permutation(len(names))[place]]
        rng = np.random.default_rng([self.seed, _SAMPLE, step, index])
        available = self.subjects[name]
        inputs = self.views.draw(available, count, self.ring, rng)
        targets = self.targets.draw(available, inputs, self.targets.per_step, rng)
        return Draw(name, tuple((pid, RING_VID) for pid in inputs), targets)


def evaluation_draws(
    subjects: Mapping[str, tuple[int, ...]],
    count: int,
    targets: TargetProtocol,
    ring: int,
    seed: int,
    positions: Mapping[int, Sequence[int]] | None = None,
) -> list[Draw]:
    """One sample a subject with ``count`` inputs, evenly spaced unless ``positions[count]`` lists them.

    Raises:
        InputError: a subject lacks an input position.
    """
    inputs = list((positions or {}).get(count) or even_positions(ring, count))
    require(len(inputs) == count, f"data.evaluation_positions.{count}", f"{count} positions", inputs)
    draws = []
    for name, available in subjects.items():
        if lacking := sorted(set(inputs) - set(available)):
            raise InputError(
                f"evaluation with {count} views: expected ring positions {inputs} of subject {name}; "
                f"found no position {lacking[0]}"
            )
        chosen = targets.evaluation(available, inputs, ring, subject_rng(seed, name))
        draws.append(Draw(name, tuple((pid, RING_VID) for pid in inputs), chosen))
    return draws
