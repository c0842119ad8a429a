"""The base of all answers: models that hold NumPy arrays and poses, and send numbers."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetCoreSchemaHandler,
    PlainSerializer,
    ValidationError,
)
from pydantic.json_schema import WithJsonSchema
from pydantic_core import CoreSchema, core_schema

_NUMBERS = WithJsonSchema({"type": "array", "items": {"type": "number"}})


class Answer(BaseModel):
    """A part of an answer. Fields that a newer server adds are passed over."""

    # Built when first used: importing the clients shall not take the time.
    model_config = ConfigDict(
        frozen=True, arbitrary_types_allowed=True, defer_build=True, from_attributes=True
    )


class AnswerWithArrays(Answer):
    """An answer that equals only itself: it holds arrays, or is what a caller waited for."""

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)


@dataclass(frozen=True)
class SentAs:
    """Hold a value of the core, which is sent as a model of the API's words.

    Attributes:
        read: makes the value of received JSON; may raise what indexing and ``float`` raise.
        write: makes the model of a value.
    """

    model: type[BaseModel]
    kind: type
    read: Callable[[Any], Any]
    write: Callable[[Any], BaseModel]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return how pydantic reads and writes it."""
        del source

        def validate(value: Any) -> Any:
            return value if isinstance(value, self.kind) else self.read(value)

        return core_schema.no_info_plain_validator_function(
            validate,
            serialization=core_schema.plain_serializer_function_ser_schema(
                self.write, return_schema=handler.generate_schema(self.model)
            ),
        )


@dataclass(frozen=True)
class OneOf:
    """Describe the words of today, and read any text: a newer server knows more.

    Attributes:
        words: an enumeration of texts, or a Literal.
    """

    words: Any

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return how pydantic reads it."""
        del source

        def validate(value: Any, known: Callable[[Any], Any]) -> Any:
            try:
                return known(value)
            except ValidationError:
                if isinstance(value, str):
                    return value
                raise

        return core_schema.no_info_wrap_validator_function(
            validate, handler.generate_schema(self.words)
        )


def _array(*shape: int) -> BeforeValidator:
    def read(value: Any) -> NDArray[np.float64]:
        if isinstance(value, np.ndarray):
            return value
        return np.array([float(each) for each in value]).reshape(shape)

    return BeforeValidator(read)


def _covariance(value: Any) -> NDArray[np.float64]:
    """Take an array as it is, and check numbers that were received."""
    if isinstance(value, np.ndarray):
        return value
    covariance = np.array([float(each) for each in value]).reshape(6, 6)
    if not np.isfinite(covariance).all():
        raise ValueError("a covariance that is not finite")
    least, *_, largest = np.linalg.eigvalsh(covariance)
    if least < -1e-9 * largest or not np.allclose(covariance, covariance.T, rtol=1e-6):
        raise ValueError("a covariance that is none")
    return covariance


def _in_a_row(array: NDArray[Any]) -> list[Any]:
    values: list[Any] = array.ravel().tolist()
    return values


def _optional_covariance(value: Any) -> NDArray[np.float64] | None:
    """As ``_covariance``; empty when there is none, because gRPC has no list that is null."""
    return None if value is None or len(value) == 0 else _covariance(value)


def _in_a_row_or_empty(array: NDArray[Any] | None) -> list[Any]:
    return [] if array is None else _in_a_row(array)


_AS_NUMBERS = PlainSerializer(_in_a_row, return_type=list[float])
_AS_NUMBERS_OR_EMPTY = PlainSerializer(_in_a_row_or_empty, return_type=list[float])

Numbers3 = Annotated[NDArray[np.float64], _array(3), _AS_NUMBERS, _NUMBERS]
Numbers4 = Annotated[NDArray[np.float64], _array(4), _AS_NUMBERS, _NUMBERS]
NumbersNx2 = Annotated[NDArray[np.float64], _array(-1, 2), _AS_NUMBERS, _NUMBERS]
NumbersNx3 = Annotated[NDArray[np.float64], _array(-1, 3), _AS_NUMBERS, _NUMBERS]
Covariance = Annotated[NDArray[np.float64], BeforeValidator(_covariance), _AS_NUMBERS, _NUMBERS]
OptionalCovariance = Annotated[
    NDArray[np.float64] | None, BeforeValidator(_optional_covariance), _AS_NUMBERS_OR_EMPTY
]
Flags = Annotated[
    NDArray[np.bool_],
    BeforeValidator(lambda value: np.array(value, dtype=np.bool_)),
    PlainSerializer(_in_a_row, return_type=list[bool]),
    WithJsonSchema({"type": "array", "items": {"type": "boolean"}}),
]


def _from_base64(value: Any) -> Any:
    return base64.b64decode(value, validate=True) if isinstance(value, str) else value


AS_BASE64 = PlainSerializer(
    lambda data: base64.b64encode(data).decode(), when_used="json-unless-none"
)
Base64 = Annotated[
    bytes,
    BeforeValidator(_from_base64),
    AS_BASE64,
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]
