"""The settings of the method sfm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from pydantic import JsonValue

from mapping.methods.sparse.adjustment import REFINABLE
from mapping.methods.sparse.model import MAPPER_CONFIGS
from mapping.options import SFM_PANEL, Names
from mapping.pairing import PAIRINGS, PairSettings
from visloc.archive import Map, sha256_of

POSES = ("given", "estimate")

_option = partial(typer.Option, rich_help_panel=SFM_PANEL)
PairsOption = Annotated[
    Names,
    _option(help=f"Which photos to match. Comma-separated: {', '.join(PAIRINGS)}."),
]


@dataclass(frozen=True, slots=True)
class SfmSettings:
    """Settings for landmarks from matches.

    Attributes:
        covisible_in: a map whose observations tell which photos share points, for the pairing
            covisibility; None for the dataset's own reconstruction.
    """

    pairs: PairsOption = ("retrieval",)
    pairing: PairSettings = field(default_factory=PairSettings)
    pairs_file: Annotated[
        Path | None,
        _option(help="File with pairs to match instead of --pairs, such as pairs.txt of a map."),
    ] = None
    matches_dir: Annotated[
        Path | None,
        _option(
            help="Folder of another program's matches of ready-made features, in kapture's layout "
            "(reconstruction/matches/TYPE). Without --pairs-file, its pairs are the pairs."
        ),
    ] = None
    covisible_in: Map | None = None
    mapper: Annotated[
        str,
        _option(
            help=f"Thresholds of the published mapper: {' or '.join(MAPPER_CONFIGS)} (relaxed)."
        ),
    ] = "config1"
    refine: Annotated[
        Names,
        _option(
            help="What bundle adjustment may change after triangulation. Comma-separated: "
            f"{', '.join(REFINABLE)}."
        ),
    ] = ()
    poses: Annotated[
        str,
        _option(
            help="given: use the dataset's poses. estimate: estimate all poses; known poses or "
            "GNSS of some photos then only place the map."
        ),
    ] = POSES[0]

    @property
    def estimate_poses(self) -> bool:
        """Whether poses are found together with points."""
        return self.poses == "estimate"

    def record(self) -> Mapping[str, JsonValue]:
        """Return the settings that were used, for the manifest."""
        used: dict[str, JsonValue] = {
            "mapper": {"name": self.mapper, **asdict(MAPPER_CONFIGS[self.mapper])},
            "refine": list(self.refine),
            "poses": self.poses,
        }
        if self.matches_dir is not None:
            used["matches"] = "given"
        if self.pairs_file is not None:
            return {"pairs_file_sha256": sha256_of(self.pairs_file), **used}
        if self.matches_dir is not None:
            return used
        pairing = self.pairing
        if "distance" in self.pairs:
            used |= {"max_distance": pairing.max_distance, "max_angle_deg": pairing.max_angle_deg}
        if "frustum" in self.pairs:
            used |= {"near": pairing.near, "far": pairing.far}
        if "covisibility" in self.pairs and self.covisible_in is not None:
            used |= {"covisible_in": self.covisible_in.ref}
        return {"pairs": list(self.pairs), "top_k": pairing.top_k, **used}
