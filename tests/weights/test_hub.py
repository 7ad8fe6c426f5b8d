"""Downloads with a replacement of the hub's client:
checks and error messages are this project's."""

import hashlib
import sys
import types

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.weights import importing

ADDRESS = "https://hub.test/facebook/VGGT-1B/resolve/main/model.safetensors"


def fake_client(monkeypatch, cached=None, download=None, offline=False):
    """A client whose cache holds ``cached`` and whose download is ``download``."""
    client = types.ModuleType("huggingface_hub")
    client.constants = types.SimpleNamespace(HF_HUB_OFFLINE=offline)
    client.hf_hub_url = lambda repository, filename: f"https://hub.test/{repository}/resolve/main/{filename}"
    client.try_to_load_from_cache = lambda repository, filename: cached
    client.hf_hub_download = download or (lambda *_: pytest.fail("no download was needed"))
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)


def cached_file(folder, content, name=None):
    """A file in the way the client caches it: under its sum, behind a link."""
    blob = folder / (name or hashlib.sha256(content).hexdigest())
    blob.write_bytes(content)
    link = folder / "model.safetensors"
    link.symlink_to(blob)
    return str(link)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("facebook/VGGT-1B", True),
        ("weights/model.safetensors", False),
        ("weights/model.pt", False),
        ("/data/vggt/model", False),
        ("model", False),
        ("a/b/c", False),
    ],
)
def test_repositories_and_files_are_distinguished(name, expected):
    """A file name must not be looked up on the hub, nor a repository on the disk."""
    assert importing.is_repository(name) is expected


def test_a_file_that_exists_is_a_file(tmp_path, monkeypatch):
    """A local file that is named like a repository must be preferred."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "facebook").mkdir()
    (tmp_path / "facebook" / "VGGT-1B").write_bytes(b"x")
    assert not importing.is_repository("facebook/VGGT-1B")


def test_a_cached_file_needs_no_network(monkeypatch, tmp_path):
    """Weights that were downloaded once must work offline."""
    path = cached_file(tmp_path, b"weights")
    fake_client(monkeypatch, cached=path, offline=True)
    _, found, checksum = importing.fetch("facebook/VGGT-1B")
    assert str(found) == path
    assert checksum == hashlib.sha256(b"weights").hexdigest()


def test_a_download_is_checked(monkeypatch, tmp_path):
    """A broken download must not become a checkpoint."""
    broken = cached_file(tmp_path, b"half of the wei", name="0" * 64)
    fake_client(monkeypatch, download=lambda *_: broken)
    with pytest.raises(InputError, match=r"0{64}: expected SHA-256 0{64}; found '\w{64}: a broken download"):
        importing.fetch("facebook/VGGT-1B")


def test_what_the_hub_refuses_is_one_line(monkeypatch):
    """The client's long answer must become one line that says what to fetch."""

    def refuse(*_):
        raise RuntimeError("Repository Not Found.\nMake sure that you are logged in.")

    fake_client(monkeypatch, download=refuse)
    with pytest.raises(InputError, match=r"found: Repository Not Found\.") as caught:
        importing.fetch("facebook/VGGT-1B")
    text = str(caught.value)
    assert f"Download {ADDRESS} by hand and set vggt=<that file>" in text
    assert "\n" not in text


def test_without_the_package_it_names_the_extra(monkeypatch):
    """Without the optional package the user needs its name."""
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"the package huggingface_hub \(pip install 'ghgs-lit\[hub\]'"):
        importing.fetch("facebook/VGGT-1B")
