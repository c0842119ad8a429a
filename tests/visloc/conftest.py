"""What rigs see of exact landmarks: the input of ``solve_instant`` and of sequences."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from visloc.geometry import Camera, Pose
    from visloc.localization.map_view.constraints import MapGeometry
    from visloc.localization.solving import Matches, SeenImage

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Place:
    """A place whose landmarks lie wherever a test looks; poses are relative to its origin.

    Pixels are random, with depths of 2 to 10; what is wrong is matched with landmarks anywhere.
    """

    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    down: NDArray[np.float64] | None = None

    @property
    def camera(self) -> Camera:
        from visloc.geometry import Camera

        return Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))

    @property
    def geometry(self) -> MapGeometry:
        """That of a map with one photo, which sees one landmark 5 away."""
        return self.geometry_of([[0.0, 0.0, 0.0]])

    def geometry_of(self, centers: Any) -> MapGeometry:
        """That of a map with photos at these centres, relative to the origin."""
        from visloc.archive.schema import Parts
        from visloc.localization.map_view.constraints import MapGeometry

        local = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
        identity = np.tile([1.0, 0.0, 0.0, 0.0], (len(local), 1))
        opened: Any = SimpleNamespace(
            manifest=SimpleNamespace(
                world=SimpleNamespace(origin=tuple(self.origin)), parts=Parts()
            ),
            gravity=self.down,
            image_poses=np.hstack([identity, -(local + self.origin)]),
            landmarks=(local + np.array([0.0, 0.0, 5.0])).astype(np.float32),
            observation_offsets=np.arange(len(local) + 1),
            has_landmarks=True,
            observation_landmarks=np.arange(len(local)),
        )
        return MapGeometry(opened)

    def to_world(self, local: Pose) -> Pose:
        """A device's pose relative to the origin, as the world has it."""
        from visloc.geometry import Pose

        return Pose(local.rotation, local.translation - local.rotation @ self.origin)

    def matches(
        self, cam_from_local: Pose, right: int, wrong: int = 0, *, seed: int = 0, noise: float = 0.5
    ) -> Matches:
        """Correspondences of one image, the right ones first."""
        from visloc.localization.solving import Matches
        from visloc.pose.reprojection import normalized_rays

        rng = np.random.default_rng(seed)
        pixels = rng.uniform([5, 5], [635, 475], (right + wrong, 2))
        seen = normalized_rays(self.camera, pixels) * rng.uniform(2.0, 10.0, (len(pixels), 1))
        points = cam_from_local.inverse().apply(seen)
        points[right:] = cam_from_local.center + rng.uniform(-8.0, 8.0, (wrong, 3))
        return Matches(pixels + rng.normal(size=pixels.shape) * noise, points)

    def image(
        self,
        matches: Matches | None,
        *,
        sensor: str = "camera",
        cam_from_rig: Pose | None = None,
        elsewhere: Matches | None = None,
        refusal: Any = None,
    ) -> SeenImage:
        """An image with these correspondences; None: one that could not be read."""
        from visloc.errors import InvalidInput
        from visloc.geometry import Pose
        from visloc.localization.solving import Look, Matches, SeenImage
        from visloc.options import ReadAs
        from visloc.types import CameraSource, Evidence

        sits = Pose.identity() if cam_from_rig is None else cam_from_rig
        if matches is None:
            return SeenImage(sensor, sits, None, InvalidInput("image.format", "not an image"))
        evidence = Evidence(
            self.camera,
            CameraSource.GIVEN,
            1,
            ReadAs.STORED,
            num_keypoints=len(matches.pixels),
            num_correspondences=len(matches.pixels),
            seconds={"local_features": 0.5},
        )
        landmarks = np.arange(len(matches.points))
        look = Look(evidence, matches, landmarks, elsewhere or Matches.none(), refusal)
        return SeenImage(sensor, sits, look)


@pytest.fixture
def place() -> Place:
    """Around the world's (0, 0, 0), and nobody knows which way is down."""
    return Place()


@pytest.fixture
def far_place() -> Place:
    """As far from the world's (0, 0, 0) as coordinates of a national grid are."""
    return Place(np.array([1.0e6, -5.0e6, 300.0]))


@pytest.fixture
def hall() -> Place:
    """Its map knows which way is down, -z, and its origin is one million away."""
    return Place(np.array([1.0e6, 1.0e6, 0.0]), DOWN)
