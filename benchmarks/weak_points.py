"""Where the plain formulas of this method break, and what the package gives there.

    python benchmarks/weak_points.py

Prints the figures of ``docs/evidence/stress.md``. W1 to W22 number weak points of the authors' release; each
plain formula is written out here. Those that are not about numbers are named in the document.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.encoder.block import rotary_tables
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.geometry.unprojection import subject_tokens
from ghgs_lit.heads.activations import confidence_of
from ghgs_lit.heads.depth import bounded_depth
from ghgs_lit.heads.dpt import ResidualUnit
from ghgs_lit.heads.gaussian import FootprintAttributes
from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.recalibration import SemanticAttention, nearest_neighbors
from ghgs_lit.types import Cameras, DepthMaps

#: The number of a weak point, the plain formula with its case, what it gives, what the package gives.
Row = tuple[str, str, str, str]


def slope(function: Callable[[Tensor], Tensor], x: float) -> float:
    """The derivative of a function of one number."""
    leaf = torch.tensor([x], requires_grad=True)
    return float(torch.autograd.grad(function(leaf).sum(), leaf)[0])


def inverse_depth() -> list[Row]:
    near, far = torch.tensor(1.5), torch.tensor(2.5)

    def ours(raw: float) -> float:
        return float(bounded_depth(torch.tensor(raw), near, far, "linear"))

    plain = [1 / (d + 1e-8) for d in (-0.1, 1e-6)]
    half = 1 / (torch.tensor([0.0, 1e-5], dtype=torch.float16) + 1e-8)
    with torch.autocast("cpu", torch.bfloat16):
        confident = float(confidence_of(torch.tensor(100.0)))
    return [
        (
            "W1", "z = 1 / (d + 1e-8) at d = -0.1 and 1e-6, as a linear head gives them",
            f"z = {plain[0]:.0f} m, behind the camera, and {plain[1]:.0g} m; slope at d = 0.01: -1e4",
            f"between near 1.5 m and far 2.5 m: {ours(-0.1):.3f} m; raw -1e4 and 1e4: {ours(-1e4):.4f} m and"
            f" {ours(1e4):.4f} m",
        ),
        (
            "W2", "1 / (d + 1e-8) in float16 at d = 0 and 1e-5; exp(100) in float32",
            f"{half[0]:g} and {half[1]:g}; {float(torch.tensor(100.0).exp()):g}",
            f"depth is float32 under any autocast; confidence of raw 100: {confident:.2g}",
        ),
    ]  # fmt: skip


def similarity() -> Row:
    raw, cosines = torch.tensor([-3.0, -3.0]), torch.tensor([0.1, 1.0])
    plain = torch.exp(raw * cosines)
    block = SemanticAttention(16, 2, "log")
    factor, bias = block.factor_and_bias(cosines)
    ours = (raw * factor + bias).exp()
    return (
        "W6", "logit times s: a neighbour with s = 0.1 against an identical one, both with a logit of -3",
        f"{float(plain[0] / plain[1]):.1f} times its weight",
        f"`recalibration.similarity=log`: {float(ours[0] / ours[1]):.1f} times",
    )  # fmt: skip


def token_places() -> list[Row]:
    patches, patch, border = 37, 14, 3
    place = torch.arange(patches, dtype=torch.float64) + 0.5
    truth = place * patch - border
    plain = (place * 512 / patches - truth).abs().max()
    valid = torch.ones(1, 1, 512, 512, dtype=torch.bool)
    padded = F.pad(valid, (border,) * 4, value=True)
    depth = torch.full(padded.shape, 2.0)
    pixels = subject_tokens(DepthMaps(depth, padded, depth), patch)[0][0, 0, 0, :, 0] - border
    ours = (pixels.double() - truth).abs().max()
    rows = [(
        "W7", "the centre of patch i at (i + 0.5) 512 / 37, where patches have 14 pixels and a border of 3",
        f"{plain:.2f} px beside it", f"{ours:.1g} px beside it",
    )]  # fmt: skip
    body = torch.zeros(1, 1, 56, 56, dtype=torch.bool)
    body[..., 20:40, 11:35] = True
    depth = torch.where(body, 2.0, 10.0)
    sampled = 1 / F.interpolate(1 / depth, (4, 4), mode="bilinear", align_corners=False)
    _, found, any_valid = subject_tokens(DepthMaps(depth, body, depth), patch)
    rows.append((
        "W8", "a token's depth is a 2 x 2 sample of inverse depth, at a silhouette (2 m before 10 m)",
        f"wrong by up to {float((sampled - 2)[any_valid].abs().max()):.1f} m",
        f"mean over the subject's pixels: wrong by {float((found - 2)[any_valid].abs().max()):.1g} m",
    ))  # fmt: skip
    return rows


def residual() -> Row:
    """How far the result, and the gradient of what comes in, are from those of nothing."""
    found = []
    for rectified in (True, False):
        torch.manual_seed(0)
        unit = ResidualUnit(8, rectified)
        x = (-1 - torch.rand(1, 8, 6, 6)).requires_grad_()
        difference = (unit(x) - unit(2 * x)).detach().abs().mean()
        (gradient,) = torch.autograd.grad(unit(x).sum(), x)
        found.append(f"{float(difference):.2g}, gradient {float(gradient.abs().mean()):.2g}")
    return (
        "W10", "`r + conv2(relu(conv1(r)))`, `r = relu(x)`, where all of x is negative; x against 2 x",
        f"differ by {found[0]}: in training, heads lost levels for good",
        f"`rectified_skip: false` (`model=hull`, `recurrent`): {found[1]}",
    )  # fmt: skip


def neighbours() -> list[Row]:
    g = torch.Generator().manual_seed(0)
    points = torch.tensor([1000.0, 0.0, 0.0]) + 0.3 * torch.randn(1024, 3, generator=g)
    plain = torch.cdist(points, points, compute_mode="use_mm_for_euclid_dist")
    index = plain.topk(8, largest=False).indices
    alone = torch.arange(1024)[:, None]
    exact = torch.cdist(points.double(), points.double()).topk(8, largest=False).indices
    ours = nearest_neighbors(points, torch.zeros(1024, dtype=torch.long), 8)

    def agreement(found: Tensor) -> float:
        return float((found[:, :, None] == exact[:, None]).any(2).float().mean())

    distance = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0]).tolist() + [torch.inf] * 3
    masked = torch.tensor(distance).topk(8, largest=False).indices
    few = nearest_neighbors(points[:5], torch.zeros(5, dtype=torch.long), 8)
    return [
        (
            "W11", "a^2 - 2 ab + b^2 in float32, 1 km from the origin, 8 neighbours of 1024 points",
            f"{agreement(index):.0%} of the true ones; {int((index != alone).all(1).sum())} points are not"
            " their own neighbour",
            f"{agreement(ours):.1%}; {int((ours != alone).all(1).sum())} points",
        ),
        (
            "W13", "the 8 smallest of distances in which 3 are masked by infinity; 5 points with k = 8",
            f"{int((masked >= 5).sum())} masked ones are taken; the second raises",
            f"{few.shape[1]} neighbours, all of them points",
        ),
    ]  # fmt: skip


def attributes() -> list[Row]:
    ours = FootprintAttributes()
    zeros = torch.zeros(1, 3)

    def scale(x: Tensor) -> Tensor:
        return -ours(zeros, x.expand(1, 3), torch.zeros(1, 4), torch.zeros(1), torch.ones(1))[1]

    plain = slope(lambda x: F.softplus(x, beta=100), -0.2)
    short = torch.tensor([1e-20, 1e-20, 0.0, 0.0])
    return [
        (
            "W14", "softplus(100 x) / 100 at x = -0.2; a quaternion of length 1e-20 over max(length, 1e-12)",
            f"slope {plain:.0e}: the scale is dead; length {float(F.normalize(short, dim=0).norm()):.0e}",
            f"slope at -20, upwards: {abs(slope(scale, -20.0)):.0e}; length {float(unit(short).norm()):.2f}",
        ),
    ]  # fmt: skip


def metrics() -> list[Row]:
    image = torch.full((1, 3, 64, 64), 0.7)
    brighter = image + 0.1
    return [
        (
            "W15", "-10 log10(MSE) of equal images; SSIM with zeros around the images (0.7 against 0.8)",
            f"{float(-10 * (image - image).square().mean().log10()):g} dB, and so is every mean;"
            f" {float(ssim(image, brighter, 'zeros')):.4f}",
            f"{float(psnr(image, image)):g} dB at most; {float(ssim(image, brighter)):.4f} inside the image",
        ),
    ]  # fmt: skip


def rotary() -> Row:
    positions = torch.arange(38)[:, None].expand(38, 2)
    exact = rotary_tables(positions, 64, torch.zeros(1, dtype=torch.float64)).cosine
    angles = positions.float()[..., None] * 100.0 ** (-torch.arange(0, 64, 4) / 64)
    rounded = torch.stack((angles, angles), -2).flatten(-3).bfloat16().cos().double()
    ours = rotary_tables(positions, 64, torch.zeros(1, dtype=torch.bfloat16)).cosine.bfloat16().double()
    return (
        "W17", "angles of rotary positions in bfloat16",
        f"cosines wrong by {float((rounded - exact).abs().max()):.0e}",
        f"angles in float32: {float((ours - exact).abs().max()):.0e}, from rounding the cosine",
    )  # fmt: skip


def intrinsics() -> Row:
    focal = torch.diag(torch.tensor([1500.0, 1500.0, 1.0]))
    ours = Cameras(focal, torch.eye(4), 1500, 1500).resized(512, 512).intrinsics[0, 0]
    return (
        "W22", "intrinsics halved for a photograph of 1500 pixels that is resized to 512",
        f"focal length {1500 / 2:.0f} px", f"{float(ours):.0f} px",
    )  # fmt: skip


def main() -> None:
    rows = [
        *inverse_depth(),
        similarity(),
        *token_places(),
        residual(),
        *neighbours(),
        *attributes(),
    ]
    rows += [*metrics(), rotary(), intrinsics()]
    print("| | plain formula and case | gives | here |\n|---|---|---|---|")
    for row in rows:
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
