"""Types of options in words: for messages and for ``--help``."""

import ast
import inspect
import itertools
import textwrap
import types
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

_NOUNS = {
    type(None): "null",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    tuple: "a list",
    dict: "a mapping",
}
_LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


@dataclass(frozen=True)
class Words:
    """Metadata of a type: what messages call it."""

    text: str


def expected(field: FieldInfo) -> str:
    """What a value of ``field`` must be, such as "an integer >= 1 or null"."""
    return _words(field.annotation, field.metadata)


def options_of(annotation: Any) -> type[BaseModel] | None:
    """The class of options that an annotation allows (perhaps beside None), None where there is none."""
    for choice in (annotation, *get_args(annotation)):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            return choice
    return None


def meanings(cls: type) -> dict[str, str]:
    """The text below each field of a class and of its bases."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not (issubclass(base, BaseModel) and inspect.get_annotations(base)):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body
        for field, text in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                texts[field.target.id] = inspect.cleandoc(ast.literal_eval(text.value))
    return texts


def _flat(metadata: Iterable[Any]) -> list[Any]:
    """Metadata of a type; those of pydantic's ``Field`` lie one level deeper."""
    return [part for item in metadata for part in (item.metadata if isinstance(item, FieldInfo) else [item])]


def _words(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    metadata = _flat(metadata)
    if get_origin(annotation) is Annotated:
        inner, *further = get_args(annotation)
        return _words(inner, [*metadata, *further])
    for item in metadata:
        if isinstance(item, Words):
            return item.text
    origin, args = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(_words(arg, () if arg is type(None) else metadata) for arg in args)
    if origin is Literal:
        return "one of " * (len(args) > 1) + ", ".join(map(str, args))
    if origin is tuple:
        if len(args) == 2 and args[1] is Ellipsis:
            return f"a list (each {_words(args[0])})"
        return f"a list of {len(args)} values (each {_words(args[0])})"
    if origin is dict:
        return f"a mapping (each {_words(args[1])})"
    if options_of(annotation) is not None:
        return "a mapping of its keys"
    limits = {name: getattr(item, name) for item in metadata for name in _LIMITS if hasattr(item, name)}
    words = " and ".join(f"{sign} {limits[name]}" for name, sign in _LIMITS.items() if name in limits)
    noun = _NOUNS.get(annotation) or f"a {annotation.__name__}"
    return f"{noun} {words}".strip()
