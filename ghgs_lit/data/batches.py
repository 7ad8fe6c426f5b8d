"""From draws to batches. An item of these data sets is a whole :class:`Batch`."""

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, DistributedSampler

from ghgs_lit.data.reader import Reader, View
from ghgs_lit.data.sampling import Draw, TrainingDraws, photo_name, subject_rng
from ghgs_lit.types import Batch, Cameras, Targets


class Assembler:
    """Reads the photographs of draws into a :class:`Batch`.

    Rendered photographs lie on black with antialiased silhouettes: pixels at the rim carry their
    share of the subject, on either side of the mask, as a splat's do. They are left as they are;
    ``apply_mask`` blacks out everything outside the mask, for photographs with a background.
    ``body_vertices`` (null: all) are drawn from each body, always the same ones.
    ``depths``: whether depth maps of inputs are read.
    """

    def __init__(
        self,
        inputs: Reader,
        targets: Reader,
        apply_mask: bool = False,
        body_vertices: int | None = None,
        depths: bool = True,
    ) -> None:
        self.inputs, self.targets = inputs, targets
        self.apply_mask, self.body_vertices = apply_mask, body_vertices
        self.depths = depths

    def batch(self, draws: Sequence[Draw]) -> Batch:
        """Samples with equal numbers of inputs and of targets."""
        inputs = [[self._input(d.subject, *photo) for photo in d.inputs] for d in draws]
        targets = [[self.targets.view(d.subject, *photo, depth=False) for photo in d.targets] for d in draws]
        depths = [[view.depth for view in row] for row in inputs]
        known = all(depth is not None for row in depths for depth in row)
        bodies = [self._body(d.subject) for d in draws]
        return Batch(
            images=self._images(inputs),
            masks=_stack([[view.mask for view in row] for row in inputs]),
            cameras=_cameras(inputs),
            targets=Targets(
                images=self._images(targets),
                masks=_stack([[view.mask for view in row] for row in targets]),
                cameras=_cameras(targets),
                names=tuple(tuple(photo_name(photo) for photo in d.targets) for d in draws),
            ),
            body_vertices=None if any(body is None for body in bodies) else bodies,
            depths=_stack(depths) if known else None,
            subjects=tuple(d.subject for d in draws),
            views=tuple(tuple(photo_name(photo) for photo in d.inputs) for d in draws),
        )

    def _input(self, name: str, pid: int, vid: int) -> View:
        return self.inputs.view(name, pid, vid, depth=self.depths)

    def _images(self, views: list[list[View]]) -> Tensor:
        images = _stack([[view.image for view in row] for row in views])
        if self.apply_mask:
            images = images * _stack([[view.mask for view in row] for row in views])[..., None]
        return images.permute(0, 1, 4, 2, 3).float() / 255

    def _body(self, name: str) -> Tensor | None:
        vertices = self.inputs.body(name)
        if vertices is None:
            return None
        if self.body_vertices is not None and len(vertices) > self.body_vertices:
            chosen = subject_rng(0, name).choice(len(vertices), self.body_vertices, replace=False)
            vertices = vertices[np.sort(chosen)]
        return torch.from_numpy(vertices)


def _stack(arrays: list[list[np.ndarray]]) -> Tensor:
    return torch.from_numpy(np.stack([np.stack(row) for row in arrays]))


def _cameras(views: list[list[View]]) -> Cameras:
    height, width = views[0][0].mask.shape
    return Cameras(
        intrinsics=_stack([[view.intrinsics for view in row] for row in views]),
        extrinsics=_stack([[view.extrinsics for view in row] for row in views]),
        height=height,
        width=width,
    )


class TrainingBatches(Dataset):
    """Item ``step`` is this process's batch at that step of the run."""

    def __init__(
        self, assembler: Assembler, draws: TrainingDraws, length: int, rank: int, world: int
    ) -> None:
        self.assembler, self.draws = assembler, draws
        self.length, self.rank, self.world = length, rank, world

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, step: int) -> Batch:
        return self.assembler.batch(self.draws.batch(step, self.rank, self.world))


class EvaluationBatches(Dataset):
    """Fixed samples, up to ``batch_size`` neighbours with equal numbers of targets at a time."""

    def __init__(self, assembler: Assembler, draws: Sequence[Draw], batch_size: int) -> None:
        self.assembler = assembler
        self.draws = [
            alike[i : i + batch_size]
            for alike in (list(group) for _, group in groupby(draws, lambda d: len(d.targets)))
            for i in range(0, len(alike), batch_size)
        ]

    def __len__(self) -> int:
        return len(self.draws)

    def __getitem__(self, index: int) -> Batch:
        return self.assembler.batch(self.draws[index])


class StepSampler(DistributedSampler):
    """The steps of one epoch, counted from the run's beginning: ``first_step()`` is asked at its start.

    Draws are divided among processes by step already; being a ``DistributedSampler`` says so to
    Lightning, which otherwise puts its own in place.
    """

    def __init__(self, dataset: TrainingBatches, first_step) -> None:
        super().__init__(dataset, num_replicas=1, rank=0, shuffle=False)
        self.first_step = first_step

    def __iter__(self) -> Iterator[int]:
        first = self.first_step()
        return iter(range(first, first + len(self.dataset)))

    def __len__(self) -> int:
        return len(self.dataset)
