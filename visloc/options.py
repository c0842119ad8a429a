"""The options of a query: their values, ranges, defaults and descriptions, told once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Any

from visloc.errors import refuse


class ReadAs(StrEnum):
    """The orientation in which the features of a photo are found."""

    STORED = "stored"
    UPRIGHT = "upright"  # turned by the photo's EXIF orientation
    ANY = "any"  # upright; a refused photo also in other turns that the map seems to know


class Extraction(StrEnum):
    """How much effort goes into the local features of a photo.

    Fewer keypoints, and at fewer scales where an extractor looks at several, take less time to
    find and to match. Maps are made with the most. Measured in docs/performance.md.
    """

    FAST = "fast"
    DEFAULT = "default"
    ACCURATE = "accurate"


class Inference(StrEnum):
    """How networks are computed. Descriptors of all ways match each other's."""

    AUTO = "auto"  # torch where there is a CUDA GPU, else 8 bits where the CPU is made for them
    INT8 = "int8"  # OpenVINO, 8-bit weights and activations
    FP32 = "fp32"  # OpenVINO, 32-bit
    TORCH = "torch"  # the reference; on a CUDA GPU where there is one


class Fusion(StrEnum):
    """How similarities under several global descriptors become one ranking.

    Section 4.3 and appendix B of Humenberger et al. 2020; the formulas are in
    ``visloc.retrieval.fusion``.
    """

    GHARM = "gharm"  # generalized harmonic mean
    MEAN = "mean"
    POWER = "power"  # weighted geometric mean
    MIN = "min"
    MAX = "max"
    MEAN_AND_POWER = "mean_and_power"
    MIN_AND_MAX = "min_and_max"
    MEAN_AND_MIN = "mean_and_min"
    VILLENA_ROMAN = "villena_roman"
    HARMONIC = "harmonic"
    ROUND_ROBIN = "round_robin"


class Matcher(StrEnum):
    """How a query's keypoints are matched with those of a mapping photo."""

    MUTUAL = "mutual"  # mutual nearest neighbours
    RATIO = "ratio"  # those of them that are clearly nearer than the second nearest
    LIGHTGLUE = "lightglue"  # the best photos again, by a network made for the local features


class Fallback(StrEnum):
    """What a photo gets that is refused."""

    NONE = "none"
    COARSE = "coarse"  # a pose told by retrieval alone, with a wide spread; never "localized"


class Solver(StrEnum):
    """What searches for a pose among 2D-3D correspondences."""

    PYCOLMAP = "pycolmap"
    POSELIB = "poselib"
    REGISTRATION = "registration"  # thresholds and refinement of COLMAP's image_registrator


def check_fusion_weights(weights: Mapping[str, float], code: str, field: str | None = None) -> None:
    """Make sure that weights of global descriptors mean something.

    Args:
        field: what the weights are called where they were given; None for what the code says.
    """
    field = code if field is None else field
    for name, weight in weights.items():
        if not 1e-6 <= weight <= 1e6:  # NaN fails too
            raise refuse(
                code,
                "the weight is out of range; leave a descriptor out to ignore it",
                field=f"{field}.{name}",
                expected="0.000001 to 1000000",
                got=weight,
            )
    if not weights:
        raise refuse(
            code,
            "there are no weights",
            field=field,
            expected="a weight for one global descriptor or more",
            got="{}",
        )


@dataclass(frozen=True, slots=True)
class RegistrationPreset:
    """Thresholds under which a pose is accepted.

    Attributes:
        max_error_px: largest reprojection error of an inlier, pixels.
        min_inliers: fewest inliers of an accepted pose.
        min_inlier_ratio: smallest share of inliers among the correspondences.
    """

    max_error_px: float
    min_inliers: int
    min_inlier_ratio: float


# Most mapping photos that one query may name: as many as ``top_k`` may retrieve.
MAX_PHOTOS = 1000

# Most maps that one query may name.
MAX_MAPS = 16

DEFAULT_PRESET = "default"

# A pose that is nine times as likely wrong as right is no answer. Above that, the answer says how
# likely it is, and the caller decides.
LEAST_PROBABILITY = 0.1

# config1 and config2: table 2 of Humenberger et al. 2020 (abs_pose_max_error,
# abs_pose_min_num_inliers, abs_pose_min_inlier_ratio). config2 was made to give an answer
# whenever it can; it is for comparisons with the paper, not for robots.
PRESETS: Mapping[str, RegistrationPreset] = {
    DEFAULT_PRESET: RegistrationPreset(max_error_px=12.0, min_inliers=30, min_inlier_ratio=0.05),
    "config1": RegistrationPreset(max_error_px=12.0, min_inliers=30, min_inlier_ratio=0.25),
    "config2": RegistrationPreset(max_error_px=20.0, min_inliers=4, min_inlier_ratio=0.05),
}


DEFAULT_FUSION_PARAMETER = 0.5  # kapture's; the paper names none

_PRESETS_VALUE, _MAPS_VALUE = "the preset's", "the map's"


def _option(
    default: Any,
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    unset: str | None = None,
    details: str = "",
    **more: Any,
) -> Any:
    """An option of ``LocalizeOptions``; the API's words and the clients are made from these.

    Args:
        default: its value when the caller leaves it out.
        low: least value, when it is a number.
        unset: whose value is taken when the default is None.
    """
    metadata = {
        "description": description,
        "range": None if low is None else (low, high),
        "default": unset or default,
        "details": details,
    }
    return field(default=default, metadata=metadata, **more)


@dataclass(frozen=True, slots=True)
class LocalizeOptions:
    """What a caller may choose per query; None takes the preset's or the map's value.

    The default largest error is for photos of 640 px and more on the longer side, and shrinks
    with smaller ones. Equal seeds give equal answers.
    """

    preset: str = _option(DEFAULT_PRESET, "the thresholds to start from")
    top_k: int = _option(20, "mapping photos to match against", 1, 1000)
    photos: tuple[str, ...] | None = _option(
        None,
        "mapping photos to match against instead of those that retrieval finds, best first",
        unset="those that retrieval finds",
        details="Names in the map, each once; all are matched, whatever top_k is.",
    )
    max_error_px: float | None = _option(
        None, "largest reprojection error of an inlier, pixels", 0.1, 1000.0, unset=_PRESETS_VALUE
    )
    min_inliers: int | None = _option(
        None, "fewest inliers of an accepted pose", 4, 1_000_000, unset=_PRESETS_VALUE
    )
    min_inlier_ratio: float | None = _option(
        None,
        "smallest share of inliers among the correspondences",
        0.0,
        1.0,
        unset=_PRESETS_VALUE,
    )
    min_probability: float | None = _option(
        None,
        "smallest probability of an accepted pose",
        0.0,
        1.0,
        unset=f"{LEAST_PROBABILITY:g}; 0 with another preset or with min_inliers",
    )
    read_as: ReadAs = _option(
        ReadAs.ANY,
        "orientation in which features are found",
        details="upright rotates the photo by its EXIF orientation first; any also tries other "
        "turns of a photo on its own that is refused. Camera, keypoints and pose refer to the "
        "stored pixels in any case. Ignored for features that are sent.",
    )
    extraction: Extraction = _option(
        Extraction.DEFAULT,
        "effort that goes into finding the photo's features",
        details="Features that are sent are taken as they are.",
    )
    fusion: Fusion | None = _option(
        None,
        "how the similarities of several global descriptors become one ranking",
        unset=_MAPS_VALUE,
    )
    fusion_weights: Mapping[str, float] | None = _option(
        None,
        "positive weight by global descriptor",
        unset=_MAPS_VALUE,
        details="Descriptors without a weight are left out.",
        hash=False,  # a dict
    )
    fusion_parameter: float = _option(
        DEFAULT_FUSION_PARAMETER,
        "gamma of gharm; beta, at most 1, of the fusions that mix two operators",
        0.0,
        100.0,
        details="Beta is the share of the operator that is named first, and of the quotient in "
        "villena_roman. Other fusions ignore it.",
    )
    matcher: Matcher = _option(Matcher.MUTUAL, "how keypoints are matched")
    solver: Solver = _option(Solver.PYCOLMAP, "pose solver")
    seed: int = _option(0, "seed of RANSAC", 0, 2**31 - 1)
    fallback: Fallback = _option(
        Fallback.NONE,
        "what a refused photo gets beside the reason",
        details="coarse: the pose that the most similar mapping photos suggest, with its spread, "
        "as an answer of status coarse. Only for a photo on its own, in one map.",
    )

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise refuse(
                "options.preset", field="options.preset", expected=PRESETS, got=self.preset
            )
        for option in fields(self):
            value = getattr(self, option.name)
            if value is None or option.metadata["range"] is None:
                continue
            low, high = option.metadata["range"]
            if not low <= value <= high:  # NaN fails too
                raise refuse(
                    f"options.{option.name}",
                    field=f"options.{option.name}",
                    expected=f"{low} to {high}",
                    got=value,
                )
        if self.photos is not None and not (
            0 < len(self.photos) <= MAX_PHOTOS and len(set(self.photos)) == len(self.photos)
        ):
            raise refuse(
                "options.photos",
                field="options.photos",
                expected=f"1 to {MAX_PHOTOS} names, each once",
                got=f"{len(self.photos)} names, {len(set(self.photos))} different",
            )
        if self.fusion_weights is not None:
            check_fusion_weights(self.fusion_weights, "options.fusion_weights")

    @property
    def registration(self) -> RegistrationPreset:
        """The preset's thresholds, with those replaced that the caller named."""
        preset = PRESETS[self.preset]
        return RegistrationPreset(
            preset.max_error_px if self.max_error_px is None else self.max_error_px,
            preset.min_inliers if self.min_inliers is None else self.min_inliers,
            preset.min_inlier_ratio if self.min_inlier_ratio is None else self.min_inlier_ratio,
        )

    @property
    def least_probability(self) -> float:
        """The smallest probability of an accepted pose, 0 to 1.

        A caller who names ``min_inliers`` or a preset, and no probability, gets every pose.
        """
        if self.min_probability is not None:
            return self.min_probability
        has_own_thresholds = self.preset != DEFAULT_PRESET or self.min_inliers is not None
        return 0.0 if has_own_thresholds else LEAST_PROBABILITY

    @property
    def orientation(self) -> ReadAs:
        """``STORED`` or ``UPRIGHT``: how a photo is read before any other turn is tried."""
        return ReadAs.STORED if self.read_as is ReadAs.STORED else ReadAs.UPRIGHT

    def before_rivals(self) -> LocalizeOptions:
        """Return the options for one of several places, before their poses are compared.

        A raised ``min_probability`` counts afterwards: if it removed the best place before, the
        second best would be the answer.
        """
        return replace(self, min_probability=min(self.least_probability, LEAST_PROBABILITY))
