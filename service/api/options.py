"""What may be chosen per query."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

import visloc.types
from service.api.message import IncomingMessage, converted
from visloc.errors import refuse

# More global descriptors than any map has, and longer names.
_MAX_WEIGHTS = 16
_MAX_NAME = 100


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
            description="upright (default): turn the photo by its EXIF orientation before features "
            "are found; or stored. Camera, keypoints and pose are those of the stored pixels "
            "either way. It has no meaning for features that are sent"
        ),
    ] = None
    extraction: Annotated[
        str | None,
        Field(
            description="effort that goes into finding the photo's features: fast, default or "
            "accurate; features that are sent are taken as they are"
        ),
    ] = None
    fusion: Annotated[
        str | None,
        Field(
            description="how similarities under several global descriptors become one ranking: "
            f"{', '.join(visloc.types.Fusion)}; by default the map's"
        ),
    ] = None
    fusion_weights: Annotated[
        dict[str, float] | None,
        converted(_check_names),
        Field(
            description="positive weight by global descriptor; those without one are left out; by "
            "default the map's"
        ),
    ] = None
    matcher: Annotated[
        str | None,
        Field(
            description=f"how keypoints are matched: {', '.join(visloc.types.Matcher)}; by default "
            "mutual"
        ),
    ] = None
    solver: Annotated[
        str | None,
        Field(
            description="what searches for the pose: "
            f"{', '.join(visloc.types.Solver)}; by default pycolmap"
        ),
    ] = None
    seed: Annotated[int | None, Field(description="of RANSAC: 0 to 2147483647, by default 0")] = (
        None
    )

    def to_core(self) -> visloc.types.LocalizeOptions:
        """Return the options, checked."""
        given = self.model_dump(exclude_none=True)
        for name, (words, message) in _WORDS.items():
            if name in given:
                given[name] = _known_word(words, given[name], name, message)
        return visloc.types.LocalizeOptions(**given)


_WORDS: Mapping[str, tuple[type[StrEnum], str]] = {
    "read_as": (visloc.types.ReadAs, "the orientation is unknown"),
    "extraction": (visloc.types.Extraction, "the extraction is unknown"),
    "fusion": (visloc.types.Fusion, "the fusion is unknown"),
    "matcher": (visloc.types.Matcher, "the matcher is unknown"),
    "solver": (visloc.types.Solver, "the solver is unknown"),
}


def _known_word(words: type[StrEnum], given: str, name: str, message: str) -> StrEnum:
    if given not in list(words):
        raise refuse(f"options.{name}", message, field=f"options.{name}", expected=words, got=given)
    return words(given)


def _options_from_text(value: object) -> object:
    return LocalizeOptions.read_json(value) if isinstance(value, str) else value


# Options as an object, or as JSON in a field of a form.
GivenOptions = Annotated[LocalizeOptions, converted(_options_from_text)]
