"""What may be chosen per query; ``visloc.options.LocalizeOptions`` says what each option is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

from pydantic import Field

import visloc.options
import visloc.types
from visloc.errors import refuse
from visloc_api.words.message import IncomingMessage, converted

# More global descriptors than any map has, and longer names.
_MAX_WEIGHTS = 16
_MAX_NAME = 100
# Longer than any path of a photo.
_MAX_PATH = 4096
_MESSAGES = {
    "read_as": "the orientation is unknown",
    "extraction": "the effort is unknown",
    "fusion": "the fusion is unknown",
    "matcher": "the matcher is unknown",
    "solver": "the solver is unknown",
    "fallback": "the fallback is unknown",
}


def _kind_of(hint: Any) -> type:
    """Return the class of an option that may be None."""
    (kind,) = (each for each in get_args(hint) or (hint,) if each is not type(None))
    found: type = getattr(kind, "__origin__", kind)
    return found


# The class of each option: int, float, str, tuple, Mapping, or an enumeration of texts.
KINDS: Mapping[str, type] = {
    name: _kind_of(hint) for name, hint in get_type_hints(visloc.options.LocalizeOptions).items()
}
# The texts that an option may have, where they are listed.
CHOICES: Mapping[str, tuple[str, ...]] = {
    "preset": tuple(visloc.options.PRESETS),
    **{
        name: tuple(word.value for word in kind)
        for name, kind in KINDS.items()
        if issubclass(kind, StrEnum)
    },
}


def _check_names(value: object) -> object:
    """Refuse too many or too long names before any weight is looked at."""
    if isinstance(value, Mapping):
        if len(value) > _MAX_WEIGHTS:
            raise refuse(
                "options.fusion_weights",
                "there are too many weights",
                field="fusion_weights",
                expected=f"at most {_MAX_WEIGHTS}",
                got=len(value),
            )
        for name in value:
            if not isinstance(name, str) or not 0 < len(name) <= _MAX_NAME:
                raise refuse(
                    "options.fusion_weights",
                    "this is not the name of a global descriptor",
                    field="fusion_weights",
                    expected=f"a text of 1 to {_MAX_NAME} characters",
                    got=f"{len(name)} characters" if isinstance(name, str) else type(name).__name__,
                )
    return value


def _check_photos(value: object) -> object:
    """Refuse too many or too long names before anything is done with them."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        if len(value) > visloc.options.MAX_PHOTOS:
            raise refuse(
                "options.photos",
                field="photos",
                expected=f"at most {visloc.options.MAX_PHOTOS} names",
                got=len(value),
            )
        for name in value:
            if isinstance(name, str) and len(name) > _MAX_PATH:
                raise refuse(
                    "options.photos",
                    field="photos",
                    expected=f"names of at most {_MAX_PATH} characters",
                    got=f"{len(name)} characters",
                )
    return value


def describe(name: str) -> str:
    """Tell callers what an option is: its values, its default, and what else there is to know."""
    option = visloc.options.LocalizeOptions.__dataclass_fields__[name]
    facts = option.metadata
    text = facts["description"]
    if name in CHOICES:
        text += f": {', '.join(CHOICES[name])}"
    elif facts["range"] is not None:
        text += ": {:g} to {:.10g}".format(*facts["range"])
    text += f"; by default {facts['default']}"
    return f"{text}. {facts['details']}" if facts["details"] else text


def _schema(name: str) -> dict[str, Any]:
    """Return what the JSON schema of an option says beside its type and its description."""
    option = visloc.options.LocalizeOptions.__dataclass_fields__[name]
    facts: dict[str, Any] = {"title": option.metadata["description"]}
    if name in CHOICES:
        facts["enum"] = [*CHOICES[name], None]
    elif option.metadata["range"] is not None:
        facts["minimum"], facts["maximum"] = option.metadata["range"]
    if option.default is not None:
        facts["default"] = option.default
    return facts


def _option(name: str) -> Any:
    return Field(description=describe(name), json_schema_extra=_schema(name))


class LocalizeOptions(IncomingMessage):
    """Options of one query. null means the same as leaving a field out."""

    path: ClassVar[str] = "options."

    preset: Annotated[str | None, _option("preset")] = None
    top_k: Annotated[int | None, _option("top_k")] = None
    photos: Annotated[list[str] | None, converted(_check_photos), _option("photos")] = None
    max_error_px: Annotated[float | None, _option("max_error_px")] = None
    min_inliers: Annotated[int | None, _option("min_inliers")] = None
    min_inlier_ratio: Annotated[float | None, _option("min_inlier_ratio")] = None
    min_probability: Annotated[float | None, _option("min_probability")] = None
    read_as: Annotated[str | None, _option("read_as")] = None
    extraction: Annotated[str | None, _option("extraction")] = None
    fusion: Annotated[str | None, _option("fusion")] = None
    fusion_weights: Annotated[
        dict[str, float] | None, converted(_check_names), _option("fusion_weights")
    ] = None
    fusion_parameter: Annotated[float | None, _option("fusion_parameter")] = None
    matcher: Annotated[str | None, _option("matcher")] = None
    solver: Annotated[str | None, _option("solver")] = None
    seed: Annotated[int | None, _option("seed")] = None
    fallback: Annotated[str | None, _option("fallback")] = None

    def to_core(self) -> visloc.options.LocalizeOptions:
        """Return the options, checked."""
        given = self.model_dump(exclude_none=True)
        for name in given.keys() & _MESSAGES.keys():
            if given[name] not in CHOICES[name]:
                raise refuse(
                    f"options.{name}",
                    _MESSAGES[name],
                    field=f"options.{name}",
                    expected=CHOICES[name],
                    got=given[name],
                )
            given[name] = KINDS[name](given[name])
        if "photos" in given:
            given["photos"] = tuple(given["photos"])
        return visloc.options.LocalizeOptions(**given)


def _options_from_text(value: object) -> object:
    return LocalizeOptions.read_json(value) if isinstance(value, str) else value


# Options as an object, or as JSON in a field of a form.
GivenOptions = Annotated[LocalizeOptions, converted(_options_from_text)]
