"""Compilation says that it takes time, once."""

import numba
from numba.core import event

from ghgs_lit.kernels.compile import FirstCompilation


def test_the_first_compilation_says_so(capsys, monkeypatch):
    """A first prediction that compiles for a minute must not look as if it hung; workers say nothing."""
    numba.njit(lambda x: x)(1)  # the listener of this process has spoken
    capsys.readouterr()
    with event.install_listener("numba:compile", FirstCompilation()):
        for number in range(2):
            numba.njit(lambda x, y=number: x + y)(1)
    assert capsys.readouterr().err.count("compiling kernels for this processor") == 1
    monkeypatch.setattr(FirstCompilation, "is_said", True)  # as in the processes of a pool
    with event.install_listener("numba:compile", FirstCompilation()):
        numba.njit(lambda x: x - 1)(1)
    assert "compiling" not in capsys.readouterr().err
