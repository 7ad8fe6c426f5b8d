"""Options: classes of typed fields that configure a stage, defined once next to it.

A field has a type with a range, a default and, in the text below it, a meaning with its unit. Values are
validated whatever their source (YAML, command line, checkpoint, Python); ``ghgs <verb> --help <group>``
prints the fields.
"""

import ast
import difflib
import inspect
import itertools
import os
import re
import textwrap
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin

from omegaconf import OmegaConf
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo

from ghgs_lit.errors import InputError, format_value, require

_NOUNS = {type(None): "null", bool: "true or false", int: "an integer", float: "a number"}
_NOUNS |= {str: "a text", tuple: "a list", dict: "a mapping"}
_LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "multiple_of": "a multiple of"}


@dataclass(frozen=True)
class Words:
    """Metadata of a type: its description in messages."""

    text: str


def describe_field(field: FieldInfo) -> str:
    """Describe the values that ``field`` accepts, such as "an integer >= 1 or null"."""
    return _describe_type(field.annotation, field.metadata)


def options_of(annotation: Any) -> type[BaseModel] | None:
    """Options class that an annotation allows (alone or with None), or None."""
    for choice in (annotation, *get_args(annotation)):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            return choice
    return None


def meanings(cls: type) -> dict[str, str]:
    """Text below each field of a class and its bases."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not (issubclass(base, BaseModel) and inspect.get_annotations(base)):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body
        for field, text in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                texts[field.target.id] = inspect.cleandoc(ast.literal_eval(text.value))
    return texts


def _flatten_metadata(metadata: Iterable[Any]) -> list[Any]:
    """Metadata of a type, including those inside pydantic's ``Field``."""
    return [part for item in metadata for part in (item.metadata if isinstance(item, FieldInfo) else [item])]


def _describe_type(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    metadata = _flatten_metadata(metadata)
    if get_origin(annotation) is Annotated:
        inner, *further = get_args(annotation)
        return _describe_type(inner, [*metadata, *further])
    for item in metadata:
        if isinstance(item, Words):
            return item.text
    origin = get_origin(annotation)
    args = get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe_type(arg, () if arg is type(None) else metadata) for arg in args)
    if origin is Literal:
        return "one of " * (len(args) > 1) + ", ".join(map(str, args))
    if origin is tuple:
        if len(args) == 2 and args[1] is Ellipsis:
            return f"a list (each {_describe_type(args[0])})"
        return f"a list of {len(args)} values (each {_describe_type(args[0])})"
    if origin is dict:
        return f"a mapping (each {_describe_type(args[1])})"
    if options_of(annotation) is not None:
        return "a mapping of its keys"
    limits = {name: getattr(item, name) for item in metadata for name in _LIMITS if hasattr(item, name)}
    words = " and ".join(f"{sign} {limits[name]}" for name, sign in _LIMITS.items() if name in limits)
    noun = _NOUNS.get(annotation) or f"a {annotation.__name__}"
    return f"{noun} {words}".strip()


_T = TypeVar("_T", bound="Options")


def _to_text(value: Any) -> Any:
    """Convert a path or an integer, such as the name ``100846``, to text; floats such as 2024.10 have
    lost their spelling and are rejected."""
    if isinstance(value, float):
        raise ValueError("a text (in quotes where it spells a number: '\"2024.10\"')")
    is_number = isinstance(value, int) and not isinstance(value, bool)
    return str(value) if is_number else os.fspath(value) if isinstance(value, os.PathLike) else value


def _check_home(path: str) -> str:
    if os.path.expanduser(path).startswith("~"):
        raise ValueError("a path, after ~ nothing or a user of this machine")
    return path


def _to_pair(size: int | tuple[int, int]) -> tuple[int, int]:
    return (size, size) if isinstance(size, int) else size


Text = Annotated[str, Field(min_length=1), BeforeValidator(_to_text)]
PathText = Annotated[
    str, Field(min_length=1), BeforeValidator(_to_text), AfterValidator(_check_home), Words("a path")
]
Count = Annotated[int, Field(ge=1)]
Index = Annotated[int, Field(ge=0)]
Amount = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Workers = Annotated[int, Field(ge=0, le=1024)]
Width = Annotated[int, Field(ge=1, le=65536)]
#: Number of patches, at most the number of pixels along the longest side.
Patches = Annotated[int, Field(ge=0, le=8192)]
# A larger image would take gigabytes before any check could reject it.
Side = Annotated[int, Field(ge=1, le=8192)]
#: Side or [height, width] in pixels; read as (height, width).
Size = Annotated[Side | tuple[Side, Side], AfterValidator(_to_pair)]
CropSide = Annotated[int, Field(ge=1, le=2072)]
#: The same for crops, the input of the model.
CropSize = Annotated[CropSide | tuple[CropSide, CropSide], AfterValidator(_to_pair)]


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """`` (did you mean ...?)`` with the closest known name, or an empty string."""
    close = difflib.get_close_matches(name if isinstance(name, str) else format_value(name), list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""


class UnknownKey(InputError):
    """Options have no field of this name.

    Attributes:
        key: Dotted key that was given.
    """

    def __init__(self, message: str, key: str):
        super().__init__(message)
        self.key = key


class _Checked(type(BaseModel)):
    """Metaclass that raises :class:`InputError` also for options created in Python."""

    def __call__(cls, *args: Any, **values: Any) -> Any:
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            raise _input_error(cls, cls.group, values, error) from None


class Options(BaseModel, metaclass=_Checked):
    """Base of all options: immutable, without unknown fields or silent conversions.

    Attributes:
        group: Dotted key of the options in configurations, for messages.

    Raises:
        InputError: "<key>: expected ...; found ...", for the first wrong value.
    """

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        validate_default=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )
    group: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _normalize(cls, values: Any) -> Any:
        """Convert lists to tuples; a mapping given for a field whose default is options changes only its
        keys."""
        if not isinstance(values, dict):
            return values
        given = _make_immutable(values)
        for name, value in given.items():
            default = cls.model_fields[name].default if name in cls.model_fields else None
            if isinstance(value, dict) and isinstance(default, Options):
                given[name] = {**dict(default), **value}
            elif isinstance(value, str) and re.fullmatch(r"[+-]?\d[\d_]*", value):
                words = describe_field(cls.model_fields[name]) if name in cls.model_fields else ""
                given[name] = value if re.search("text|path|mapping", words) else int(value)
        return given

    @classmethod
    def read(cls: type[_T], values: Any, key: str) -> _T:
        """Create options from a mapping; missing keys have their default.

        Args:
            values: A mapping, an OmegaConf node, or options of this class, which are returned.
            key: Dotted key of the mapping; empty: the whole configuration.

        Raises:
            InputError: The message contains the first wrong key below ``key``, what was expected and what
                was found.
        """
        if isinstance(values, cls):
            return values
        if OmegaConf.is_config(values):
            values = OmegaConf.to_container(values, resolve=True)
        if not isinstance(values, Mapping):
            raise InputError(f"{key}: expected a mapping of its keys; found {format_value(values)}")
        try:
            return cls.model_validate(dict(values))
        except ValidationError as error:
            raise _input_error(cls, key, values, error) from None

    def replace(self: _T, **changes: Any) -> _T:
        """Return a copy with some fields changed; the result is validated.

        Raises:
            InputError: See :class:`Options`.
        """
        return type(self)(**{**dict(self), **changes})

    def require(self, condition: bool, name: str, expected: str) -> None:
        """Reject the value of a field unless a condition holds; for use in a ``model_validator``.

        Args:
            condition: Whether the value is valid.
            name: Name of the field.
            expected: Description of valid values.

        Raises:
            InputError: "<name>: expected <expected>; found ...".
        """
        if not condition:
            raise InputError(
                f"{name}: expected {expected}; found {format_value(_to_plain(getattr(self, name)))}"
            )

    def build(self) -> Any:
        """Build the object that the options describe; by default the options themselves."""
        return self


def _make_immutable(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_make_immutable, value))
    return {key: _make_immutable(item) for key, item in value.items()} if isinstance(value, dict) else value


def _to_plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(map(_to_plain, value))
    return {key: _to_plain(item) for key, item in value.items()} if isinstance(value, dict) else value


def _input_error(cls: type[Options], key: str, values: Mapping, error: ValidationError) -> InputError:
    """First of pydantic's errors as one line with its key; unknown keys come first, because a misspelt
    key may leave another one missing."""
    errors = error.errors(include_url=False)
    first = next((each for each in errors if each["type"] == "extra_forbidden"), errors[0])
    cause = first.get("ctx", {}).get("error")
    path = [key] if key else []
    field = None
    nested = cls
    for name in first["loc"]:
        if nested is None or not isinstance(values, Mapping | list | tuple):
            break
        if isinstance(name, int):  # index in a list of options
            values = values[name]
            continue
        cls = nested
        if name not in cls.model_fields:
            break
        field = cls.model_fields[name]
        path.append(name)
        values = values.get(name)
        nested = options_of(field.annotation)
    dotted = ".".join(path)
    if isinstance(cause, InputError):  # raised by a validator of several fields
        return InputError(f"{dotted}.{cause}" if dotted else str(cause))
    if first["type"] == "extra_forbidden":
        name = first["loc"][-1]
        known = list(cls.model_fields)
        choices = f"one of {', '.join(sorted(known))}" if known else "no keys"
        text = f"expected {choices}; found {name!r}{did_you_mean(name, known)}"
        return UnknownKey(f"{dotted} key: {text}" if dotted else f"{name}: {text}", ".".join([*path, name]))
    if first["type"] == "missing" and first["loc"][-1] in cls.model_fields:
        return InputError(f"{dotted}: expected a value; found none")
    wanted = str(cause) if cause is not None else describe_field(field) if field is not None else first["msg"]
    return InputError(f"{dotted}: expected {wanted}; found {format_value(_to_plain(values))}")


def image_size(key: str, size: int | Sequence[int]) -> tuple[int, int]:
    """Image size (height, width) in pixels from a side or a pair.

    Args:
        key: Dotted key, for the message.
        size: Side of a square, or [height, width]; at least 1.

    Raises:
        InputError: ``size`` is neither.
    """
    pair = (size, size) if isinstance(size, int) else tuple(size)
    valid = len(pair) == 2 and all(isinstance(side, int) and side >= 1 for side in pair)
    require(valid, key, "a side or [height, width] in pixels", size)
    return pair
