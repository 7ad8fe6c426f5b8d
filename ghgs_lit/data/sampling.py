"""Sampling of input and target views in training and evaluation.

An image is identified by its ring position and its view number there: 0 is the ring camera, 1 repeats
the next ring camera, 3 is the exact middle between the two, 2 and 4 are at random places in the first
and second half. Inputs are ring cameras (view 0). A sample depends only on (seed, step, index), so that
a run resumes exactly, with any number of workers.
"""

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ghgs_lit.config.options import Count, Index, Options, Text
from ghgs_lit.errors import InputError, require

RING_VIEW = 0
MIDDLE_VIEW = 3
# Keys of independent random streams.
_ORDER = 0
_COUNT = 1
_SAMPLE = 2

#: (ring position, view number)
Photo = tuple[int, int]
ViewNumber = Literal[0, 1, 2, 3, 4]
Several = Annotated[int, Field(ge=2)]


def subject_rng(seed: int, name: str) -> np.random.Generator:
    """Random generator of one subject, which does not depend on other subjects."""
    digest = hashlib.sha256(name.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


@dataclass(frozen=True)
class Sample:
    """The input and target images of a subject that form a sample, and the protocol of each target."""

    subject: str
    inputs: tuple[Photo, ...]
    targets: tuple[Photo, ...]
    protocols: tuple[str, ...]


def photo_name(photo: Photo) -> str:
    """Name of an image as in paths of rendered data, such as ``004/3`` for view 3 at position 4."""
    return f"{photo[0]:03d}/{photo[1]}"


def ring_photos(positions: Sequence[int]) -> tuple[Photo, ...]:
    """Images of the ring cameras at ``positions``."""
    return tuple((position, RING_VIEW) for position in positions)


class ViewProtocol(Options):
    """Protocol of the input views."""

    group = "views"

    training_counts: tuple[Several, ...] = Field((3, 4, 5), min_length=1)
    """Numbers of input views; one of them is sampled for each training step."""
    evaluation_count: Several = 4
    """Number of input views in evaluation."""
    training: Literal["any", "even", "uneven"] = "any"
    """Input views in training. any: ring cameras in random order. even: evenly spaced from a random start.
    uneven: evenly spaced, then each moved by up to one position, as in captures."""

    def sample(self, available: Sequence[int], count: int, ring: int, rng: np.random.Generator) -> list[int]:
        """Sample the input positions of a training sample.

        Args:
            available: positions that the subject has.
            count: number of inputs.
            ring: number of positions of a full ring.
        """
        if self.training != "any":
            start = int(rng.integers(ring))
            positions = np.asarray(even_positions(ring, count))
            if self.training == "uneven":  # positions are at least 3 apart, so they stay distinct
                positions = positions + rng.integers(-1, 1, count, endpoint=True)
            return [int(position) for position in (start + positions) % ring]
        return [int(position) for position in rng.choice(np.asarray(available), count, replace=False)]


def even_positions(ring: int, count: int) -> list[int]:
    """Evenly spaced positions, floor(i * ring / count): 0, 5, 10 for 3 of 16.

    Args:
        ring: number of positions of a full ring.
        count: number of positions to select, at least 1.
    """
    return [i * ring // count for i in range(count)]


def middle(first: int, second: int, ring: int) -> Photo:
    """Image half-way between two positions, at a ring camera or between two.

    Args:
        first: first position.
        second: second position, further along the ring.
        ring: number of positions of a full ring.
    """
    doubled = 2 * first + (second - first) % ring
    return doubled // 2 % ring, MIDDLE_VIEW if doubled % 2 else RING_VIEW


class TargetProtocol(Options):
    """Protocol of the target views."""

    group = "targets"

    kind: Literal["release", "midway", "random", "cameras"]
    """Targets of evaluation. release: ``view`` at the positions of inputs. midway: half-way between an
    input and the next one. random: any of training_views at any position, fixed by the seed. cameras:
    ``view`` at those of ``positions`` that are not inputs. Null: the value of ``name``."""
    name: Text
    """Name of the protocol in results."""
    view: ViewNumber = MIDDLE_VIEW
    """View number of the targets of release and cameras: 0 is the ring camera, 3 the middle to the next one
    (in release 11.25 degrees from the input)."""
    positions: tuple[Index, ...] | None = None
    """Positions of the targets of cameras; null: all."""
    per_subject: Count | Literal["all"] = 1
    """Number of targets of each subject in evaluation, the first ones; all: one next to every input, or
    every camera."""
    training_views: tuple[ViewNumber, ...] = Field((0, 2, 3, 4), min_length=1)
    """View numbers from which training samples targets, at any position."""
    per_step: Count = 1
    """Number of targets of each training sample."""

    @model_validator(mode="before")
    @classmethod
    def _kind_is_name(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("kind") is None:
            return {**values, "kind": values.get("name")}
        return values

    @model_validator(mode="after")
    def _check(self) -> "TargetProtocol":
        possible = self.positions is None or self.kind == "cameras"
        self.require(possible, "positions", "null unless targets.kind=cameras")
        return self

    @property
    def view_numbers(self) -> set[int]:
        """View numbers that training or evaluation may require."""
        evaluated = {"midway": {RING_VIEW, MIDDLE_VIEW}, "random": set()}.get(self.kind, {self.view})
        return evaluated | set(self.training_views)

    def sample(
        self, available: Sequence[int], inputs: Sequence[int], count: int, rng: np.random.Generator
    ) -> tuple[Photo, ...]:
        """Sample different images of ``training_views`` that are not inputs.

        Args:
            available: positions that the subject has.
            inputs: positions of the inputs.
            count: number of images.

        Raises:
            InputError: fewer than ``count`` exist.
        """
        taken = ring_photos(inputs)
        everything = itertools.product(available, self.training_views)
        pool = [photo for photo in everything if photo not in taken]
        if len(pool) < count:
            raise InputError(
                f"targets: expected at least {count} photographs to draw from; found {len(pool)}"
            )
        return tuple(pool[i] for i in rng.choice(len(pool), count, replace=False))

    def evaluation(
        self, available: Sequence[int], inputs: Sequence[int], ring: int, rng: np.random.Generator
    ) -> tuple[Photo, ...]:
        """Targets of an evaluation sample.

        Args:
            available: positions that the subject has.
            inputs: positions of the inputs, in their order on the ring.
            ring: number of positions of a full ring.
            rng: random generator, for ``kind=random``.

        Raises:
            InputError: the subject lacks positions, or there are fewer targets than configured.
        """
        if self.kind == "cameras":
            return self._cameras(available, inputs)
        count = len(inputs) if self.per_subject == "all" else int(self.per_subject)
        if self.kind == "random":
            return self.sample(available, inputs, count, rng)
        most = f"at most the {len(inputs)} inputs, or all"
        require(count <= len(inputs), "targets.per_subject", most, count)
        if self.kind == "release":
            return tuple((position, self.view) for position in inputs[:count])
        pairs = zip(inputs, [*inputs[1:], inputs[0]], strict=True)
        return tuple(middle(a, b, ring) for a, b in pairs)[:count]

    def _cameras(self, available: Sequence[int], inputs: Sequence[int]) -> tuple[Photo, ...]:
        listed = available if self.positions is None else self.positions
        if lacking := sorted(set(listed) - set(available)):
            raise InputError(f"targets.positions: expected some of {list(available)}; found {lacking[0]}")
        taken = ring_photos(inputs)
        photos = [photo for position in listed if (photo := (position, self.view)) not in taken]
        require(len(photos) > 0, "targets.positions", "a camera that is not an input", list(listed))
        return tuple(photos if self.per_subject == "all" else photos[: int(self.per_subject)])


#: All cameras that are not inputs, for rigs with static cameras.
CAMERAS = TargetProtocol(name="cameras", view=RING_VIEW, per_subject="all", training_views=(RING_VIEW,))


@dataclass(frozen=True)
class TrainingSampler:
    """Endless sequence of training samples.

    Args:
        subjects: camera positions of each subject.
        ring: number of positions of a full ring.
        batch_size: samples per step and process.

    Raises:
        InputError: a subject has too few positions.
    """

    subjects: Mapping[str, tuple[int, ...]]
    views: ViewProtocol
    targets: TargetProtocol
    ring: int
    batch_size: int
    seed: int

    def __post_init__(self) -> None:
        most = max(self.views.training_counts)
        roomy = self.views.training != "uneven" or self.ring >= 3 * most
        require(roomy, "views.training", f"any or even for {most} views of {self.ring} positions", "uneven")
        wanted = most if self.views.training == "any" else self.ring
        for name, positions in self.subjects.items():
            if len(positions) < max(wanted, most):
                raise InputError(
                    f"views.training_counts: expected {wanted} ring positions of subject {name} to "
                    f"draw {most} views from; found {len(positions)}"
                )

    def batch(self, step: int, rank: int = 0, world: int = 1) -> list[Sample]:
        """Samples of one process at a step, with equal numbers of inputs."""
        count = int(np.random.default_rng([self.seed, _COUNT, step]).choice(self.views.training_counts))
        return [self._sample(step, index, count) for index in self.indices(step, rank, world)]

    def indices(self, step: int, rank: int = 0, world: int = 1) -> range:
        """Indices in the run of the samples of :meth:`batch`."""
        first = (step * world + rank) * self.batch_size
        return range(first, first + self.batch_size)

    def _sample(self, step: int, index: int, count: int) -> Sample:
        """The sample at ``index`` of the run; each epoch uses all subjects in a new random order."""
        names = list(self.subjects)
        epoch, place = divmod(index, len(names))
        name = names[np.random.default_rng([self.seed, _ORDER, epoch]).permutation(len(names))[place]]
        rng = np.random.default_rng([self.seed, _SAMPLE, step, index])
        available = self.subjects[name]
        inputs = self.views.sample(available, count, self.ring, rng)
        targets = self.targets.sample(available, inputs, self.targets.per_step, rng)
        return Sample(name, ring_photos(inputs), targets, (self.targets.name,) * len(targets))


def evaluation_samples(
    subjects: Mapping[str, tuple[int, ...]],
    count: int,
    protocols: Sequence[TargetProtocol],
    ring: int,
    seed: int,
    positions: Sequence[Sequence[int]] = (),
) -> list[Sample]:
    """One fixed sample per subject, with the concatenated targets of all ``protocols``.

    Args:
        subjects: camera positions of each subject.
        count: number of inputs, above 0.
        ring: number of positions of a full ring.
        seed: seed of random targets.
        positions: lists of input positions; if none has length ``count``, inputs are evenly spaced.

    Raises:
        InputError: input positions repeat, or a subject lacks one.
    """
    inputs = next((list(listed) for listed in positions if len(listed) == count), even_positions(ring, count))
    expected = f"different positions of a ring of {ring}"
    found = count if count > ring else inputs
    require(count > 0 and len(set(inputs)) == count, f"evaluation with {count} views", expected, found)
    specs = []
    for name, available in subjects.items():
        if lacking := sorted(set(inputs) - set(available)):
            raise InputError(
                f"evaluation with {count} views: expected ring positions {inputs} of subject "
                f"{name}; found no position {lacking[0]}"
            )
        each = [p.evaluation(available, inputs, ring, subject_rng(seed, name)) for p in protocols]
        names = []
        for protocol, photos in zip(protocols, each, strict=True):
            names += [protocol.name] * len(photos)
        specs.append(Sample(name, ring_photos(inputs), tuple(itertools.chain(*each)), tuple(names)))
    return specs
