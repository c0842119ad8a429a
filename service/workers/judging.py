"""One answer of several maps or sets that were searched: comparing poses across their frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from service.values import Localization
from visloc.archive.places import similarity_on_earth
from visloc.geometry import Similarity
from visloc.localization.acceptance.judge import (
    STDS,
    TIE_REACH_SHARE,
    Tie,
    judge,
    measured_pose,
    not_probable_enough,
    poses_agree,
)
from visloc.options import LocalizeOptions
from visloc.priors import NO_PRIORS, Priors
from visloc.types import Refusal


def judged(found: Sequence[Localization], priors: Priors = NO_PRIORS) -> tuple[int, Localization]:
    """Choose one answer of several (``acceptance.judge``), or refuse all as ambiguous.

    Args:
        found: at least one, of maps, of sets, or of the tiles of one set. When one map gave several
            poses, by itself and as a tile, the first counts.

    Returns:
        The row and the answer. A refusal carries the evidence of the place with the most inliers,
        and no coarse pose if there are several: retrieval does not tell which place it is.
    """
    if len(found) > 1:
        found = [without_coarse(each) for each in found]
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
        [each.place for each in asked],
        lambda i, j: _tie(asked[i], asked[j], priors),
    )
    if not isinstance(verdict, Refusal):
        return rows[verdict], asked[verdict]
    row = max(rows, key=lambda row: found[row].answer.num_inliers)
    refused = replace(found[row].answer, pose=None, refusal=verdict)
    return row, replace(found[row], answer=refused)


def without_coarse(found: Localization) -> Localization:
    """Leave out the pose that retrieval alone tells."""
    return replace(found, answer=replace(found.answer, coarse=None))


def agree(a: Localization, b: Localization) -> bool:
    """Tell whether both answers have poses, at the same place."""
    if measured_pose(a.answer) is None or measured_pose(b.answer) is None:
        return False
    tie = _tie(a, b, NO_PRIORS)
    return tie is not None and poses_agree(a.answer, b.answer, tie)


def gated(found: Localization, options: LocalizeOptions) -> Localization:
    """Refuse the judged answer if its pose is less probable than the caller asks for."""
    refusal = not_probable_enough(found.answer, options)
    if refusal is None:
        return found
    return replace(found, answer=replace(found.answer, pose=None, refusal=refusal))


def settled(
    found: Sequence[Localization], options: LocalizeOptions, priors: Priors
) -> tuple[int | None, Refusal | None]:
    """Return the map on which a sequence settles with an instant, or why no map has its pose.

    When the best place is refused, the second best is no answer.
    """
    best, verdict = judged(found, priors)
    refusal = verdict.answer.refusal or not_probable_enough(verdict.answer, options)
    return (best, None) if refusal is None else (None, refusal)


def _tie(a: Localization, b: Localization, priors: Priors) -> Tie | None:
    """Return the transform between the frames of two answers; None where it is unknown.

    Tiles of one set share its frame. Anchored maps are compared on Earth. Versions of one map are
    taken to share a frame when they are not both anchored. So are all maps when the caller's priors
    locate the device in one frame. Other maps cannot be compared: equal coordinates do not mean
    equal places, as on two floors that were both mapped from the lift onwards.
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
