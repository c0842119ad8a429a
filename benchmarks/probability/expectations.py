"""How sure doubtful poses can be of what they predict, right ones and wrong ones.

A map is asked about its own photos, darker, noisier or disguised, in maps without them, and about
photos of other maps. Of those that have too few matches for a pose, every pose that would be tried
is kept with its score (``visloc.localization.guided``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.probability.disguises import DISGUISES, Disguise, Image, Taken
from benchmarks.probability.teachers import Question, is_right
from benchmarks.trust.queries import resized_to
from training.augmentation import augment
from training.conditions import draw_conditions
from visloc.archive import Map
from visloc.geometry import Camera, Pose
from visloc.images import Photo, read_photo_file
from visloc.localization.constraints import Constraints
from visloc.localization.gates import Problem, accepted
from visloc.localization.guided import is_worth_guiding, tried_poses
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.pose.generalized import refine_generalized_pose
from visloc.pose.views import MatchedView
from visloc.priors import NO_PRIORS
from visloc.types import Reason, Refusal

_WIDEST_PX, _BLOCK_PX = 640, 8
_WEATHER_SHARE = 0.3
_LIMITS = (5.0, 7.0, 8.5)


@dataclass(frozen=True, slots=True)
class Tried:
    """The poses that one refused photo had.

    Attributes:
        kind: what was done to the photo, or to the map.
        right: the highest score of a right pose; None without one that is promising.
        wrong: the same of a wrong one.
        refused: why the gates would still refuse the right pose of the highest score, or the wrong
            one where there is no right one; None when they accept it.
        probability: of that pose; None when a gate before it refuses.
    """

    kind: str
    right: float | None
    wrong: float | None
    refused: str | None
    probability: float | None


def tried(question: Question) -> Tried | None:
    """Try the poses of a photo; None for one that nothing is predicted for."""
    localizer, options = question.localizer, LocalizeOptions()
    look = localizer.look(Photo(np.ascontiguousarray(question.rgb)), question.camera, options)
    if look.shown is None or look.proposed is None:
        return None
    view = MatchedView(look.camera, Pose.identity(), look.matches.pixels, look.matches.points)
    problem = Problem(
        (view,),
        (look.evidence.camera_source,),
        options,
        Constraints(localizer.geometry, NO_PRIORS),
        (look.shown,),
        (look.reduced,),
    )
    best = problem.solve()
    refusal: Refusal | None = Refusal("pose", Reason.NO_POSE, "no pose")
    if best is not None:
        _, refusal = accepted(problem, best)
    if refusal is None or not is_worth_guiding(problem, refusal):
        return None
    scores = {True: -np.inf, False: -np.inf}
    poses: dict[bool, Pose] = {}
    for pose, support in tried_poses(problem, look.proposed, best):
        right = is_right(question, pose)
        if right is not None and support > scores[right]:
            scores[right], poses[right] = support, pose
    return Tried(
        question.kind,
        float(scores[True]) if True in poses else None,
        float(scores[False]) if False in poses else None,
        *(_judged(problem, poses[True in poses]) if poses else (None, None)),
    )


def _judged(problem: Problem, pose: Pose) -> tuple[str | None, float | None]:
    """Return why a pose is refused even if what it predicts were surely found; its probability."""
    error_px = problem.registration.max_error_px
    refined = refine_generalized_pose(problem.views, pose, max_error_px=error_px)
    if refined is None:
        return str(Reason.NO_POSE), None
    judged, refusal = accepted(problem, refined, expected=True)
    return None if refusal is None else str(refusal.reason), judged.probability


def in_the_dark(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    """Take a photo at night, as the network of local features is trained with."""
    width = min(image.shape[1], _WIDEST_PX) // _BLOCK_PX * _BLOCK_PX
    height = round(image.shape[0] * width / image.shape[1]) // _BLOCK_PX * _BLOCK_PX
    small = resized_to(image, width, height).rgb
    conditions = draw_conditions(rng, 1, 1.0, 1.0, _WEATHER_SHARE)
    pixels = torch.from_numpy(small).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        made = augment(pixels, conditions)[0].permute(1, 2, 0)
    return np.asarray((255 * made).round().byte()), camera.scaled(width, height)


# Each leaves a photo too few matches, or may.
DARK: dict[str, Disguise] = {
    "in the dark": in_the_dark,
    **{name: DISGUISES[name] for name in ("dark", "night", "noise")},
}


def of_strangers(
    localizer: Localizer,
    others: Sequence[tuple[Map, Path]],
    num_photos: int,
    rng: np.random.Generator,
) -> Iterator[Question]:
    """Ask a map about photos of other maps, as they are and in the dark: no pose is right."""
    for other, photos in others:
        kind = f"of {other.manifest.id}"
        rows = np.linspace(0, len(other.images) - 1, min(num_photos, len(other.images)))
        for row in np.unique(rows.astype(np.int64)):
            record = other.images[row]
            rgb, camera = read_photo_file(photos / record.name).rgb, other.cameras[record.camera]
            yield Question(localizer, kind, rgb, camera, None)
            for disguise in DARK.values():
                yield Question(localizer, f"{kind}, dark", *disguise(rgb, camera, rgb, rng), None)


def table_of_scores(kept: Path) -> Iterator[str]:
    """Yield lines in Markdown: by map, the scores of the poses that were tried."""
    limits = ", ".join(f"{limit:g}" for limit in _LIMITS)
    yield (
        "| map | photos tried | right poses | wrong poses | highest of them "
        f"| right with at least {limits} | wrong |"
    )
    yield "|---|---|---|---|---|---|---|"
    for path in sorted(kept.glob("*.jsonl")):
        lines = path.read_text(encoding="utf-8").splitlines()
        found = [Tried(**json.loads(line)) for line in lines]
        right = np.array([each.right for each in found if each.right is not None])
        wrong = np.array([each.wrong for each in found if each.wrong is not None])
        highest = f"{wrong.max():.1f}" if len(wrong) else "-"
        counts = [
            ", ".join(str(int((of >= limit).sum())) for limit in _LIMITS) for of in (right, wrong)
        ]
        yield (
            f"| {path.stem} | {len(found)} | {len(right)} | {len(wrong)} | {highest} "
            f"| {counts[0]} | {counts[1]} |"
        )
