"""Annotated shapes are checked (jaxtyping with beartype) in the first calls of each
function in each test.

The checks of a tiny model take longer than the model; what a function is called with in one test
differs little from call to call.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from types import CodeType

import jaxtyping

#: Calls of each function that a test checks.
CALLS = 5

_jaxtyped = jaxtyping.jaxtyped
_test = 0
_calls: dict[CodeType, tuple[int, int]] = {}  # the last test that called it, and how often


def begin_test() -> int:
    """Check the next calls of all functions. Returns: the number of the test in this process."""
    global _test
    _test += 1
    return _test


def check_shapes(modules: Sequence[str]) -> None:
    """Check calls of what these modules define, when they are imported from now on."""
    jaxtyping.jaxtyped = _jaxtyped_at_first
    jaxtyping.install_import_hook(modules, "beartype.beartype")


def _jaxtyped_at_first(*, typechecker: Callable) -> Callable:
    check = _jaxtyped(typechecker=typechecker)

    def decorate(subject):
        if not inspect.isfunction(subject):
            return check(subject)
        code = subject.__code__  # the same each time that a function within another is defined
        checked = None

        @functools.wraps(subject)
        def call(*args, **kwargs):
            __tracebackhide__ = True
            nonlocal checked
            test, calls = _calls.get(code, (_test, 0))
            calls = calls if test == _test else 0
            if calls == CALLS:
                return subject(*args, **kwargs)
            _calls[code] = _test, calls + 1
            checked = checked or check(subject)
            return checked(*args, **kwargs)

        return call

    return decorate
