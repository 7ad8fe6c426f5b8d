"""Options: classes of typed fields that configure a stage, defined once next to it.

A field has a type with a range, a default and, in the text below it, a meaning with its unit. Values are
validated whatever their source (YAML, command line, checkpoint, Python); ``ghgs <verb> --help <group>``
prints the fields.
"""

import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from omegaconf import OmegaConf
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from ghgs_lit.errors import InputError, format_value, require

#: Words for the types of JSON schemas.
_NOUNS = {
    "null": "null", "boolean": "true or false", "integer": "an integer", "number": "a number",
    "string": "a text", "array": "a list", "object": "a mapping",
}  # fmt: skip
_LIMITS = {
    "minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<",
    "multipleOf": "a multiple of",
}  # fmt: skip


def name_type(text: str) -> WithJsonSchema:
    """Metadata of a type: its description in messages and help."""
    return WithJsonSchema({"type": text})


def describe_field(cls: type[BaseModel], name: str) -> str:
    """Describe the values that a field of a class accepts, such as "an integer >= 1 or null"."""
    return _describe(cls.model_json_schema()["properties"][name])


def options_of(annotation: Any) -> type[BaseModel] | None:
    """Options class that an annotation allows (alone or with None), or None."""
    for choice in (annotation, *get_args(annotation)):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            return choice
    return None


def meaning_of(cls: type[BaseModel], name: str) -> str:
    """Text below a field of a class, or below the field of a base that it overrides."""
    bases = [base for base in cls.__mro__ if name in getattr(base, "model_fields", ())]
    return next((text for base in bases if (text := base.model_fields[name].description)), "")


def _describe(schema: Mapping[str, Any]) -> str:
    """Words for a JSON schema."""
    if "anyOf" in schema:
        return " or ".join(map(_describe, schema["anyOf"]))
    if "const" in schema:
        return str(schema["const"])
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    words = [_NOUNS.get(schema.get("type"), schema.get("type", "a mapping of its keys"))]
    limits = [f"{sign} {schema[name]}" for name, sign in _LIMITS.items() if name in schema]
    words += [" and ".join(limits)] * bool(limits)
    items = schema.get("prefixItems")
    if items:
        words.append(f"of {len(items)} values")
    item = items[0] if items else schema.get("items") or schema.get("additionalProperties")
    if isinstance(item, dict):
        words.append(f"(each {_describe(item)})")
    return " ".join(words)


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
    str, Field(min_length=1), BeforeValidator(_to_text), AfterValidator(_check_home), name_type("a path")
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
        use_attribute_docstrings=True,
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


def _input_error(cls: type[Options], key: str, values: Any, error: ValidationError) -> InputError:
    """First of pydantic's errors as one line with its key; unknown keys come first, because a misspelt
    key may leave another one missing."""
    errors = error.errors(include_url=False)
    first = next((each for each in errors if each["type"] == "extra_forbidden"), errors[0])
    path = [key] if key else []
    wanted = first["msg"]
    nested = cls
    for name in first["loc"]:
        if nested is None:
            break
        if isinstance(name, int):  # index in a list of options
            values = values[name]
            continue
        cls = nested
        if name not in cls.model_fields:
            break
        path.append(name)
        wanted = describe_field(cls, name)
        values = dict(values).get(name)
        nested = options_of(cls.model_fields[name].annotation)
    dotted = ".".join(path)
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, InputError):  # raised by a validator of several fields
        return InputError(f"{dotted}.{cause}" if dotted else str(cause))
    if first["type"] == "extra_forbidden":
        name = first["loc"][-1]
        known = ", ".join(sorted(cls.model_fields))
        expected = f"one of {known}" if known else "no keys"
        hint = did_you_mean(name, cls.model_fields)
        return InputError(f"{'.'.join([*path, name])}: expected {expected}; found {name!r}{hint}")
    if first["type"] == "missing" and first["loc"][-1] == path[-1]:
        return InputError(f"{dotted}: expected a value; found none")
    return InputError(f"{dotted}: expected {cause or wanted}; found {format_value(_to_plain(values))}")


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
