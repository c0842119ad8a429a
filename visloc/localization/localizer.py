"""Localize queries in one map, from pixels or from features to the answer.

``look`` matches one image with the map, ``solve`` finds one pose from all images of an instant. A
photo on its own is a rig of one camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.errors import VislocError, refuse
from visloc.features import GlobalDescriptor, LocalFeatureExtractor, make_global_descriptor
from visloc.features.framing import Framing
from visloc.features.local.readymade import is_ready_made
from visloc.features.networks.lightglue.load import make_lightglue
from visloc.geometry import Camera
from visloc.localization.acceptance.evidence import Shown
from visloc.localization.acceptance.rivals import Proposed
from visloc.localization.coarse import CoarsePoses
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.localization.photo_answer import photo_answer
from visloc.localization.places import solve_photo
from visloc.localization.query.camera import map_cameras, query_resolution, resolve_camera
from visloc.localization.query.feature_cache import FeatureCache, find_features
from visloc.localization.query.features import (
    checked_global_descriptors,
    checked_local_features,
    max_sent_keypoints,
)
from visloc.localization.query.fingerprints import check_fingerprint
from visloc.localization.query.named_photos import NamedPhotos
from visloc.localization.rematching import Rematching, seen_as_found
from visloc.localization.sent_matches import SentMatches, sent_matches
from visloc.localization.solving import (
    Look,
    Matches,
    SeenImage,
    Solved,
    check_solver,
    solve_instant,
)
from visloc.localization.turning import TurnFinder
from visloc.matching.correspondences import (
    CLEAR_RATIO,
    Correspondences,
    Proposals,
    propose_landmarks,
)
from visloc.matching.products import round_descriptors, start_threads
from visloc.options import Fallback, LocalizeOptions, Matcher, ReadAs
from visloc.photos.reading import Photo
from visloc.priors import NO_PRIORS, Priors
from visloc.retrieval.fusion import LateFusion, chosen_fusion
from visloc.retrieval.index import Retrieved, compare, excluded_photos, retrieve
from visloc.runtime.threads import timed
from visloc.types import (
    Answer,
    CameraSource,
    Evidence,
    LocalFeatures,
    Localized,
    QueryFeatures,
    Reason,
    Refusal,
    RetrievedImage,
)

if TYPE_CHECKING:
    from visloc.features.networks.lightglue.torch import LightGlue

_PHOTOS_TO_WARM_UP = 2
# For global descriptors that do not look at the photo.
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Features:
    """The features of one query.

    Attributes:
        local: with keypoints in the stored pixels, reduced by ``reduced``.
        sent: global descriptors by name; missing ones are computed.
        rgb: (height, width, 3) pixels for descriptors that look at them.
        seconds: of ``evidence``, to be added to.
        reduced: how many stored pixels each side of a pixel of the keypoints spans.
        matches: that were sent; None to match here.
    """

    local: LocalFeatures
    sent: Mapping[str, NDArray[np.float32]]
    rgb: NDArray[np.uint8]
    evidence: Evidence
    seconds: dict[str, float]
    reduced: float
    matches: SentMatches | None = None


class Localizer:
    """Localizes photos, or features of photos, in one map. Safe to use from several threads.

    Args:
        extractor: of its local features; None to localize features only, as in maps of ready-made
            ones.
        make_matcher: makes the network of ``Matcher.LIGHTGLUE`` by the name of local features;
            called by each query that uses it.
    """

    def __init__(
        self,
        opened: Map,
        extractor: LocalFeatureExtractor | None,
        make_descriptor: Callable[[str], GlobalDescriptor] = make_global_descriptor,
        make_matcher: Callable[[str], LightGlue] = make_lightglue,
    ) -> None:
        self.map = opened
        self._make_matcher = make_matcher
        self._extractor = extractor
        manifest = opened.manifest
        if extractor is not None:
            check_fingerprint(
                manifest.local_features.fingerprint, extractor.fingerprint, opened.ref
            )
        self._descriptors: dict[str, GlobalDescriptor] = {}  # those that can be computed here
        for record in manifest.global_features:
            name = record.fingerprint.name
            if not is_ready_made(name):
                descriptor = make_descriptor(name)
                check_fingerprint(record.fingerprint, descriptor.fingerprint, opened.ref)
                self._descriptors[name] = descriptor
        self._named = NamedPhotos(opened)
        self.geometry = MapGeometry(opened)
        self.map_cameras = map_cameras(opened)
        self._coarse = CoarsePoses(self.geometry)
        self.turns = (
            None if extractor is None else TurnFinder(self.geometry, extractor, self._descriptors)
        )
        start_threads()

    def warm_up(self) -> None:
        """Run once on noise, so that the first query does not pay for the first use.

        Noise would be refused, then turned, and searched for a focal length. Only the way of a
        photo that shows the map is run, and with few mapping photos: more are no other code.
        """
        _ = self.geometry.reach  # computed once; answers carry it
        random = np.random.default_rng(0)
        camera = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
        options = LocalizeOptions(top_k=_PHOTOS_TO_WARM_UP, read_as=ReadAs.STORED)
        if self._takes_photos(self.map.fusion):
            noise = random.integers(0, 255, (480, 640, 3), dtype=np.uint8)
            self.localize(Photo(noise), camera, options)
            return
        manifest = self.map.manifest
        num_keypoints = min(1000, max_sent_keypoints(manifest))
        features = QueryFeatures(
            manifest.local_features.fingerprint.name,
            random.uniform(0, 480, (num_keypoints, 2)),
            random.normal(size=(num_keypoints, manifest.local_features.descriptor_dim)),
            {g.fingerprint.name: random.normal(size=g.dim) for g in manifest.global_features},
        )
        self.localize_features(features, camera, options)

    def check(self, options: LocalizeOptions, num_cameras: int = 1) -> None:
        """Refuse options that do not fit the map, before any work.

        Args:
            options: of a query.
            num_cameras: cameras of the rig; 1 for a camera on its own.
        """
        self._fusion(options)
        self._named.rows(options.photos or ())
        check_solver(options, num_cameras)
        if options.matcher is Matcher.LIGHTGLUE:
            self._make_matcher(self.map.manifest.local_features.fingerprint.name)

    def localize(
        self,
        photo: Photo,
        camera: Camera | None,
        options: LocalizeOptions,
        priors: Priors = NO_PRIORS,
        cache: FeatureCache | None = None,
    ) -> Answer:
        """Estimate the pose of one photo.

        Args:
            photo: pixels as stored.
            camera: its intrinsics, for the pixels as stored; None when unknown.
            options: thresholds and the like.
            priors: what is known of the camera.
            cache: features of this photo that localizers of other maps found.
        """
        cache = {} if cache is None else cache
        look = self.look(photo, camera, options, priors, cache)
        answer = self._answer(look, options, priors)
        if isinstance(answer, Localized):
            return answer
        assert self.turns is not None  # the photo was looked at
        turned = self.turns.find(photo, answer.evidence, answer.reason, options, priors, cache)
        if turned == 0:
            return answer
        look = self.look(photo, camera, options, priors, cache, turned)
        again = self._answer(look, options, priors)
        # If this is refused too, its retrieved photos are still held as the photo is.
        return again if isinstance(again, Localized) else replace(answer, coarse=again.coarse)

    def localize_features(
        self,
        features: QueryFeatures,
        camera: Camera | None,
        options: LocalizeOptions,
        priors: Priors = NO_PRIORS,
    ) -> Answer:
        """Estimate the pose of the photo whose features these are.

        Args:
            features: of the map's kind, with every global descriptor that counts. Those made of
                local features may be left out and are then computed.
            camera: the intrinsics of the photo that the keypoints are of.
            options: thresholds and the like.
            priors: what is known of the camera.
        """
        look = self.look_at_features(features, camera, options, priors)
        return self._answer(look, options, priors)

    def look(
        self,
        photo: Photo,
        camera: Camera | None,
        options: LocalizeOptions,
        priors: Priors = NO_PRIORS,
        cache: FeatureCache | None = None,
        turned: int = 0,
        *,
        alone: bool = True,
    ) -> Look:
        """Match a photo with the map, as ``localize``.

        ``turned`` is what ``turns`` found, or 0; ``alone`` is false for a photo of a rig.
        """
        fusion = self._fusion(options)
        if self._extractor is None or not self._takes_photos(fusion):
            raise self._features_required(fusion)
        constraints = Constraints(self.geometry, priors)
        used, source = resolve_camera(photo, camera, self.map_cameras, alone=alone)
        seconds: dict[str, float] = {}
        evidence = Evidence(used, source, photo.exif_orientation, options.orientation)
        evidence = replace(evidence, turned=turned, seconds=seconds)
        resolution, mapped = query_resolution(used, source), self.geometry.resolution
        with timed(seconds, "local_features"):
            most = self.map.manifest.local_features.max_keypoints
            size = mapped.feature_size(resolution, photo.width, photo.height, turned)
            framing = Framing(size, turned)
            local, rgb = find_features(photo, self._extractor, most, options, cache, framing)
        reduced = mapped.finer(resolution)
        found = _Features(local.reduced(reduced), {}, rgb, evidence, seconds, reduced)
        return self._match(found, options, fusion, constraints)

    def look_at_features(
        self,
        features: QueryFeatures,
        camera: Camera | None,
        options: LocalizeOptions,
        priors: Priors = NO_PRIORS,
    ) -> Look:
        """Match features with the map; arguments and errors as for ``localize_features``."""
        if camera is None:
            raise refuse(
                "camera.required", field="camera", expected="its model, size and parameters"
            )
        fusion = self._fusion(options)
        constraints = Constraints(self.geometry, priors)
        seconds: dict[str, float] = {}
        evidence = Evidence(camera, CameraSource.GIVEN, 1, ReadAs.STORED, seconds=seconds)
        optional = {name for name, d in self._descriptors.items() if not d.needs_image}
        optional |= set(self.map.global_descriptors).difference(
            fusion.counted(self.map.global_descriptors)
        )
        with timed(seconds, "local_features"):
            local = checked_local_features(features, camera, self.map.manifest)
            sent = checked_global_descriptors(features, self.map.manifest, optional)
        seen = query_resolution(camera, CameraSource.GIVEN)
        reduced = self.geometry.resolution.finer(seen)
        self._named.check_matched(features.matches)
        matches = sent_matches(features, local)
        local = local.reduced(reduced)
        found = _Features(local, sent, _NO_PIXELS, evidence, seconds, reduced, matches)
        return self._match(found, options, fusion, constraints)

    def solve(
        self,
        images: Sequence[SeenImage],
        options: LocalizeOptions,
        priors: Priors = NO_PRIORS,
        timestamp: int | None = None,
    ) -> Solved:
        """Find one pose from all images of an instant, as ``solve_instant``."""
        return solve_instant(images, self.geometry, options, priors, timestamp)

    def solve_look(
        self, look: Look, options: LocalizeOptions, priors: Priors = NO_PRIORS
    ) -> tuple[Answer, NDArray[np.bool_]]:
        """Find the pose of one photo that was matched.

        Args:
            options: those that it was matched with.
            priors: what is known of the camera.

        Returns:
            The answer, and for each match (n,) whether the best pose explains it, even if that pose
            was refused.
        """
        solved = self.solve([SeenImage.alone(look)], options, priors)
        return photo_answer(look, solved, self.geometry.origin)

    def _answer(self, look: Look, options: LocalizeOptions, priors: Priors) -> Answer:
        """Find the pose of one photo."""
        image, solved = solve_photo(SeenImage.alone(look), self.geometry, options, priors)
        return photo_answer(image.look or look, solved, self.geometry.origin)[0]

    def _match(
        self,
        features: _Features,
        options: LocalizeOptions,
        fusion: LateFusion,
        constraints: Constraints,
    ) -> Look:
        """Retrieve mapping images and match the local features with their landmarks."""
        local, evidence, seconds = features.local, features.evidence, features.seconds
        rematching = None
        if options.matcher is Matcher.LIGHTGLUE:
            network = self._make_matcher(self.map.manifest.local_features.fingerprint.name)
            seen = seen_as_found(local, evidence, features.reduced)
            rematching = Rematching(network, self.geometry, seen)
        evidence = replace(evidence, num_keypoints=len(local))
        if len(local) == 0:
            why = "no keypoints were found: the photo is blank, dark, blurred or too small"
            refusal = Refusal("features", Reason.NO_KEYPOINTS, why)
            # Other cameras of the rig may show two places.
            return replace(Look.nothing(evidence, refusal), proposed=Proposed.none(local))
        with timed(seconds, "global_features"):
            query = {
                name: self._describe(name, features)
                for name in fusion.counted(self.map.global_descriptors)
            }
        with timed(seconds, "retrieval"):
            index, weights = self.map.global_descriptors, constraints.photo_weights
            if options.photos is None:
                retrieved = retrieve(query, index, options.top_k, weights, fusion)
            else:
                retrieved = compare(query, index, self._named.rows(options.photos), weights, fusion)
            elsewhere = excluded_photos(query, index, retrieved, weights, fusion)
        if len(retrieved.images) == 0:
            why = "the map has no photo in the area that the priors allow"
            return Look.nothing(evidence, Refusal("retrieval", Reason.NO_PHOTO_NEAR, why))
        evidence = replace(evidence, retrieved=tuple(self._describe_retrieved(retrieved)))
        coarse = None
        if options.fallback is Fallback.COARSE:
            with timed(seconds, "coarse"):
                coarse = self._coarse.approximate(
                    query, retrieved.images, fusion, evidence, constraints
                )
        with timed(seconds, "matching"):
            shown = Shown(local.keypoints, round_descriptors(local.descriptors))
            ratio = CLEAR_RATIO if options.matcher is Matcher.RATIO else None
            sent = features.matches
            pairs = self._match_photos(shown, retrieved.images, ratio, sent or rematching)
            others = self._match_photos(shown, elsewhere, ratio, sent or rematching)
        matched, points = pairs.settled(), self.geometry.points(pairs.landmarks)
        matches = self._matches(shown, matched)
        evidence = replace(evidence, num_correspondences=len(matches.pixels))
        return Look(
            evidence,
            matches,
            matched.landmarks,
            self._matches(shown, others.settled()),
            shown=shown,
            proposed=Proposed(shown, pairs, points, retrieved.images, ratio),
            reduced=features.reduced,
            coarse=coarse,
        )

    def _match_photos(
        self,
        shown: Shown,
        photos: NDArray[np.int64],
        ratio: float | None,
        rematching: SentMatches | Rematching | None,
    ) -> Proposals:
        """Match with the landmarks that these photos see, best photo first."""
        if isinstance(rematching, SentMatches):
            return rematching.propose(self.geometry, photos.tolist())
        return propose_landmarks(
            shown.descriptors,
            (self.geometry.observed(photo) for photo in photos),
            ratio,
            None if rematching is None else lambda rank: rematching.match(int(photos[rank])),
        )

    def _matches(self, shown: Shown, pairs: Correspondences) -> Matches:
        return Matches(
            shown.keypoints[pairs.keypoints].astype(np.float64),
            self.geometry.points(pairs.landmarks).astype(np.float64),
        )

    def _describe(self, name: str, features: _Features) -> NDArray[np.float32]:
        if name in features.sent:
            return features.sent[name]
        descriptor, model = self._descriptors[name], self.map.global_models[name]
        return descriptor.describe(features.rgb, features.local, model)

    def _fusion(self, options: LocalizeOptions) -> LateFusion:
        return chosen_fusion(options, self.map.fusion, self.map.global_descriptors)

    def _takes_photos(self, fusion: LateFusion) -> bool:
        """Whether all features of photos that count can be computed here."""
        counted = fusion.counted(self.map.global_descriptors)
        return self._extractor is not None and set(counted) <= set(self._descriptors)

    def _features_required(self, fusion: LateFusion) -> VislocError:
        names = ", ".join(fusion.counted(self.map.global_descriptors))
        kind = self.map.manifest.local_features.fingerprint.name
        expected = f"features of kind {kind}, with {names}"
        return refuse("features.required", field="image", expected=expected, got="a photo")

    def _describe_retrieved(self, retrieved: Retrieved) -> Iterator[RetrievedImage]:
        for rank, image in enumerate(retrieved.images):
            similarities = {name: float(row[rank]) for name, row in retrieved.similarities.items()}
            score = float(retrieved.scores[rank])
            yield RetrievedImage(self.map.images[image].name, score, similarities)
