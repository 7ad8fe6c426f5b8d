"""Pickles of data sets: arrays and plain containers are read, anything else is rejected without being
called."""

import collections
import os
import pickle

import numpy as np
import pytest
from trimesh.caching import TrackedArray

from ghgs_lit.data.pickles import load_npy, load_pickle
from ghgs_lit.errors import InputError
from tests.helpers.captures import refused

CONTENT = {
    "float32": np.arange(6, dtype=np.float32).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "empty": np.zeros((0, 3)),
    "bool": np.array([True, False]),
    "names": np.array(["a", "bc"]),
    "objects": np.array([{"x": 1}, None], dtype=object),
    "scalar": np.float32(1.5),
    "plain": [1, 2.5, "text", b"bytes", None, True, (1, 2), {3}, frozenset({4}), 1j, bytearray(b"x")],
    "ordered": collections.OrderedDict(a=1),
}


WHOLE = pickle.dumps(CONTENT)


class Call:
    """Object whose pickle calls a function when loaded."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call[0], tuple(self.call[1:])


def equal(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return type(b) is np.ndarray and a.dtype == b.dtype and np.array_equal(a, b)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers_come_through(tmp_path, protocol):
    """Everything that data sets contain is read, in each pickle protocol."""
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(CONTENT, protocol=protocol))
    found = load_pickle(path)
    assert found.keys() == CONTENT.keys()
    for key, value in CONTENT.items():
        assert equal(value, found[key]), key


@pytest.mark.parametrize("core", ["core", "_core"])
def test_names_of_both_numpys(tmp_path, core):
    """Files written by NumPy 1 and 2 are both read."""
    data = pickle.dumps({"a": np.arange(3.0), "b": np.float64(2)}, protocol=2)
    for name in (b"numpy._core.multiarray", b"numpy.core.multiarray"):
        data = data.replace(name, f"numpy.{core}.multiarray".encode())
    path = tmp_path / "a.pkl"
    path.write_bytes(data)
    assert load_pickle(path)["a"].tolist() == [0, 1, 2]


def test_python_2s_strings_and_builtins(tmp_path):
    """Files written by Python 2, such as ZJU-MoCap's, are read."""
    path = tmp_path / "a.pkl"
    # Written by cPickle.dump({'poses': set([1.0])}, protocol=2) of Python 2.
    path.write_bytes(b"\x80\x02}U\x05posesc__builtin__\nset\n]G?\xf0\x00\x00\x00\x00\x00\x00a\x85Rs.")
    assert load_pickle(path) == {"poses": {1.0}}


@pytest.mark.parametrize("module", ["trimesh.caching", "trimesh.util"])
def test_trimeshs_arrays_are_arrays(tmp_path, module):
    """THuman2.0's fits contain trimesh's array class, under either of its names."""
    path = tmp_path / "a.pkl"
    data = pickle.dumps({"translation": np.ones(3, np.float32).view(TrackedArray)}, protocol=2)
    assert b"trimesh.caching\nTrackedArray" in data
    path.write_bytes(data.replace(b"trimesh.caching\n", module.encode() + b"\n"))
    translation = load_pickle(path)["translation"]
    assert type(translation) is np.ndarray
    assert translation.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("call", "name"),
    [
        ((os.system, "touch {path}"), "posix.system"),
        ((eval, "open('{path}', 'w')"), "builtins.eval"),
        ((getattr, "x", "upper"), "builtins.getattr"),
        ((np.load, "{path}"), "numpy.load"),
        ((collections.Counter, "aab"), "collections.Counter"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_anything_else_is_refused_by_its_name_and_not_called(tmp_path, call, name, protocol):
    """A malicious pickle runs no code, whatever names it contains."""
    mark = tmp_path / "called"
    function, *arguments = call
    bad = Call(function, *(a.format(path=mark) for a in arguments))
    path = tmp_path / "bad.pkl"
    for content in (bad, {"a": [bad]}, np.array([bad], dtype=object)):
        path.write_bytes(pickle.dumps(content, protocol=protocol))
        with pytest.raises(
            InputError, match=r"bad\.pkl: expected a pickle of NumPy arrays and plain"
        ) as caught:
            load_pickle(path)
        assert str(caught.value).split("found ")[1].replace("__builtin__", "builtins") in (
            name,
            name.replace("numpy", "numpy.lib._npyio_impl"),
        )
    assert not mark.exists()


def test_no_codec_but_the_one_that_bytes_need(tmp_path):
    """The admitted function cannot be used for other codecs."""
    path = tmp_path / "a.pkl"
    # _codecs.encode('uryyb', 'rot13')
    path.write_bytes(b"\x80\x02c_codecs\nencode\nX\x05\x00\x00\x00uryybX\x05\x00\x00\x00rot13\x86R.")
    refused(r"found UnpicklingError.*rot13", lambda: load_pickle(path))


BROKEN_NPY = (b"\x93NUMPY", b"\x93NUMPY\x01\x00\x05\x00hello")
BROKEN = [
    *((load_pickle, data, "a readable pickle; found") for data in (b"no pickle", WHOLE[:50], WHOLE[:-1])),
    *((load_npy, data, r"a readable \.npy file; found") for data in (b"text", *BROKEN_NPY)),
    (load_pickle, b"", "a readable pickle; found"),
    (load_npy, b"", r"a readable \.npy file; found"),
    (load_pickle, None, "a pickle; found no such file"),
    (load_npy, None, r"an \.npy file; found no such file"),
]


@pytest.mark.parametrize(("load", "data", "line"), BROKEN)
def test_broken_files_are_named(tmp_path, load, data, line):
    """A missing, truncated or foreign file is named."""
    path = tmp_path / "a.pkl"
    if data is not None:
        path.write_bytes(data)
    refused(rf"a\.pkl: expected {line}", lambda: load(path))


@pytest.mark.parametrize(
    "content",
    [np.arange(3), {"cams": {"K": [1.5]}}, np.array([{"a": 1}, None], dtype=object)],
    ids=["array", "dictionary, as of ZJU-MoCap", "objects"],
)
def test_npy_files(tmp_path, content):
    """Plain and pickled .npy files are read with the same restrictions."""
    np.save(tmp_path / "a.npy", content)
    assert equal(content, load_npy(tmp_path / "a.npy"))


def test_a_malicious_npy_file_runs_nothing(tmp_path):
    np.save(tmp_path / "a.npy", {"a": Call(os.system, f"touch {tmp_path}/called")})
    line = r"a\.npy: expected a pickle of NumPy arrays .*; found posix\.system"
    refused(line, lambda: load_npy(tmp_path / "a.npy"))
    assert not (tmp_path / "called").exists()
