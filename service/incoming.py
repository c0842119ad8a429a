"""Messages from outside: checked by name and type, refused in our words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from visloc.errors import InvalidInput

_NOT_AN_OBJECT, _UNKNOWN_FIELD = "not_an_object", "unknown_field"
_MAX_NAME = 100  # characters of a name from outside


class IncomingMessage(BaseModel):
    """A message from outside: unknown fields are refused by name."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
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
        return value

    @classmethod
    def read(cls, value: object) -> Self:
        """Check a message made of Python values.

        Raises:
            InvalidInput: ``request.missing_field``, ``request.unknown_field``,
                ``request.invalid``, or a code of the field.
        """
        try:
            return cls.model_validate(value)
        except ValidationError as refused:
            raise invalid_input(refused.errors(include_url=False)[0], cls.path) from None

    @classmethod
    def read_json(cls, text: str | bytes) -> Self:
        """Check a message written as JSON.

        Raises:
            InvalidInput: as ``read``, and ``request.malformed``.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as refused:
            raise invalid_input(refused.errors(include_url=False)[0], cls.path) from None


def invalid_input(complaint: Mapping[str, Any], path: str = "") -> InvalidInput:
    """Say one of pydantic's complaints in our words. Never echoes a large value."""
    kind, message = complaint["type"], complaint["msg"]
    parts = [str(part)[:_MAX_NAME] for part in complaint["loc"]]
    if kind == _UNKNOWN_FIELD:
        name, expected = complaint["ctx"]["name"], complaint["ctx"]["expected"]
        field = path + ".".join([*parts, name[:_MAX_NAME]])
        return InvalidInput(
            "request.unknown_field", message, field=field, expected=expected, got=name
        )
    field = path + ".".join(parts) if parts else path.rstrip(".")
    got = complaint["input"]
    if kind == _NOT_AN_OBJECT:
        expected, got = complaint["ctx"]["expected"], type(got).__name__
        return InvalidInput(
            "request.invalid", message, field=field or None, expected=expected, got=got
        )
    if kind == "json_invalid":
        return InvalidInput("request.malformed", message, field=field or None, expected="JSON")
    if kind == "missing":
        return InvalidInput("request.missing_field", "this field is needed", field=field)
    got = got if isinstance(got, str | int | float | None) else type(got).__name__
    return InvalidInput("request.invalid", "cannot be used", field=field, expected=message, got=got)
