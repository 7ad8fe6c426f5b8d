"""Check annotated shapes (jaxtyping with beartype) in the first calls of each function in each test.

The checks of a tiny model take longer than the model, and the arguments of a function hardly differ
between calls in one test.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from types import CodeType

import jaxtyping

#: Number of checked calls of each function in a test.
CALLS = 5

_jaxtyped = jaxtyping.jaxtyped
_test = 0
_calls: dict[CodeType, tuple[int, int]] = {}  # last test that called it, and number of calls


def begin_test() -> int:
    """Check the next calls of all functions; return the number of the test in this process."""
    global _test
    _test += 1
    return _test


def check_shapes(modules: Sequence[str]) -> None:
    """Check calls of functions and classes in these modules, if imported from now on."""
    jaxtyping.jaxtyped = _jaxtyped_at_first
    jaxtyping.install_import_hook(modules, "beartype.beartype")


def _jaxtyped_at_first(*, typechecker: Callable) -> Callable:
    check = _jaxtyped(typechecker=typechecker)

    def decorate(subject):
        if not inspect.isfunction(subject):
            return check(subject)
        code = subject.__code__  # equal for all closures of one definition
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
