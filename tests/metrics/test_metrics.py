"""Metrics against scikit-image, the authors' numbers, the reference FLIP and exact cases."""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.signal import convolve2d

from ghgs_lit.errors import InputError
from ghgs_lit.metrics import PSNR_CAP, MetricsOptions, depth_error_mm, flip_map, psnr, ssim
from ghgs_lit.metrics.functional import ssim_map
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.training.base import image_mean

FIXTURES = Path(__file__).parents[1] / "fixtures"
RELEASE = MetricsOptions(protocol="release", lpips="off")


def _images(n=3, h=30, w=41, seed=0):
    g = torch.Generator().manual_seed(seed)
    target = torch.rand(n, 3, h, w, generator=g)
    image = (target + 0.1 * torch.randn(target.shape, generator=g)).clamp(0, 1)
    return image, target


def test_authors_evaluation_numbers():
    """The release protocol reproduces the numbers of the authors' evaluation."""
    data = load_file(FIXTURES / "losses.safetensors")
    first, second = data["in/img1"], data["in/img2"]
    assert torch.allclose(psnr(first, second)[:, None], data["out/psnr"], atol=1e-5)
    assert torch.allclose(ssim(first, second, "zeros"), data["out/ssim_per_image"], atol=2e-6)
    assert torch.allclose(
        ssim(first.double(), second.double(), "zeros"), data["out64/ssim_per_image"], atol=2e-7
    )
    # The release protocol, which measures whole images.
    release = RELEASE.build()
    values = release(first, second, torch.zeros(2, 40, 48, dtype=torch.bool))
    assert torch.allclose(values["psnr"][:, None], data["out/psnr"], atol=1e-5)
    assert torch.allclose(values["ssim"], data["out/ssim_per_image"], atol=2e-6)
    # Without padding the result differs, so the fixture distinguishes the paddings.
    assert (ssim(first, second, "valid") - data["out/ssim_per_image"]).abs().min() > 1e-3


def test_psnr_and_ssim_are_scikit_images():
    """PSNR and SSIM equal scikit-image's, as a mean and as a map."""
    metrics = pytest.importorskip("skimage.metrics")
    image, target = _images()
    options = {
        "channel_axis": 0, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5,
        "use_sample_covariance": False, "full": True,
    }  # fmt: skip
    for i in range(len(image)):
        a, b = image[i].double(), target[i].double()
        mean, full = metrics.structural_similarity(a.numpy(), b.numpy(), **options)
        assert ssim(a[None], b[None], "valid").item() == pytest.approx(mean, abs=1e-6)
        # The map inside the border, which scikit-image pads differently.
        own = ssim_map(a[None], b[None], "reflect")[0]
        assert np.abs(own.numpy() - full)[:, 5:-5, 5:-5].max() < 1e-6
        expected = metrics.peak_signal_noise_ratio(b.numpy(), a.numpy(), data_range=1.0)
        assert psnr(a[None], b[None]).item() == pytest.approx(expected, abs=1e-6)


def test_ssim_is_wide_under_autocast():
    """SSIM's moments stay float32 under autocast."""
    image, target = _images()
    with torch.autocast("cpu", torch.bfloat16):
        low = ssim(image, target)
    assert torch.equal(low, ssim(image, target))


def test_psnr_of_known_errors_by_region():
    """PSNR averages exactly the pixels of its region."""
    target = torch.zeros(1, 3, 10, 12)
    mask = torch.zeros(1, 10, 12, dtype=torch.bool)
    mask[0, 2, 3] = mask[0, 5, 8] = True
    image = target.clone()
    image[0, :, 2, 3] = 0.1  # one subject pixel is off by 0.1, the rest is exact
    box = box_of(mask)
    assert box.sum() == 4 * 6
    assert box[0, 2:6, 3:9].all()
    assert psnr(image, target).item() == pytest.approx(20 + 10 * np.log10(120), abs=1e-4)
    assert psnr(image, target, box).item() == pytest.approx(20 + 10 * np.log10(24), abs=1e-4)
    assert psnr(image, target, mask).item() == pytest.approx(20 + 10 * np.log10(2), abs=1e-4)


def test_equal_images_and_empty_regions_are_defined():
    """Equal images give the cap, and empty regions are left out of means."""
    image, _ = _images()
    nobody = torch.zeros(3, 30, 41, dtype=torch.bool)
    assert torch.equal(psnr(image, image), torch.full((3,), PSNR_CAP))
    assert torch.allclose(ssim(image, image), torch.ones(3))
    assert flip_map(image, image).abs().max() == 0
    lost = image.index_fill(0, torch.tensor([1]), torch.nan)
    assert flip_map(lost, image).isnan().flatten(1).all(1).tolist() == [False, True, False]
    assert flip_map(image, lost).isnan().flatten(1).any(1).tolist() == [False, True, False]
    assert psnr(image, image, nobody).isnan().all()
    assert not box_of(nobody).any()
    mean = image_mean()
    mean.update(psnr(image, image, box_of(nobody)))
    mean.update(psnr(image, image, box_of(~nobody)))
    assert mean.compute().item() == pytest.approx(PSNR_CAP)
    assert depth_error_mm(torch.ones(3, 30, 41), torch.ones(3, 30, 41), nobody).isnan()


@pytest.mark.parametrize("size", [(10, 10), (3, 40), (1, 1)])
def test_ssim_of_images_below_the_window_is_padded_as_in_the_release(size):
    """Only the release protocol pads with black, which works for images of any size."""
    image, target = torch.rand(
        2, 2, 3, *size, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    x = np.arange(11) - 5.0
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2

    def blur(values):
        return np.stack([convolve2d(v, window, mode="same") for v in values])

    a, b = image[0].numpy(), target[0].numpy()
    ma, mb = blur(a), blur(b)
    similarity = (2 * ma * mb + 1e-4) * (2 * (blur(a * b) - ma * mb) + 9e-4)
    similarity /= (ma**2 + mb**2 + 1e-4) * (blur(a * a) - ma**2 + blur(b * b) - mb**2 + 9e-4)
    assert ssim(image, target, "zeros")[0].item() == pytest.approx(similarity.mean(), abs=1e-9)
    for padding in ("reflect", "valid"):
        with pytest.raises(InputError, match="ssim: expected images of at least 11x11"):
            ssim(image, target, padding)


def test_flip_is_the_reference_implementation():
    """FLIP equals maps by the authors' flip-evaluator 1.7 at its default viewing distance (``flip.npz``)."""
    data = np.load(FIXTURES / "flip.npz")
    reference, test = (
        torch.from_numpy(data[k].astype(np.float32) / 255).permute(0, 3, 1, 2) for k in ("reference", "test")
    )
    assert torch.allclose(flip_map(test, reference), torch.from_numpy(data["flip"]), atol=2e-5)


def test_means_are_over_images():
    """Means are over images, not batches, accumulate in float64, and store nothing in checkpoints."""
    image, target = _images(4)
    mask = torch.rand(4, 30, 41, generator=torch.Generator().manual_seed(5)) > 0.9
    for values in (psnr(image, target, box_of(mask)), ssim(image, target, "zeros")):
        mean = image_mean()
        mean.update(values[:1])
        mean.update(values[1:])
        assert mean.compute().dtype == torch.float64
        assert mean.compute().item() == pytest.approx(values.double().mean().item(), rel=1e-12)
        assert not mean.state_dict()


def test_two_protocols_are_measured_side_by_side():
    """Each protocol gives the values that it gives alone; names of the second have its suffix."""
    images = torch.rand(2, 2, 3, 24, 24, generator=torch.Generator().manual_seed(0)) * 1.2
    mask = torch.zeros(2, 24, 24, dtype=torch.bool)
    mask[:, 4:20, 6:18] = True
    options = {"protocol": "release", "lpips": "off"}
    both = MetricsOptions(**options, beside="correct").build()
    values = both(*images, mask)
    assert list(values) == both.names
    first = MetricsOptions(**options).build()(*images, mask)
    second = MetricsOptions(lpips="off").build()(*images, mask)
    expected = first | {f"{name}_correct": value for name, value in second.items()}
    torch.testing.assert_close(values, expected, rtol=0, atol=0, equal_nan=True)
    assert values["psnr"].ne(values["psnr_correct"]).all()  # the release does not clamp
    assert MetricsOptions(lpips="off", beside="correct").build().names == [*second]


def test_a_protocol_reports_its_metrics_by_name():
    """Each protocol reports its own names, and clamps only if it is defined to."""
    image, target = _images(2)
    mask = torch.zeros(2, 30, 41, dtype=torch.bool)
    mask[:, 8:20, 10:30] = True
    metrics = MetricsOptions(lpips="off").build()
    values = metrics(image * 1.5, target, mask)
    assert list(values) == metrics.names
    assert set(values) == {
        "psnr", "ssim", "flip", "psnr_box", "ssim_box", "flip_box", "psnr_subject", "ssim_subject",
        "psnr_box_40", "psnr_edge", "spill", "sharpness",
    }  # fmt: skip
    assert torch.equal(values["psnr"], psnr((image * 1.5).clamp(0, 1), target))
    difference = flip_map((image * 1.5).clamp(0, 1), target)
    torch.testing.assert_close(values["flip"], difference.mean((1, 2)))
    torch.testing.assert_close(values["flip_box"], difference[:, 8:20, 10:30].mean((1, 2)))
    release = RELEASE.build()(image * 1.5, target, mask)
    assert set(release) == {"psnr", "ssim", "flip"}
    assert torch.equal(release["psnr"], psnr(image * 1.5, target))


def test_lpips_is_left_out_with_its_reason_or_refused():
    """Without torchvision, LPIPS is skipped with a reason, or an error if it is required."""
    try:
        import torchvision  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip("torchvision is installed")
    protocol = MetricsOptions(lpips="auto").build()
    assert protocol.lpips is None
    assert "torchvision" in protocol.left_out["lpips"]
    with pytest.raises(InputError, match="torchvision"):
        MetricsOptions(lpips="require").build()


class RecordingNetwork:
    """Replaces torchmetrics' LPIPS, and records its options and inputs."""

    def __init__(self, net_type):
        self.net, self.net_type, self.inputs = self, net_type, []

    def __call__(self, image, target, normalize):
        self.signed = normalize
        self.inputs.append((image, target))
        return (image - target).abs().mean((1, 2, 3), keepdim=True)


@pytest.fixture
def recorded(monkeypatch):
    import torchmetrics.image.lpip

    monkeypatch.setitem(sys.modules, "torchvision", types.ModuleType("torchvision"))
    monkeypatch.setattr(
        torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", RecordingNetwork, raising=False
    )


@pytest.mark.usefixtures("recorded")
def test_lpips_sees_what_its_protocol_says():
    """LPIPS gets images one at a time, in the range of its protocol."""
    image, target = _images(3)
    mask = torch.ones(3, 30, 41, dtype=torch.bool)
    overshooting = image * 1.5
    for protocol, signed, expected in (
        (MetricsOptions().build(), True, overshooting.clamp(0, 1)),
        # The authors' evaluation: neither clamped nor mapped to [-1, 1].
        (RELEASE.replace(lpips="require").build(), False, overshooting),
    ):
        values = protocol(overshooting, target, mask)["lpips"]
        network = protocol.lpips.network
        assert (network.net_type, network.signed) == ("vgg", signed)
        # One image at a time, since torchmetrics gives the mean of a batch.
        assert torch.equal(torch.cat([a for a, _ in network.inputs]), expected)
        assert torch.allclose(values, (expected - target).abs().mean((1, 2, 3)))


@pytest.mark.usefixtures("recorded")
def test_lpips_without_its_weights_is_left_out_with_one_line(monkeypatch):
    """If the weights cannot be downloaded, LPIPS is skipped with a one-line message."""
    import torchmetrics.image.lpip

    def offline(**_):
        raise OSError("no\nroute")

    monkeypatch.setattr(
        torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", offline, raising=False
    )
    protocol = MetricsOptions().build()
    assert protocol.lpips is None
    assert protocol.left_out["lpips"] == "LPIPS: the weights of 'vgg' could not be loaded: no route"


def test_depth_error_is_in_millimetres_on_known_subject_pixels():
    """Depth errors average only subject pixels with a known depth, in millimetres."""
    depth = torch.full((1, 2, 3), 2.0)
    truth = torch.tensor([[[2.01, 2.03, 0.0], [2.0, 5.0, 2.0]]])
    region = torch.tensor([[[True, True, True], [False, False, True]]])
    assert depth_error_mm(depth, truth, region).item() == pytest.approx((10 + 30 + 0) / 3, abs=1e-3)
