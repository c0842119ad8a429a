"""The matching stages: mutual nearest neighbours of paired photos, then geometric verification.

Matches of another program take the place of the nearest neighbours, and are verified likewise.

With known poses, a match must fit their epipolar geometry. Without, the two-view geometry of the
pair is estimated (``mapping.methods.matching.two_views``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from mapping.methods.matching.fixed_things import Tally, some_keep_their_pixel
from mapping.methods.matching.two_views import fits_two_views
from mapping.stages.camera_mask import CameraMask, are_masked
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import View
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.kapture.matches import MatchFiles, match_file
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.matching.verification import epipolar_errors
from visloc.pose.reprojection import normalized_rays

# Raised when the code of a stage here changes what comes out.
_REVISION = {"matches": 2, "fixed_things": 2, "verified": 5}
# Partners of a photo with which it is asked what is fixed to the picture: enough for all photos
# together.
_MOST_ASKED = 8


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Verified matches of one pair of photos.

    Attributes:
        second: row of a later photo.
        rows: (k, 2) uint32 rows of the features of both.
    """

    first: int
    second: int
    rows: NDArray[np.uint32]


def matches_among(rows: Sequence[int], matches: Sequence[Matches]) -> list[Matches]:
    """Return the matches between some photos, which are numbered in the order of their rows."""
    number = {row: order for order, row in enumerate(rows)}
    return [
        Matches(number[pair.first], number[pair.second], pair.rows)
        for pair in matches
        if pair.first in number and pair.second in number
    ]


@dataclass(frozen=True, slots=True)
class Verification:
    """The test that matches of two photos must pass.

    Attributes:
        max_error_px: largest distance to the epipolar line, pixels.
        min_matches: fewest verified matches of a pair; a pair with fewer is dropped.
        poses_known: verify with the poses of the photos; otherwise by two-view geometry.
    """

    max_error_px: float
    min_matches: int
    poses_known: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Partners:
    """A photo and its partners in pairs."""

    photo: MappingPhoto
    partners: tuple[MappingPhoto, ...]


def find_fixed(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    pairs: NDArray[np.int64],
    verification: Verification,
) -> dict[str, CameraMask]:
    """Match pairs (m, 2) of photos, and find what is fixed to the picture.

    Returns:
        Masks by sensor, of those that have such things.
    """
    partners = [group for _, _, group in _groups(photos, pairs)]
    task = _MatchTask(context.work, context.features, verification, context.matches)
    context.run("matches", task.match_and_tally, partners)
    tallies: dict[str, Tally] = {}
    for group in partners:
        sensor, item = group.photo.record.sensor_id, context.work.read(task.tally_key(group))
        told = Tally(item["against"], item["pairs"], item["moved"])
        tallies[sensor] = told + tallies[sensor] if sensor in tallies else told
    masks = {sensor: tally.mask() for sensor, tally in tallies.items()}
    return {sensor: mask for sensor, mask in masks.items() if mask is not None}


def outside_fixed(
    context: BuildContext, photos: Sequence[MappingPhoto], fixed: Mapping[str, CameraMask]
) -> BuildContext:
    """Find new features outside what is fixed to the picture, by sensor, and return their context.

    It may have had most of the keypoints that a photo may have. Matches of another program name
    keypoints by their rows, so these stay as they are, and their matches are left out.
    """
    if not fixed:
        return context
    if context.matches is not None:
        return replace(context, fixed=fixed)
    context = replace(context, features=context.features.outside(fixed))
    masked = [photo for photo in photos if photo.record.sensor_id in fixed]
    context.run("local features", context.features.prepare, masked)
    return context


def match_pairs(
    context: BuildContext,
    photos: Sequence[MappingPhoto],
    pairs: NDArray[np.int64],
    verification: Verification,
) -> tuple[list[Matches], str]:
    """Match and verify pairs (m, 2) of photos.

    Returns:
        The pairs that have matches, and a key for all their inputs.
    """
    found_groups = _groups(photos, pairs)
    groups = [(first, seconds) for first, seconds, _ in found_groups]
    partners = [group for _, _, group in found_groups]
    task = _MatchTask(context.work, context.features, verification, context.matches, context.fixed)
    # Usually, what is fixed was looked for among the same matches, and nothing was found.
    missing = [group for group in partners if not context.work.has(task.matches_key(group))]
    if missing:
        context.run("matches", task.match, missing)
    context.run("verified", task.verify, partners)
    keys = [task.verified_key(group) for group in partners]
    found = [
        Matches(first, second, rows)
        for (first, seconds), key in zip(groups, keys, strict=True)
        for second, rows in zip(seconds, _rows_by_partner(context.work.read(key)), strict=True)
        if len(rows)
    ]
    return found, key_of("all_matches", 1, keys=keys, groups=groups)


def _groups(
    photos: Sequence[MappingPhoto], pairs: NDArray[np.int64]
) -> list[tuple[int, list[int], _Partners]]:
    """Return the rows of each first photo and of its partners, and these photos."""
    groups = []
    for first in np.unique(pairs[:, 0]).tolist():
        seconds = pairs[pairs[:, 0] == first, 1].tolist()
        partners = tuple(photos[second] for second in seconds)
        groups.append((first, seconds, _Partners(photos[first], partners)))
    return groups


@dataclass(frozen=True, slots=True)
class _MatchTask:
    """A worker's part: one photo and its partners."""

    work: WorkFolder
    features: LocalFeaturesSource
    verification: Verification
    given: MatchFiles | None = None
    fixed: Mapping[str, CameraMask] = field(default_factory=dict)

    def matches_key(self, group: _Partners) -> str:
        return key_of(
            "matches",
            _REVISION["matches"],
            photo=self.features.key(group.photo),
            partners=[self.features.key(partner) for partner in group.partners],
            **({} if self.given is None else self._given_of(group, self.given)),
        )

    def _given_of(self, group: _Partners, given: MatchFiles) -> dict[str, JsonValue]:
        """Return what the matches of another program depend on."""
        photos = (group.photo, *group.partners)
        masks = [self.fixed.get(photo.record.sensor_id) for photo in photos]
        return {
            "given": [given.digest(group.photo.name, partner.name) for partner in group.partners],
            **({"fixed": [_cells(mask) for mask in masks]} if self.fixed else {}),
        }

    def tally_key(self, group: _Partners) -> str:
        camera = group.photo.camera
        return key_of(
            "fixed_things",
            _REVISION["fixed_things"],
            matches=self.matches_key(group),
            max_error_px=self.verification.max_error_px,
            camera=[*camera_values(camera), group.photo.camera_known],
            of_camera=[self._are_of_one_camera(group.photo, partner) for partner in group.partners],
        )

    def verified_key(self, group: _Partners) -> str:
        return key_of(
            "verified",
            _REVISION["verified"],
            matches=self.matches_key(group),
            max_error_px=self.verification.max_error_px,
            min_matches=self.verification.min_matches,
            poses_known=self.verification.poses_known,
            views=[
                [
                    *camera_values(photo.camera),
                    photo.camera_known,
                    *(pose_values(photo.pose) if self.verification.poses_known else ()),
                ]
                for photo in (group.photo, *group.partners)
            ],
        )

    def match(self, group: _Partners) -> None:
        def compute() -> Item:
            if self.given is not None:
                return _item(self._given(group, self.given))
            # One partner at a time: with exhaustive pairs, a photo has thousands.
            sides = (
                round_descriptors(self.features.read(photo).descriptors)
                for photo in (group.photo, *group.partners)
            )
            own = next(sides)
            pairs = (mutual_nearest_neighbours(own, theirs)[:2] for theirs in sides)
            return _item([np.column_stack(rows).astype(np.uint32) for rows in pairs])

        if not self.work.has(self.matches_key(group)):
            self.work.get(self.matches_key(group), compute)

    def _given(self, group: _Partners, given: MatchFiles) -> list[NDArray[np.uint32]]:
        """Matches of another program with each partner; none for a pair that it left out."""
        photo, found = group.photo, []
        own = self.features.read(photo).keypoints
        for partner in group.partners:
            rows = given.read(photo.name, partner.name)
            if rows is None:
                rows = np.empty((0, 2), np.int64)
            theirs = self.features.read(partner).keypoints
            if (rows >= (len(own), len(theirs))).any():
                raise refuse(
                    "kapture.match_values",
                    field=given.label(match_file(photo.name, partner.name)),
                    expected=f"rows of {len(own)} and {len(theirs)} keypoints",
                    got=", ".join(map(str, rows.max(axis=0).tolist())),
                )
            free = self._are_free(photo, own[rows[:, 0]])
            free &= self._are_free(partner, theirs[rows[:, 1]])
            found.append(rows[free].astype(np.uint32))
        return found

    def _are_free(self, photo: MappingPhoto, pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Tell which pixels (n, 2) of a photo do not show what is fixed to the picture."""
        mask = self.fixed.get(photo.record.sensor_id)
        if mask is None:
            return np.ones(len(pixels), dtype=np.bool_)
        return ~are_masked(photo.camera, mask, pixels)

    def match_and_tally(self, group: _Partners) -> None:
        self.match(group)
        if not self.work.has(self.tally_key(group)):
            self.work.get(self.tally_key(group), lambda: self._tallied(group))

    def _tallied(self, group: _Partners) -> Item:
        photo = group.photo
        tally = Tally.of(photo.camera)
        own = self.features.read(photo).keypoints
        matches = _rows_by_partner(self.work.read(self.matches_key(group)))
        asked = []
        for partner, rows in zip(group.partners, matches, strict=True):
            if not self._are_of_one_camera(photo, partner):
                continue
            pixels = own[rows[:, 0]], self.features.read(partner).keypoints[rows[:, 1]]
            if some_keep_their_pixel(photo.camera, *pixels):
                asked.append(pixels)
        for pixels in asked[:: max(1, -(-len(asked) // _MOST_ASKED))]:
            tally.add(
                photo.camera,
                *pixels,
                self.verification.max_error_px,
                calibrated=photo.camera_known,
            )
        return {"against": tally.against, "pairs": tally.pairs, "moved": tally.moved}

    @staticmethod
    def _are_of_one_camera(a: MappingPhoto, b: MappingPhoto) -> bool:
        return a.record.sensor_id == b.record.sensor_id

    def verify(self, group: _Partners) -> None:
        def compute() -> Item:
            matches = _rows_by_partner(self.work.read(self.matches_key(group)))
            own = self.features.read(group.photo).keypoints
            found = []
            for partner, rows in zip(group.partners, matches, strict=True):
                theirs = self.features.read(partner).keypoints
                a, b = own[rows[:, 0]], theirs[rows[:, 1]]
                good = self._verified(group.photo, partner, a, b)
                kept = rows[good]
                found.append(kept if len(kept) >= self.verification.min_matches else kept[:0])
            return _item(found)

        if not self.work.has(self.verified_key(group)):
            self.work.get(self.verified_key(group), compute)

    def _verified(
        self,
        a: MappingPhoto,
        b: MappingPhoto,
        pixels_a: NDArray[np.float32],
        pixels_b: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        if self.verification.poses_known:
            views = View(a.camera, a.pose), View(b.camera, b.pose)
            return fits_poses(views, pixels_a, pixels_b, self.verification.max_error_px)
        return fits_two_views(
            (a.camera, b.camera),
            pixels_a,
            pixels_b,
            self.verification.max_error_px,
            calibrated=a.camera_known and b.camera_known,
        )


def fits_poses(
    views: tuple[View, View],
    pixels_a: NDArray[np.float32],
    pixels_b: NDArray[np.float32],
    max_error_px: float,
) -> NDArray[np.bool_]:
    """Tell which matched pixels (n, 2) fit the epipolar geometry of two known poses."""
    a, b = views
    errors = epipolar_errors(
        normalized_rays(a.camera, pixels_a),
        normalized_rays(b.camera, pixels_b),
        b.cam_from_world @ a.cam_from_world.inverse(),
    )
    focal = max(a.camera.focal_length, b.camera.focal_length)
    return np.asarray(errors * focal <= max_error_px)


def _rows_by_partner(item: Item) -> list[NDArray[np.uint32]]:
    return np.split(item["rows"], item["offsets"][1:-1])


def _item(found: list[NDArray[np.uint32]]) -> Item:
    offsets = np.cumsum([0, *(len(rows) for rows in found)])
    return {"offsets": offsets, "rows": np.concatenate([*found, np.empty((0, 2), np.uint32)])}


def _cells(mask: CameraMask | None) -> JsonValue:
    return None if mask is None else mask.tolist()


def camera_values(camera: Camera) -> list[str | float]:
    """Return all of a camera, as JSON values for a key."""
    return [camera.model, camera.width, camera.height, *camera.params]


def pose_values(pose: Pose) -> list[float]:
    """Return all of a pose, as JSON values for a key."""
    return [*pose.rotation.ravel().tolist(), *pose.translation.tolist()]
