"""What may be chosen per query."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar, TypeVar

from pydantic import Field

import visloc.types
from service.incoming import IncomingMessage, converted
from visloc.errors import InvalidInput

WordT = TypeVar("WordT", bound=StrEnum)


class LocalizeOptions(IncomingMessage):
    """What may be chosen per query. null is the same as left out."""

    path: ClassVar[str] = "options."

    preset: Annotated[
        str | None,
        Field(description="the thresholds to start from: default, config1 or config2"),
    ] = None
    top_k: Annotated[
        int | None, Field(description="mapping photos to match against: 1 to 1000, by default 20")
    ] = None
    max_error_px: Annotated[
        float | None,
        Field(
            description="largest reprojection error of an inlier: 0.1 to 1000 pixels, by default "
            "the preset's"
        ),
    ] = None
    min_inliers: Annotated[
        int | None,
        Field(
            description="fewest inliers of an accepted pose: 4 to 1000000, by default the preset's"
        ),
    ] = None
    min_inlier_ratio: Annotated[
        float | None,
        Field(
            description="smallest share of inliers among the correspondences: 0 to 1, by default "
            "the preset's"
        ),
    ] = None
    read_as: Annotated[
        str | None,
        Field(
            description="stored (default), or upright: turn the photo by its EXIF orientation "
            "before features are found"
        ),
    ] = None
    extraction: Annotated[
        str | None,
        Field(
            description="effort that goes into finding the photo's features: fast, default or "
            "accurate; features that are sent are taken as they are"
        ),
    ] = None
    seed: Annotated[int | None, Field(description="of RANSAC: 0 to 2147483647, by default 0")] = (
        None
    )

    def to_core(self) -> visloc.types.LocalizeOptions:
        """Return the options, checked."""
        given = self.model_dump(exclude_none=True)
        if self.read_as is not None:
            given["read_as"] = _known_word(
                visloc.types.ReadAs, self.read_as, "read_as", "unknown orientation to read in"
            )
        if self.extraction is not None:
            given["extraction"] = _known_word(
                visloc.types.Extraction, self.extraction, "extraction", "unknown effort"
            )
        return visloc.types.LocalizeOptions(**given)


def _known_word(words: type[WordT], given: str, name: str, message: str) -> WordT:
    if given not in list(words):
        raise InvalidInput(
            f"options.{name}",
            message,
            field=f"options.{name}",
            expected=f"one of {', '.join(words)}",
            got=given,
        )
    return words(given)


def _options_from_text(value: object) -> object:
    return LocalizeOptions.read_json(value) if isinstance(value, str) else value


# Options as an object, or as JSON in a field of a form.
GivenOptions = Annotated[LocalizeOptions, converted(_options_from_text)]
