"""Photographs that stay on the device: the samples are those of photographs that are read."""

import pickle
from pathlib import Path

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.data.resident import Drawn, resident_batches
from ghgs_lit.errors import InputError
from ghgs_lit.types import Batch, map_tensors
from tests.helpers.people import equal, render_boxes, rendered
from tests.helpers.pretend_device import DEVICE, pretend_device

CPU = torch.device("cpu")
SIZES = {"sizes": [28, 40, [42, 33]], "target_scale": [0.7, 1.0]}


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "out", folder / "scans", train=2, val=1)
    return folder / "out"


def module(root, **options):
    arguments = {"size": 42, "steps_per_epoch": 6, "batch_size": 2, "workers": 0, "packed_gb": 0}
    return rendered(root, **(arguments | options))


def pairs(root, **options):
    """Batches from the device and those that are read, of the first steps."""
    data = module(root, resident="device", **options)
    read = module(root, **options).train_dataloader()
    there = list(data.train_dataloader())
    assert all(isinstance(batch, Drawn) for batch in there)
    return [(data.on_after_batch_transfer(a, 0), b) for a, b in zip(there, read, strict=True)]


@pytest.mark.parametrize("options", [{}, {"size": 28}, {"target_size": 28}, {"packed_gb": 1}], ids=str)
def test_samples_of_one_size_are_the_same_to_the_bit(root, options):
    """Photographs, masks, mattes, depths, bodies, cameras and names."""
    for there, read in pairs(root, **options):
        assert equal(there, read)
        assert there.depths is not None


def test_samples_of_varying_sizes_agree_to_rounding(root):
    """The same photographs, sizes and cameras;
    a mean at the middle of two levels may have the other one."""
    pixels = different = 0
    shapes = set()
    for there, read in pairs(root, augmentation=SIZES):
        shapes.add(there.images.shape[-2:])
        assert there.subjects == read.subjects
        assert (there.views, there.targets.names) == (read.views, read.targets.names)
        assert equal(there.cameras, read.cameras)
        assert equal(there.targets.cameras, read.targets.cameras)
        for name in ("images", "alpha", "depths", "masks"):
            one, other = getattr(there, name), getattr(read, name)
            assert one.shape == other.shape
            difference = (one.float() - other.float()).abs()
            if name in ("images", "alpha"):
                assert difference.max() <= 1.01 / 255
            pixels += one.numel()
            different += int((difference > 1e-6).sum())
        assert (there.targets.images - read.targets.images).abs().max() <= 1.01 / 255
        torch.testing.assert_close(there.depths, read.depths, rtol=2e-4, atol=0)
    assert len(shapes) == 3
    assert different < 1e-3 * pixels


def test_imperfect_steps_are_made_where_they_were(root):
    """A share of the steps, with the same random numbers; all others come from the device."""
    options = {"augmentation": {"exposure": 0.3, "mask_offset": 1.0, "chance": 0.5}, "steps_per_epoch": 12}
    data = module(root, resident="device", **options)
    kinds = set()
    for there, read in zip(data.train_dataloader(), module(root, **options).train_dataloader(), strict=True):
        kinds.add(type(there))
        assert equal(data.on_after_batch_transfer(there, 0), read)
    assert kinds == {Drawn, Batch}


def test_loading_processes_get_no_pixels(root):
    """They send numbers of photographs, by any start method."""
    data = module(root, resident="device", workers=1)
    batches = data.train_dataloader().dataset
    sent = pickle.dumps(batches)
    assert len(sent) < batches.inputs.images.nbytes / 10
    assert equal(data.on_after_batch_transfer(pickle.loads(sent)[2], 0), batches.batches[2])
    loaded = [data.on_after_batch_transfer(batch, 0) for batch in data.train_dataloader()]
    assert all(map(equal, loaded, module(root).train_dataloader()))


@pytest.mark.parametrize("augmentation", [None, SIZES])
def test_batches_are_made_on_the_device_without_a_wait(root, augmentation):
    """Gathered and resized there, as on a CPU."""
    plain = module(root, augmentation=augmentation).train_dataloader().dataset
    expected = resident_batches(plain, CPU)
    with pretend_device() as log:
        there = resident_batches(plain, DEVICE)
        there.inputs.batch(there[0].to(DEVICE), there.targets)  # weights of means are copied once
        for step in range(3):
            drawn = map_tensors(there[step], lambda tensor: tensor.to(DEVICE, non_blocking=True))
            there.inputs.batch(drawn, there.targets)
            log.clear()
            found = there.inputs.batch(drawn, there.targets)
            assert log.waits.total() == 0
            assert found.images.device == found.depths.device == found.body_vertices[0].device == DEVICE
            batch = expected.inputs.batch(expected[step], expected.targets)
            assert equal(found.to("cpu"), batch)


class Seen(L.LightningModule):
    """Keeps the batches of its steps."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.batches = []

    def training_step(self, batch, index):
        self.batches.append(batch)
        return self.weight.sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def test_lightning_trains_on_them(root, tmp_path):
    """The trainer hands each step a whole batch."""
    data, seen = module(root, resident="device"), Seen()
    options = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = L.Trainer(accelerator="cpu", max_steps=3, limit_val_batches=0, barebones=False, **options)
    trainer.fit(seen, datamodule=data)
    assert len(seen.batches) == 3
    assert all(map(equal, seen.batches, list(module(root).train_dataloader())[:3]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"augmentation": {"sizes": [28, 56]}},
            r"data\.resident: expected off, or sizes of at most \(42, 42\)",
        ),
        (
            {"augmentation": SIZES, "resampling": "release"},
            r"data\.resident: expected off with data\.resampling",
        ),
    ],
)
def test_what_the_device_cannot_resize_is_refused(root, options, message):
    """Before training begins."""
    with pytest.raises(InputError, match=message):
        module(root, resident="device", **options).train_dataloader()


def test_photographs_that_do_not_fit_are_refused(root, monkeypatch):
    """By the free memory of a GPU, half of which is for the model."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1_000_000, 2_000_000))
    batches = module(root).train_dataloader().dataset
    with pytest.raises(InputError, match=r"data\.resident: expected off, or .* GB of free memory on cuda:0"):
        resident_batches(batches, torch.device("cuda", 0))
