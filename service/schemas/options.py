"""What may be chosen per query."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

import visloc.types
from service.incoming import IncomingMessage, converted
from visloc.errors import InvalidInput


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
    seed: Annotated[int | None, Field(description="of RANSAC: 0 to 2147483647, by default 0")] = (
        None
    )

    def to_core(self) -> visloc.types.LocalizeOptions:
        """Return the options, checked."""
        given = self.model_dump(exclude_none=True)
        if self.read_as is not None:
            known = [str(value) for value in visloc.types.ReadAs]
            if self.read_as not in known:
                raise InvalidInput(
                    "options.read_as",
                    "unknown orientation to read in",
                    field="options.read_as",
                    expected=f"one of {', '.join(known)}",
                    got=self.read_as,
                )
            given["read_as"] = visloc.types.ReadAs(self.read_as)
        return visloc.types.LocalizeOptions(**given)


def _options_from_text(value: object) -> object:
    return LocalizeOptions.read_json(value) if isinstance(value, str) else value


# Options as an object, or as JSON in a field of a form.
GivenOptions = Annotated[LocalizeOptions, converted(_options_from_text)]
