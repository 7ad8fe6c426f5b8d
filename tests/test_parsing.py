"""Files that are broken, foreign or endless are rejected at once, with a one-line message that contains
their path."""

import contextlib
import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from ghgs_lit.data.decoding import read_array, read_image
from ghgs_lit.data.layout import Completeness
from ghgs_lit.data.pickles import load_npy
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import read_sweep
from ghgs_lit.parsing import (
    LARGEST,
    find_path,
    read_json,
    read_npy,
    read_rows,
    read_text,
    read_yaml,
    split_path,
)
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_people.jobs import check_settings

READERS = (read_text, read_json, read_yaml, read_rows, read_npy)


def large(path):
    path.touch()
    os.truncate(path, LARGEST + 1)


#: Creates a path that no reader accepts, by name.
NO_FILES = {
    "missing": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to itself": lambda path: path.symlink_to(path),
    "a device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "it"
    NO_FILES[kind](path)
    for reader in (*READERS, read_image):
        with pytest.raises(InputError, match=r"it: expected .*; found \W?(no such f|a f|no reg|Too many)"):
            reader(path)


LAUGHS = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"


@pytest.mark.parametrize(
    ("reader", "content", "found"),
    [
        (read_json, b'{"a": ', "Expecting value"),
        (read_json, b"\xff\xfe{}", "codec can't decode"),
        (read_json, b"", "Expecting value"),
        (read_json, b"[" * 100_000, "recursion"),
        (read_json, b"[" * 70 + b"]" * 70, "more than 64 levels"),
        (read_yaml, b"a: [1, 2", "expected ','"),
        (read_yaml, b"\x00", "(control|special) characters"),
        (read_yaml, b"a: !!python/object/apply:os.system [x]", "could not determine a constructor"),
        (read_yaml, LAUGHS.encode(), r"an alias \(\*name\)"),
        (read_yaml, b"[" * 5000, "more than 64 levels"),
        (read_yaml, b"[" * 70 + b"]" * 70, "more than 64 levels"),
        (read_json, b'{"a": [-%s]}' % (b"9" * 400), "a number of 1329 bits"),
        (read_json, b"9" * 5000, "limit"),
        (read_yaml, b"a: " + b"9" * 400, "a number of 1329 bits"),
        (read_yaml, b"a: 0x" + b"F" * 9000, "limit"),
        (read_yaml, b"a: 2026-01-01", "type date"),
        (read_yaml, b"a: [!!binary aGk=]", "type bytes"),
        (read_yaml, b"a: !!set {b}", "type set"),
        (read_yaml, b"? 2026-01-01\n: 1", "keys must be str"),
        (read_yaml, b"a: !!int b", "invalid literal"),
        (read_yaml, b"a: !color red", "could not determine a constructor"),
        (read_rows, b"a\n" + b"x" * 200_000, "field larger"),
        (read_rows, b"\xff", "codec can't decode"),
        (read_npy, b"\x93NUMPY\x01\x00", "cannot be read"),
        (read_npy, b"", "cannot be read"),
        (read_text, large, "256 MB"),
    ],
)  # fmt: skip
def test_broken_content_is_one_line(tmp_path, reader, content, found):
    path = tmp_path / "it"
    content(path) if callable(content) else path.write_bytes(content)
    with pytest.raises(InputError, match=f"(?s)it: expected .*; found .*{found}"):
        reader(path)


def test_a_byte_order_mark_is_no_content(tmp_path):
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": [1]}')
    assert read_json(tmp_path / "a.json") == {"a": [1]}
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfa,b\r\n1,2\r\n")
    assert read_rows(tmp_path / "a.csv") == [{"a": "1", "b": "2"}]


HEADERS = [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (",
    "{'descr': '<f8', 'fortran_order': False, 'shape': ('a',)}",
]


@pytest.mark.parametrize("reader", [read_npy, load_npy, lambda path: read_array(path, [(3, 3)])])
def test_a_header_that_promises_terabytes_or_is_broken(tmp_path, reader):
    path = tmp_path / "a.npy"
    for header in HEADERS:
        text = header.ljust(117).encode() + b"\n"
        path.write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(64))
        with pytest.raises(InputError, match=r"a\.npy: expected"):
            reader(path)


def test_arrays_come_back(tmp_path):
    for array in (np.zeros(0), np.array(3.0), np.arange(6.0).reshape(2, 3), np.ones((2, 3), order="F")):
        np.save(tmp_path / "a.npy", array)
        assert np.array_equal(read_npy(tmp_path / "a.npy"), array)


def test_a_picture_with_a_text_that_unpacks_without_end(tmp_path):
    info = PngImagePlugin.PngInfo()
    info.add_text("a", "x" * (PngImagePlugin.MAX_TEXT_CHUNK + 1), zip=True)
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png", pnginfo=info)
    with pytest.raises(InputError, match=r"a\.png: expected a readable image; found"):
        read_image(tmp_path / "a.png")


FOREIGN = (b"\xff\xfe", b'{"a":', b"5", b"[5]", b'{"train": 5}', b'{"train": [[1]]}', b"[" * 2000, b"null")


def test_foreign_content_of_files_of_this_program(tmp_path):
    """Errors for foreign plans, settings, split lists and results contain the path."""
    folder = tmp_path / "rendering"
    folder.mkdir()
    readers = {
        folder / "plan.json": lambda: Completeness(tmp_path).plan,
        folder / "settings.json": lambda: check_settings(
            Completeness(tmp_path), {"render": {"lights": "none"}}
        ),
        tmp_path / "metrics.json": lambda: read_results(tmp_path / "metrics.json"),
    }
    for (path, read), content in itertools.product(readers.items(), FOREIGN):
        path.write_bytes(content)
        with pytest.raises(InputError, match=path.name.replace(".", r"\.")):
            read()


@pytest.mark.parametrize("content", [*FOREIGN, b"seed: text\ntrainer: 3\ndata: []\nrecalibration: {}"])
def test_runs_of_foreign_content_are_read_or_named(tmp_path, content):
    run = RunDirectory(tmp_path)
    for name in ("config.yaml", "csv/metrics.csv", ".hydra/overrides.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    assert not run.done
    with contextlib.suppress(InputError):
        read_sweep([tmp_path])


#: Stored file, name given by a file or user, accepted suffixes.
SPELLINGS = [
    ("masks/cam0.png", "masks/cam0.png", ("",)),
    ("masks/cam0.png", "masks\\cam0.png", ("",)),
    ("masks/cam0.png", ".\\masks/cam0.png", ("",)),
    ("masks/cam0.png", "masks\\..\\masks\\cam0.png", ("",)),
    ("Masks/cam0.PNG", "masks\\cam0.png", ("",)),
    ("0001.OBJ", "0001", (".glb", ".obj")),
    ("0.JPG", "0", (".jpg", ".png")),
    ("a.b.Jpeg", "a.b", (".jpg", ".jpeg")),
    ("Ka\u0308the/0.png", "K\u00e4the\\0.png", ("",)),
    ("K\u00e4the 1.PNG", "Ka\u0308the 1", (".png",)),
    ("Material 0.jpeg", "material 0.JPEG", ("",)),
]


@pytest.mark.parametrize(("stored", "said", "suffixes"), SPELLINGS)
def test_a_file_is_found_under_every_spelling(tmp_path, stored, said, suffixes):
    path = tmp_path / stored
    path.parent.mkdir(exist_ok=True)
    path.touch()
    assert find_path(tmp_path, said, suffixes).resolve() == path


def test_the_nearest_spelling_counts(tmp_path):
    """The exact spelling first, the preferred suffix before others, and never one of several that differ
    only in case."""
    for name in ("a.PNG", "A.png", "b.png", "b.jpg", "C.png", "c.PNG", "D.png", "d.pNG", "d.PNG"):
        (tmp_path / name).touch()
    assert find_path(tmp_path, "a", (".png",)).name == "a.PNG"
    assert find_path(tmp_path, "A", (".png",)).name == "A.png"
    assert find_path(tmp_path, "b", (".jpg", ".png")).name == "b.jpg"
    assert find_path(tmp_path, "C.png").name == "C.png"
    assert find_path(tmp_path, "d.png") is None
    for missing in ("e", "none/a.png", "a\0", "x" * 300, "none\\..\\b.png"):
        assert find_path(tmp_path, missing) is None


def test_a_file_that_arrives_later_is_found(tmp_path):
    """The folder is listed again when it changes."""
    assert find_path(tmp_path, "a", (".png",)) is None
    (tmp_path / "a.PNG").touch()
    assert find_path(tmp_path, "a", (".png",)).name == "a.PNG"


def test_parts_of_a_path():
    assert split_path("images\\Ka\u0308the/0.png") == ["images", "K\u00e4the", "0.png"]
