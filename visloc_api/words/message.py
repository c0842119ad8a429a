"""Requests, for the service that checks them and the clients that write them.

Names and types are checked; errors have the codes of this API.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticCustomError

from visloc.errors import InvalidInput, VislocError, placed, refuse
from visloc_api.words.json_text import MAX_NAME, check_json_values, check_names, utf8_json

T = TypeVar("T")

_NOT_AN_OBJECT, _UNKNOWN_FIELD, _REFUSED = "not_an_object", "unknown_field", "refused"
# A message of many small values takes many times its size, and its time, when it is parsed: so they
# are counted before. One photo needs a few dozen, and the names of all tiles of a set: 10 000.
MAX_JSON_VALUES = 11_000
# A rig of 256 cameras and the images of one instant need 25 000 at the most.
MAX_INSTANT_VALUES = 100_000


if TYPE_CHECKING:  # a type checker shall see the fields
    _Made = BaseModel
else:

    class _Making(type(BaseModel)):
        """Lets messages that are made in Python raise as ``IncomingMessage.read``.

        Not an ``__init__``: pydantic would call it for messages within messages too, and lose
        their place and limits.
        """

        def __call__(cls, **given: Any) -> Any:
            return cls._checked(lambda: super(_Making, cls).__call__(**given))

    class _Made(BaseModel, metaclass=_Making):
        pass


class IncomingMessage(_Made):
    """A request, or a part of one. Unknown fields are refused by name.

    null is as if a field that may be left out were: clients that write all fields write it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)
    # Where this message sits in the request, for errors of what is read on its own.
    path: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _check_names(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            expected = f"an object with {', '.join(cls.model_fields)}"
            raise PydanticCustomError(_NOT_AN_OBJECT, "not an object", {"expected": expected})
        for name in value:
            if name not in cls.model_fields:
                expected = f"one of {', '.join(cls.model_fields)}"
                raise PydanticCustomError(
                    _UNKNOWN_FIELD, "unknown field", {"name": str(name), "expected": expected}
                )
        fields = cls.model_fields
        return {k: v for k, v in value.items() if v is not None or fields[k].is_required()}

    @classmethod
    def read(cls, value: object, limits: object = None) -> Self:
        """Check a message made of Python values.

        Args:
            limits: on counts, for the fields that ask for them.
        """
        return cls._checked(lambda: cls.model_validate(value, context=limits))

    @classmethod
    def read_json(
        cls, text: str | bytes, limits: object = None, max_values: int = MAX_JSON_VALUES
    ) -> Self:
        """Check a message written as JSON.

        Args:
            max_values: how many values it may have. They are counted by commas and brackets, those
                in texts too.
        """
        text = utf8_json(text)
        check_json_values(text, max_values, cls.path.rstrip("."))
        checked = cls._checked(lambda: cls.model_validate_json(text, context=limits))
        check_names(text)  # pydantic takes the last one
        return checked

    def given(self) -> dict[str, Any]:
        """Return the fields that were given, as JSON has them, but bytes as they are."""
        return self.model_dump(exclude_unset=True, exclude_none=True)

    def as_json(self) -> dict[str, Any]:
        """Return the fields that were given as JSON has them, bytes in base64."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    @classmethod
    def _checked(cls, validate: Callable[[], T]) -> T:
        try:
            return validate()
        except ValidationError as refused:
            refusal = refusal_of(refused.errors(include_url=False)[0], cls.path)
        # Out of there, so that it does not hold what it comes from: pydantic's errors hold all
        # that was sent. Nor may it and this frame hold each other.
        try:
            raise refusal
        finally:
            del refusal


def converted(convert: Callable[[Any], Any]) -> BeforeValidator:
    """Apply ``convert`` to a field before pydantic sees it; its errors keep their codes.

    Their fields get the place of the message: ``camera.width`` of the second image becomes
    ``images[1].camera.width``.
    """

    def validate(value: Any) -> Any:
        try:
            return convert(value)
        except InvalidInput as error:
            raise _located(error) from None

    return BeforeValidator(validate)


def counted(check: Callable[[Any, Any], None]) -> BeforeValidator:
    """Call ``check`` with a field and the limits of ``read`` before its parts are validated."""

    def validate(value: Any, info: ValidationInfo) -> Any:
        try:
            check(value, info.context)
        except InvalidInput as error:
            raise _located(error) from None
        return value

    return BeforeValidator(validate)


def _located(error: InvalidInput) -> PydanticCustomError:
    return PydanticCustomError(_REFUSED, "refused", {"error": error})


def refusal_of(complaint: Mapping[str, Any], path: str = "") -> VislocError:
    """Translate one of pydantic's errors. Never echoes a large value."""
    kind, message, location = complaint["type"], complaint["msg"], complaint["loc"]
    if kind == _REFUSED:
        return placed(complaint["ctx"]["error"], (path + _joined(location[:-1])).rstrip("."))
    if kind == _UNKNOWN_FIELD:
        name, expected = complaint["ctx"]["name"], complaint["ctx"]["expected"]
        field = path + _joined([*location, name])
        return refuse("request.unknown_field", message, field=field, expected=expected, got=name)
    field = path + _joined(location) if location else path.rstrip(".")
    got = complaint["input"]
    if kind == _NOT_AN_OBJECT:
        expected, got = complaint["ctx"]["expected"], type(got).__name__
        return refuse("request.invalid", message, field=field or None, expected=expected, got=got)
    if kind == "json_invalid":
        return refuse("request.malformed", message, field=field or None, expected="JSON")
    if kind == "missing":
        return refuse("request.missing_field", field=field)
    got = got if isinstance(got, str | int | float | None) else type(got).__name__
    return refuse("request.invalid", field=field, expected=message, got=got)


def _joined(location: Sequence[str | int]) -> str:
    """Write a place in a message as ``instants[3].images[0].camera``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part[:MAX_NAME]}"
    return text.removeprefix(".")
