"""What photographs do not show of a subject: what a frame cuts off, and where depth is a guess."""

import dataclasses
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_capture.export.subject import ExportedSubject
from ghgs_lit.method.rounds.observation import looked_up

#: Metres behind the rendered surface up to which a photograph shows a Gaussian.
_BEHIND = 0.03
#: Parts of the subject's height, and share of Gaussians beyond either end of it (floaters).
_PARTS = 4
_OUTSIDE = 1e-3
#: Share of ``seen_once`` above which a part is reported: three even views of whole people have a
#: half, two opposite ones all.
GUESSED = 0.75


def unseen(subject: ExportedSubject, depth: Float[Tensor, "1 V 1 H W"]) -> dict[str, Any]:
    """What photographs do not show of a subject, as plain data for the report.

    Args:
        subject: with masks and Gaussians.
        depth: of the rendered inputs, in the unit of the cameras.

    Returns:
        ``cut``: by edge of the frame, the photographs whose mask reaches it. ``seen_once``: by part
        of the subject's height, the share of its Gaussians that at most one photograph shows, so
        that no second one confirms their depth; empty without Gaussians.
    """
    masks = subject.masks
    lines = {"top": masks[:, 0], "bottom": masks[:, -1], "left": masks[..., 0], "right": masks[..., -1]}
    cut = {}
    for edge, line in lines.items():
        touched = line.any(-1).tolist()
        names = [name for name, is_cut in zip(subject.views, touched, strict=True) if is_cut]
        if names:
            cut[edge] = names
    return {"cut": cut, "seen_once": _seen_once(subject, depth)}


def _seen_once(subject: ExportedSubject, depth: Float[Tensor, "1 V 1 H W"]) -> dict[str, float]:
    """``seen_once`` of :func:`unseen`."""
    gaussians = subject.gaussians
    cameras = subject.cameras[None]
    if not len(gaussians):
        return {}
    metre = 1.0 if gaussians.metre is None else float(gaussians.metre[0])
    maps = torch.cat((subject.mattes[None, :, None], depth), 2).double()
    exact = dataclasses.replace(gaussians, means=gaussians.means.double())
    values, z, is_inside = looked_up(exact, cameras, maps)
    matte, depth = values.split((1, 1), -1)
    count = (is_inside & (matte > 0.5) & (z - depth < _BEHIND * metre)).squeeze(-1).sum(1)
    height = exact.means @ subject.up
    ordered = height.sort().values
    last = len(height) - 1
    low = ordered[round(_OUTSIDE * last)]
    high = ordered[round((1 - _OUTSIDE) * last)]
    part = torch.bucketize(height, low + (high - low) * torch.arange(1, _PARTS).to(low) / _PARTS)
    ends = [100 * i // _PARTS for i in range(_PARTS + 1)]
    shares = {}
    for i in range(_PARTS):
        is_inside = part == i
        if bool(is_inside.any()):
            shares[f"{ends[i]} to {ends[i + 1]} %"] = float((count[is_inside] < 2).double().mean())
    return shares
