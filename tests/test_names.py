"""File names as spelled by other systems, found by the one function that captures, data sets and scans
share."""

import pytest

from ghgs_lit.parsing import find_path, split_path

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
