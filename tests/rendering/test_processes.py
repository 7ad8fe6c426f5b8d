"""The CPU backend with several threads and processes, on other processors, and with cached machine code."""

import dataclasses
import multiprocessing
import platform
import threading

import pytest
import torch

from ghgs_lit.ops import pool
from ghgs_lit.rendering import render
from tests.helpers.processes import run_prepared, run_python
from tests.helpers.splats import FIELDS, body, camera_ring, with_gradients


@pytest.mark.parametrize("splits", [(3000,), (1501, 0, 1, 1498)])
def test_the_same_bits_with_any_number_of_threads(monkeypatch, splits):
    """Results do not depend on how Gaussians and tiles are divided among threads."""
    monkeypatch.setattr(pool, "GRAIN", 64)  # small parts, so that several threads have work
    scene = body(3000, 64)
    scene.means[::3, 2] = 0.1  # Gaussians of equal depth in several parts
    scene = dataclasses.replace(scene, splits=splits)

    def run():
        gaussians = with_gradients(scene)
        rendering = render(gaussians, camera_ring(2, 64, 64, batch=len(splits)), "cpu")
        (rendering.image.square().sum() + rendering.depth.sum()).backward()
        return [rendering.image.detach(), *(getattr(gaussians, name).grad for name in FIELDS)]

    first = run()
    for threads in (2, 3, 7):
        torch.set_num_threads(threads)
        assert all(torch.equal(a, b) for a, b in zip(first, run(), strict=True))


def test_two_threads_of_the_caller_at_once():
    """Two threads that render concurrently do not disturb each other."""
    torch.set_num_threads(2)
    gaussians, views = body(2000, 48), camera_ring(2, 48, 48)
    wanted = render(gaussians, views, "cpu").image
    found = []

    def work():
        for _ in range(5):
            leaf = with_gradients(gaussians)
            rendering = render(leaf, views, "cpu")
            rendering.image.sum().backward()
            found.append(rendering.image.detach())

    threads = [threading.Thread(target=work) for _ in range(2)]
    [thread.start() for thread in threads]
    [thread.join(timeout=60) for thread in threads]
    assert len(found) == 10
    assert all(torch.equal(image, wanted) for image in found)


class _Renderings(torch.utils.data.Dataset):
    def __len__(self):
        return 8

    def __getitem__(self, index):
        torch.set_num_threads(2)
        gaussians = with_gradients(body(500, 32, seed=index))
        image = render(gaussians, camera_ring(1, 32, 32), "cpu").image
        image.square().sum().backward()
        return image.detach(), gaussians.means.grad


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this platform")
@pytest.mark.skipif(torch.cuda.is_available(), reason="beside CUDA, PyTorch refuses gradients after a fork")
@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker processes")
def test_training_in_four_workers_of_a_data_loader():
    """Forked processes render with gradients, and do not hang on the parent's threads."""
    # In a process of its own: where a backward pass ran on another device,
    # PyTorch refuses one after a fork.
    run_prepared(train_in_workers)


def train_in_workers():
    torch.set_num_threads(2)
    wanted = [_Renderings()[index] for index in range(8)]
    loader = torch.utils.data.DataLoader(
        _Renderings(), batch_size=None, num_workers=4, multiprocessing_context="fork", timeout=60
    )
    for found, (image, gradient) in zip(loader, wanted, strict=True):
        assert torch.equal(found[0], image)
        assert torch.equal(found[1], gradient)


def sums() -> tuple[float, float]:
    """Sum of an image, and of the squares of a gradient."""
    gaussians = with_gradients(body(300, 24))
    image = render(gaussians, camera_ring(1, 24, 24), "cpu").image
    image.square().sum().backward()
    return float(image.detach().sum()), float(gaussians.scales.grad.norm())


@pytest.mark.skipif(platform.machine() != "x86_64", reason="takes x86 vectors away")
def test_the_same_image_without_wide_vectors():
    """A processor with only 128-bit vectors gives the same image (the first run compiles for a while)."""
    code = "from tests.rendering.test_processes import sums; print(*sums())"
    done = run_python(code, NUMBA_CPU_NAME="x86-64", NUMBA_CPU_FEATURES="+sse2")
    assert [float(number) for number in done.stdout.split()] == pytest.approx(sums(), rel=1e-5)
