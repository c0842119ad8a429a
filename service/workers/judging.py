"""One answer of several maps or sets that were searched: comparing poses across their frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from service.values import InstantLocalization, Localization
from visloc.archive.places import similarity_on_earth
from visloc.geometry import Similarity
from visloc.localization.judge import (
    STDS,
    TIE_REACH_SHARE,
    Candidate,
    Tie,
    inliers_of,
    judge,
    measured_pose,
)
from visloc.priors import NO_PRIORS, Priors
from visloc.types import NotLocalized, Refusal

AnyLocalization = TypeVar("AnyLocalization", Localization, InstantLocalization)


def judged(
    found: Sequence[AnyLocalization], priors: Priors = NO_PRIORS
) -> tuple[int, AnyLocalization]:
    """Choose one answer of several, or refuse the query as ambiguous.

    The rule is that of ``visloc.localization.judge``.

    Args:
        found: at least one, of maps, of sets, or of the tiles of one set. Of several poses that one
            map gave, by itself and as a tile, the first counts.
        priors: those that they obey.

    Returns:
        Its row and the answer. A refusal carries the evidence of the place with the most inliers.
    """
    measured: set[str] = set()
    rows = []
    for row, each in enumerate(found):
        if measured_pose(each.answer) is not None:
            if each.ref in measured:
                continue
            measured.add(each.ref)
        rows.append(row)
    asked = [found[row] for row in rows]
    verdict = judge(
        [Candidate(each.ref, each.answer) for each in asked],
        lambda i, j: _tie(asked[i], asked[j], priors),
    )
    if not isinstance(verdict, Refusal):
        return rows[verdict], asked[verdict]
    row = max(rows, key=lambda row: inliers_of(found[row].answer))
    best = found[row]
    if isinstance(best, InstantLocalization):
        return row, replace(best, answer=replace(best.answer, pose=None, refusal=verdict))
    evidence = best.answer.evidence
    refused = NotLocalized(evidence, verdict.stage, verdict.reason, verdict.message)
    return row, replace(best, answer=refused)


def _tie(a: AnyLocalization, b: AnyLocalization, priors: Priors) -> Tie | None:
    """Say how the frames of two answers lie to each other; None where nothing ties them.

    Tiles of one set share its frame. Anchored maps are compared on Earth. Of maps that are not
    anchored, versions of one map are taken to share a frame, and so are all maps where the caller
    says, in one frame, where the device is. Other maps cannot be compared: their coordinates may
    be alike where their places are not, as on two floors that were both mapped from the lift
    onwards.
    """
    same_map = a.map_id == b.map_id
    if (same_map and a.map_version == b.map_version) or a.geodetic is None or b.geodetic is None:
        if same_map or priors.position is not None or priors.pose is not None:
            return Tie(Similarity.identity(), TIE_REACH_SHARE * max(a.reach, b.reach))
        return None
    a_from_b = similarity_on_earth(a.geodetic, b.geodetic)
    reach = max(a.reach, a_from_b.scale * b.reach)
    # Neighbouring fixes share their errors, so many photos do not average them out.
    fixes = math.hypot(a.anchor_rms, a_from_b.scale * b.anchor_rms)
    return Tie(a_from_b, TIE_REACH_SHARE * reach + STDS * fixes)
