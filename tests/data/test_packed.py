"""Packed files: samples equal those of the original files, whatever happens to either."""

import multiprocessing
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data import packed
from ghgs_lit.data.reader import Photographs
from tests.helpers.people import equal, render_boxes, rendered

SIZES = {"sizes": [28, [42, 28]], "target_scale": [0.7, 1.0]}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory) -> Path:
    """Rendered boxes: two subjects for training and one for validation."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "out", folder / "scans", train=2, val=1)
    return folder / "out"


@pytest.fixture
def root(boxes, tmp_path) -> Path:
    """A copy of the data that a test may change."""
    return shutil.copytree(boxes, tmp_path / "out")


def batches(root, packed=True, **options):
    """Batches of the first steps of a training."""
    data = rendered(root, packed=packed, **{"steps_per_epoch": 4, "batch_size": 2, "workers": 0, **options})
    return list(data.train_dataloader())


def files(root) -> list[Path]:
    return sorted((root / "packed").glob("*.safetensors"))


def same(root, **options) -> bool:
    """Whether batches from packed files equal those from the original files, bit for bit."""
    return all(map(equal, batches(root, **options), batches(root, packed=False, **options)))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"size": 42},
        {"target_size": 42},
        {"augmentation": SIZES},
        {"resampling": "release"},
        {"workers": 2},
    ],
    ids=str,
)
def test_samples_are_those_of_the_folder(root, options):
    """Images, masks, mattes, depths, bodies and cameras are equal, whether resized once, in each step or
    never."""
    assert same(root, **options)
    assert files(root)
    first = batches(root, **options)[0]
    assert first.depths is not None
    assert first.alpha is not None


def test_samples_come_from_the_packed_files(root):
    """Once packed files exist, no image is decoded."""
    expected = batches(root)
    times = [path.stat().st_mtime_ns for path in files(root)]

    def refuse(*_):
        raise AssertionError("a photograph was decoded")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ghgs_lit.data.layout.read_photograph", refuse)
        with pytest.raises(AssertionError):
            batches(root, packed=False)
        assert all(map(equal, batches(root), expected))
    assert [path.stat().st_mtime_ns for path in files(root)] == times


@pytest.mark.parametrize("kind", ["img", "alpha", "depth", "parm", "smpl"])
def test_changed_data_is_never_read_from_an_old_file(root, kind):
    """Changes are detected even if size and modification time stay equal, by the time of the status
    change."""
    before = batches(root)
    for path in (root / "train" / kind).glob("*/*"):
        stat = path.stat()
        if path.suffix == ".npy":
            matrix = np.load(path)
            matrix[0, -1] += 0.1
            np.save(path, matrix)
        else:
            values = np.asarray(Image.open(path))
            Image.fromarray(values - values // 4).save(path)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    after = batches(root)
    assert all(map(equal, after, batches(root, packed=False)))
    assert not any(map(equal, after, before))
    assert len(files(root)) == 2  # outdated files were deleted


def test_an_interrupted_or_torn_file_is_written_again(root):
    """Files that a killed process or a full disk has left are written again."""
    batches(root)
    packed._open.cache_clear()
    for path in files(root):
        path.write_bytes(path.read_bytes()[:-100])
    assert same(root)
    packed._open.cache_clear()
    files(root)[0].write_bytes(b"")
    assert same(root)
    assert all(path.stat().st_size > 1000 for path in files(root))


def _read(root, go_on):
    go_on.wait()
    raise SystemExit(not same(root))


def test_many_processes_at_once(root):
    """All processes read correct samples, whichever has written the files."""
    context = multiprocessing.get_context("fork")
    go_on = context.Barrier(3)
    readers = [context.Process(target=_read, args=(root, go_on)) for _ in range(3)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join(60)
    assert [reader.exitcode for reader in readers] == [0, 0, 0]
    assert len(files(root)) == 2


def test_a_broken_photograph_is_named_when_it_is_drawn(root):
    """A broken image is not packed, and raises its error when it is sampled; the others are packed."""
    path = root / "train" / "img" / "s0_000" / "0.jpg"
    path.write_bytes(b"no image")
    reader = rendered(root).dataset.reader("train")
    photographs = Photographs(reader)
    photographs.packs = {None: packed.Packs(reader, root / "packed", None, "area", (0, 2), True)}
    assert photographs.view("s0", 0, 2).image.shape == (42, 42, 3)
    assert files(root)
    with pytest.raises(ValueError, match=r"s0_000.0\.jpg: expected a readable image"):
        photographs.view("s0", 0, 0)


def test_depth_maps_that_are_not_packed_are_read_from_the_folder(root):
    reader = rendered(root).dataset.reader("train")
    packs = packed.Packs(reader, root / "packed", None, "area", (0, 2), False)
    assert packs.view("s0", 0, 2, depth=False).depth is None
    assert packs.view("s0", 0, 2, depth=True) is None


def test_packing_can_be_switched_off(root):
    batches(root, packed=False)
    assert not files(root)


@pytest.mark.parametrize("free", [0, 50])
def test_a_full_disk_stops_no_training(root, caplog, monkeypatch, free):
    """If files cannot be written or less than a tenth of the disk is free, the original ones are read, with
    a single warning."""
    batches(root)
    files(root)[1].unlink()

    def full(path, write):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(packed, "write_atomically", packed.write_atomically if free == 0 else full)
    monkeypatch.setattr(packed.shutil, "disk_usage", lambda _: SimpleNamespace(total=100, free=free))
    packed._open.cache_clear()
    assert same(root)
    assert len(files(root)) == 1
    assert sum("found No space left on device" in record.message for record in caplog.records) == 1


def test_data_that_cannot_be_written_to_is_packed_in_the_cache(root, tmp_path, monkeypatch):
    """Each data set has its own folder in the cache."""
    monkeypatch.setenv("GHGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(packed.os, "access", lambda path, mode: False)
    assert same(root)
    assert not files(root)
    assert len(list((tmp_path / "cache" / "packed").glob("*/*.safetensors"))) == 2
    assert packed.choose_folder(root) != packed.choose_folder(tmp_path)


def test_short_trainings_write_nothing(root):
    """Nothing is packed if a run reads fewer images than the data set has."""
    from lightning import Trainer

    def steps(count):
        data = rendered(root, steps_per_epoch=4, workers=0)
        data.trainer = Trainer(max_steps=count, accelerator="cpu", logger=False, enable_checkpointing=False)
        next(iter(data.train_dataloader()))

    steps(20)  # of 5 images each; the data has 2 x 16 x 4
    assert not files(root)
    steps(30)
    assert files(root)
