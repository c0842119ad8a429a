"""A GNSS fix narrows the search in a map that is tied to the Earth, and is checked afterwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from visloc.archive import Anchor, Geodetic, Map, MapStore
from visloc.archive.places import enu_of, origin_of
from visloc.errors import InvalidInput
from visloc.features import make_local_features
from visloc.geodesy import geodetic_from_enu
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.priors import GnssPrior, Priors
from visloc.types import Answer, Localized, NotLocalized, Reason

# Turned by 60 degrees about the vertical, and shifted.
PLACE = Geodetic(
    latitude_deg=48.1,
    longitude_deg=-8.2,
    altitude_m=412.0,
    rotation_wxyz=(np.cos(np.pi / 6), 0.0, 0.0, np.sin(np.pi / 6)),
    translation=(100.0, -50.0, 3.0),
)


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


@pytest.fixture(scope="module")
def localizer(room: Map) -> Localizer:
    """Of the sample, tied to the Earth."""
    anchor = Anchor(kind="correspondences", images=3, rms=None, geodetic=PLACE)
    world = room.manifest.world.model_copy(update={"anchor": anchor})
    opened = replace(room, manifest=room.manifest.model_copy(update={"world": world}))
    return Localizer(opened, make_local_features("sift"))


def asked(localizer: Localizer, sample: Path, east: float, up: float, **known: float) -> Answer:
    """Ask for the first query, with a fix so many metres beside where it was taken."""
    dataset = read_dataset(sample / "query")
    record = dataset.images[0]
    camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
    assert truth is not None
    there = enu_of(truth.center[None], PLACE) + np.array([east, 0.0, up])
    ((latitude, longitude, altitude),) = geodetic_from_enu(there, origin_of(PLACE))
    fix = GnssPrior(latitude, longitude, 0.5, altitude if known else None, **known)
    photo = read_photo_file(dataset.path_of(record))
    return localizer.localize(photo, camera, LocalizeOptions(), Priors(gnss=fix))


def test_a_fix_within_three_times_its_accuracy_is_obeyed(
    localizer: Localizer, sample: Path
) -> None:
    for east, up, known in (
        (0.0, 0.0, {}),
        (1.4, 90.0, {}),
        (-1.4, 0.5, {"vertical_accuracy": 0.2}),
    ):
        assert isinstance(asked(localizer, sample, east, up, **known), Localized)


def test_a_pose_beyond_it_is_refused(localizer: Localizer, sample: Path) -> None:
    for east, up, known in ((1.8, 0.0, {}), (0.0, 0.9, {"vertical_accuracy": 0.2})):
        answer = asked(localizer, sample, east, up, **known)
        assert isinstance(answer, NotLocalized)
        assert answer.reason is Reason.CONTRADICTS_PRIOR
        assert "GNSS" in answer.message


def test_photos_far_from_the_fix_are_not_searched(localizer: Localizer, sample: Path) -> None:
    answer = asked(localizer, sample, 200.0, 0.0)
    assert isinstance(answer, NotLocalized)
    assert answer.reason is Reason.NO_PHOTO_NEAR


def test_a_map_that_is_nowhere_takes_no_fix(room: Map, sample: Path) -> None:
    localizer = Localizer(room, make_local_features("sift"))
    with pytest.raises(InvalidInput) as caught:
        asked(localizer, sample, 0.0, 0.0)
    assert caught.value.code == "priors.gnss"
