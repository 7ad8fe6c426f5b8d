"""Weight files that were damaged, or that unpack without limit, are rejected by every reader."""

import tracemalloc
import zipfile

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.training.checkpoints import AtomicCheckpointIO
from ghgs_lit.training.start import check_resume, initialize
from ghgs_lit.weights.checkpoint import (
    read_checkpoint,
    write_inference,
)
from ghgs_lit.weights.reading import SHIPPED_FILE, open_file
from tests.helpers.checkpoints import content
from tests.helpers.models import config, load_model, make_model
from tests.helpers.training import held


def flip(path, near):
    """Flip one bit of the bytes ``near``, which occur in the file once."""
    data = bytearray(path.read_bytes())
    data[data.index(near) + 1] ^= 0x08
    path.write_bytes(data)


READERS = {
    "predict and evaluate": lambda path: load_model(path),
    "init_from": lambda path: initialize(make_model(), path),
    "resume": lambda path: check_resume(path, held(make_model()), config()),
    "inference": lambda path: write_inference(path, path.with_name("b.ckpt"), "float16"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("save", "where"),
    [(AtomicCheckpointIO().save_checkpoint, "weights"), (torch.save, "configuration")],
)
def test_one_changed_bit_is_refused_by_every_reader(tmp_path, reader, save, where):
    """A flipped bit would silently change the model."""
    path, made = tmp_path / "last.ckpt", content()
    name = "model.gaussian_head.dpt.projections.0.weight"
    name = name if name in made["state_dict"] else next(n for n in made["state_dict"] if "head" in n)
    save(made, path)
    read_checkpoint(path, whole=True)
    near = made["state_dict"][name].numpy().tobytes()[:64]
    flip(path, near if where == "weights" else b"neighborhood")
    with pytest.raises(InputError, match=r"last\.ckpt: expected .* damaged"):
        READERS[reader](path)


def test_the_shipped_file_has_checksums(tmp_path):
    path = tmp_path / "shipped.ckpt"
    with zipfile.ZipFile(SHIPPED_FILE) as archive:
        sizes = sorted(archive.infolist(), key=lambda record: record.file_size)
        records = [*sizes[-3:], *(record for record in sizes if record.filename.endswith("data.pkl"))]
        contents = [archive.read(record) for record in records]
    for data in contents:
        path.write_bytes(SHIPPED_FILE.read_bytes())
        flip(path, data[len(data) // 2 :][:256])
        with pytest.raises(InputError, match=r"shipped\.ckpt: expected"):
            load_model(path)


def repack(path, compression):
    """Rewrite the records of a PyTorch file, as a repair program for archives does."""
    with zipfile.ZipFile(path) as archive:
        records = {record.filename: archive.read(record) for record in archive.infolist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in records.items():
            archive.writestr(name, data)


def claim(path, size):
    """Set the size of the last record of a PyTorch file to ``size`` bytes in both of its headers."""
    with zipfile.ZipFile(path) as archive:
        last = archive.infolist()[-1]
    data, name = bytearray(path.read_bytes()), last.filename.encode()
    sizes = 2 * last.file_size.to_bytes(4, "little")
    for place in (data.index(sizes, last.header_offset), data.index(sizes, data.rindex(name) - 46)):
        data[place : place + 8] = 2 * size.to_bytes(4, "little")
    path.write_bytes(data)


FILES_OF_WEIGHTS = {**READERS, "any file of weights": open_file}


@pytest.mark.parametrize("reader", FILES_OF_WEIGHTS)
def test_compressed_records_are_refused_by_every_reader(tmp_path, reader):
    """PyTorch maps records as stored: all weights would silently be other numbers."""
    path = tmp_path / "a.ckpt"
    torch.save(content(), path)
    repack(path, zipfile.ZIP_STORED)
    assert load_model(path)
    kinds = (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    for compression in kinds if reader == "any file of weights" else kinds[:1]:
        repack(path, compression)
        with pytest.raises(
            InputError, match=r"a\.ckpt: expected .*; found a compressed or encrypted record \(a/"
        ):
            FILES_OF_WEIGHTS[reader](path)


def test_a_file_that_unpacks_without_limit_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a.ckpt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("data.pkl", "version"):
            archive.writestr(f"a/{name}", bytes(1 << 26))
    tracemalloc.start()
    with pytest.raises(InputError, match="found a compressed"):
        read_checkpoint(path, whole=True)
    assert tracemalloc.get_traced_memory()[1] < 1 << 24
    tracemalloc.stop()
    torch.save(content(), path)
    claim(path, 1 << 30)
    with pytest.raises(InputError, match=r"a\.ckpt: expected .*; found"):
        read_checkpoint(path)
