"""One query from pixels, or from features, to answer: the whole pipeline on one screen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from visloc.archive import FingerprintRecord, Map
from visloc.errors import Conflict, InvalidInput
from visloc.features import GlobalDescriptor, LocalFeatureExtractor, make_global_descriptor
from visloc.features.readymade import is_ready_made
from visloc.geometry import Camera
from visloc.images import Photo, stored_from_upright, upright
from visloc.matching.correspondences import match_landmarks
from visloc.pose.absolute import estimate_absolute_pose
from visloc.pose.covariance import position_covariance, with_origin
from visloc.query_features import (
    checked_global_descriptors,
    checked_local_features,
    max_sent_keypoints,
)
from visloc.retrieval.index import Retrieved, retrieve
from visloc.types import (
    DEFAULT_PRESET,
    Answer,
    CameraSource,
    Evidence,
    Fingerprint,
    LocalFeatures,
    Localized,
    LocalizeOptions,
    NotLocalized,
    QueryFeatures,
    ReadAs,
    Reason,
    RegistrationPreset,
    RetrievedImage,
)

# Focal length in units of the longer side when nothing is known: 45 degrees across, between a
# phone's main camera (0.7 to 0.8) and a long lens. It is COLMAP's guess too.
GUESSED_FOCAL = 1.2
# The default max_error_px holds for photos of this longer side and more; for smaller ones it
# shrinks with them. 12 px are so large a part of a photo of 256 px that poses by chance explain
# up to 10 % of the matches.
FULL_ERROR_FROM_PX = 640
# For global descriptors that do not look at the photo.
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)


class Localizer:
    """Localizes photos, or the features of photos, in one map. Safe to use from several threads.

    Args:
        opened: the map.
        extractor: of its local features; None when only features are to be localized, as in maps
            of ready-made features.

    Raises:
        Conflict: ``map.features`` when the map was built with other features than those at hand.
    """

    def __init__(self, opened: Map, extractor: LocalFeatureExtractor | None) -> None:
        self.map = opened
        self._extractor = extractor
        manifest = opened.manifest
        if extractor is not None:
            _check_fingerprint(
                manifest.local_features.fingerprint, extractor.fingerprint, opened.ref
            )
        self._descriptors: dict[str, GlobalDescriptor] = {}  # those that can be computed here
        for record in manifest.global_features:
            name = record.fingerprint.name
            if not is_ready_made(name):
                descriptor = make_global_descriptor(name)
                _check_fingerprint(record.fingerprint, descriptor.fingerprint, opened.ref)
                self._descriptors[name] = descriptor
        self._takes_photos = extractor is not None and len(self._descriptors) == len(
            manifest.global_features
        )
        self._origin = np.array(manifest.world.origin)

    def warm_up(self) -> None:
        """Run once on noise, so that the first query does not pay for the first use."""
        random = np.random.default_rng(0)
        if self._takes_photos:
            noise = random.integers(0, 255, (480, 640, 3), dtype=np.uint8)
            self.localize(Photo(noise), None, LocalizeOptions())
            return
        manifest = self.map.manifest
        num_keypoints = min(1000, max_sent_keypoints(manifest))
        features = QueryFeatures(
            manifest.local_features.fingerprint.name,
            random.uniform(0, 480, (num_keypoints, 2)),
            random.normal(size=(num_keypoints, manifest.local_features.descriptor_dim)),
            {g.fingerprint.name: random.normal(size=g.dim) for g in manifest.global_features},
        )
        camera = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
        self.localize_features(features, camera, LocalizeOptions())

    def localize(self, photo: Photo, camera: Camera | None, options: LocalizeOptions) -> Answer:
        """Estimate the pose of one photo.

        Args:
            photo: pixels as stored.
            camera: its intrinsics, for the pixels as stored; None when unknown.
            options: thresholds and the like.

        Raises:
            InvalidInput: ``camera.size_mismatch``; ``features.required`` when features of the map
                are not computed here.
        """
        if self._extractor is None or not self._takes_photos:
            raise self._features_required()
        used, source = resolve_camera(photo, camera)
        seconds: dict[str, float] = {}
        evidence = Evidence(used, source, photo.exif_orientation, options.read_as, seconds=seconds)
        with _timed(seconds, "local_features"):
            local, rgb = self._find_features(self._extractor, photo, options.read_as)
        return self._answer(local, rgb, {}, evidence, seconds, options)

    def localize_features(
        self, features: QueryFeatures, camera: Camera | None, options: LocalizeOptions
    ) -> Answer:
        """Estimate the pose of the photo whose features these are.

        Args:
            features: of the map's kind; with every global descriptor of the map, but for those
                that are made of local features, which are computed when they are not sent.
            camera: the intrinsics of the photo that the keypoints are of.
            options: thresholds and the like.

        Raises:
            InvalidInput: ``camera.required``, ``options.read_as``, ``features.kind``,
                ``features.keypoints``, ``features.descriptors``, ``features.global_descriptors``.
            TooLarge: ``features.too_many``.
        """
        if camera is None:
            raise InvalidInput(
                "camera.required",
                "features cannot be localized without the camera that they were seen with",
                field="camera",
                expected="its model, size and parameters",
            )
        if options.read_as is not ReadAs.STORED:
            raise InvalidInput(
                "options.read_as",
                "features are taken as they are: turn the photo before they are looked for",
                field="options.read_as",
                expected=ReadAs.STORED,
                got=options.read_as,
            )
        seconds: dict[str, float] = {}
        evidence = Evidence(camera, CameraSource.GIVEN, 1, ReadAs.STORED, seconds=seconds)
        optional = {name for name, d in self._descriptors.items() if not d.needs_image}
        with _timed(seconds, "local_features"):
            local = checked_local_features(features, camera, self.map.manifest)
            sent = checked_global_descriptors(features, self.map.manifest, optional)
        return self._answer(local, _NO_PIXELS, sent, evidence, seconds, options)

    def _answer(
        self,
        local: LocalFeatures,
        rgb: NDArray[np.uint8],
        sent: Mapping[str, NDArray[np.float32]],
        evidence: Evidence,
        seconds: dict[str, float],
        options: LocalizeOptions,
    ) -> Answer:
        """Find the pose from local features; global descriptors not ``sent`` are computed."""
        camera = evidence.camera
        registration = _registration(options, camera)
        evidence = replace(evidence, num_keypoints=len(local))
        if len(local) == 0:
            return NotLocalized(
                evidence,
                "features",
                Reason.NO_KEYPOINTS,
                "the photo shows nothing to hold on to: it is blank, dark, blurred or too small",
            )

        with _timed(seconds, "global_features"):
            query = {
                name: sent[name] if name in sent else self._describe(name, rgb, local)
                for name in self.map.global_descriptors
            }
        with _timed(seconds, "retrieval"):
            retrieved = retrieve(query, self.map.global_descriptors, options.top_k)
        evidence = replace(evidence, retrieved=tuple(self._describe_retrieved(retrieved)))

        with _timed(seconds, "matching"):
            pairs = match_landmarks(
                local.descriptors, (self.map.observations(int(i)) for i in retrieved.images)
            )
        evidence = replace(evidence, num_correspondences=len(pairs))
        if len(pairs) < registration.min_inliers:
            return NotLocalized(
                evidence,
                "matching",
                Reason.TOO_FEW_MATCHES,
                f"only {len(pairs)} keypoints match the map, {registration.min_inliers} are needed",
            )

        with _timed(seconds, "pose"):
            pixels = local.keypoints[pairs.keypoints].astype(np.float64)
            points = self.map.landmarks[pairs.landmarks].astype(np.float64)
            found = estimate_absolute_pose(
                pixels,
                points,
                camera,
                max_error_px=registration.max_error_px,
                seed=options.seed,
            )
        if found is None:
            return NotLocalized(
                evidence, "pose", Reason.NO_POSE, "no camera pose explains the matches"
            )

        evidence = replace(evidence, num_inliers=int(found.inliers.sum()))
        refused = _gate(evidence, registration)
        if refused is not None:
            return NotLocalized(evidence, "gate", *refused)
        if found.covariance is None:
            return NotLocalized(
                evidence,
                "gate",
                Reason.UNCERTAIN_POSE,
                "the matched landmarks leave the pose undetermined: they lie in a line or a spot",
            )
        position_variance = np.diag(position_covariance(found.cam_from_world, found.covariance))
        cam_from_world, covariance = with_origin(
            found.cam_from_world, found.covariance, self._origin
        )
        return Localized(
            evidence=evidence,
            cam_from_world=cam_from_world,
            covariance=covariance,
            position_std=np.sqrt(position_variance),
            orientation_std=np.sqrt(np.diag(covariance)[:3]),
            inlier_keypoints=local.keypoints[pairs.keypoints[found.inliers]],
            inlier_points=points[found.inliers] + self._origin,
        )

    def _find_features(
        self, extractor: LocalFeatureExtractor, photo: Photo, read_as: ReadAs
    ) -> tuple[LocalFeatures, NDArray[np.uint8]]:
        """Features with keypoints in the stored pixels, and the image they were found in."""
        max_keypoints = self.map.manifest.local_features.max_keypoints
        if read_as is ReadAs.STORED or photo.exif_orientation == 1:
            return extractor.extract(photo.rgb, max_keypoints=max_keypoints), photo.rgb
        rgb = upright(photo.rgb, photo.exif_orientation)
        local = extractor.extract(rgb, max_keypoints=max_keypoints)
        keypoints = stored_from_upright(
            local.keypoints, photo.exif_orientation, photo.width, photo.height
        )
        return replace(local, keypoints=keypoints), rgb

    def _describe(
        self, name: str, rgb: NDArray[np.uint8], local: LocalFeatures
    ) -> NDArray[np.float32]:
        return self._descriptors[name].describe(rgb, local, self.map.global_models[name])

    def _features_required(self) -> InvalidInput:
        manifest = self.map.manifest
        names = (g.fingerprint.name for g in manifest.global_features)
        return InvalidInput(
            "features.required",
            "the map's features are not computed here: send the features of the photo instead",
            field="image",
            expected=f"features of kind {manifest.local_features.fingerprint.name}, with "
            + ", ".join(names),
            got="a photo",
        )

    def _describe_retrieved(self, retrieved: Retrieved) -> Iterator[RetrievedImage]:
        for rank, image in enumerate(retrieved.images):
            yield RetrievedImage(
                name=self.map.images[image].name,
                score=float(retrieved.scores[rank]),
                similarities={
                    name: float(values[rank]) for name, values in retrieved.similarities.items()
                },
            )


def resolve_camera(photo: Photo, given: Camera | None) -> tuple[Camera, CameraSource]:
    """Choose the intrinsics of a photo: given, else EXIF's focal length, else a guess.

    A camera given for another size of the same aspect is scaled to the photo.

    Raises:
        InvalidInput: ``camera.size_mismatch``.
    """
    width, height = photo.width, photo.height
    if given is None:
        known = photo.focal_length_px is not None
        focal = photo.focal_length_px or GUESSED_FOCAL * max(width, height)
        camera = Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))
        return camera, CameraSource.EXIF if known else CameraSource.GUESS
    if (given.width, given.height) == (width, height):
        return given, CameraSource.GIVEN
    if given.has_aspect_of(width, height):
        return given.scaled(width, height), CameraSource.GIVEN_SCALED
    turned = photo.exif_orientation >= 5 and given.has_aspect_of(height, width)
    raise InvalidInput(
        "camera.size_mismatch",
        "the camera is not for this photo"
        + (
            "; the photo is stored turned (EXIF orientation "
            f"{photo.exif_orientation}) and the camera must be that of the stored pixels"
            if turned
            else ""
        ),
        field="camera",
        expected=f"{width} x {height} or another size of the same aspect",
        got=f"{given.width} x {given.height}",
    )


def _registration(options: LocalizeOptions, camera: Camera) -> RegistrationPreset:
    """The thresholds for a photo: the default's inlier distance shrinks with a small photo."""
    registration = options.registration
    if options.preset != DEFAULT_PRESET or options.max_error_px is not None:
        return registration
    share = min(1.0, max(camera.width, camera.height) / FULL_ERROR_FROM_PX)
    return replace(registration, max_error_px=registration.max_error_px * share)


def _gate(evidence: Evidence, registration: RegistrationPreset) -> tuple[Reason, str] | None:
    """Why a pose is not believed, or None (docs/decisions/0002-refuse-instead-of-guess.md)."""
    if evidence.num_inliers < registration.min_inliers:
        return (
            Reason.TOO_FEW_INLIERS,
            f"the best pose explains {evidence.num_inliers} matches, "
            f"{registration.min_inliers} are needed; is this photo of the mapped place?",
        )
    if evidence.inlier_ratio < registration.min_inlier_ratio:
        return (
            Reason.LOW_INLIER_RATIO,
            f"the best pose explains {evidence.inlier_ratio:.1%} of the matches, "
            f"{registration.min_inlier_ratio:.1%} are needed; is this photo of the mapped place?",
        )
    return None


def _check_fingerprint(built_with: FingerprintRecord, at_hand: Fingerprint, ref: str) -> None:
    there, here = _flat(built_with), _flat(FingerprintRecord.of(at_hand))
    differing = [name for name in {**there, **here} if there.get(name) != here.get(name)]
    if not differing:
        return
    raise Conflict(
        "map.features",
        f"map {ref} was built with another {built_with.name}; use the weights and the version of "
        "visloc that built it, or build it again",
        field="weights_dir" if "weights_sha256" in differing else "map",
        expected=", ".join(f"{name} {there.get(name)}" for name in differing),
        got=", ".join(f"{name} {here.get(name)}" for name in differing),
    )


def _flat(record: FingerprintRecord) -> dict[str, int | float | str | None]:
    return {
        "name": record.name,
        "revision": record.revision,
        "weights_sha256": record.weights_sha256,
        **record.parameters,
    }


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = perf_counter()
    yield
    seconds[stage] = perf_counter() - start
