"""``localize batch --matches-dir``: matches of another program are sent with the features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clients.evaluation.queries import Query
from clients.evaluation.readers import FeatureReader
from clients.evaluation.sent_matches import PhotoMatches
from visloc.errors import DatasetError
from visloc.geometry import Camera, PixelOrigin
from visloc.kapture import open_local_features, write_local_features
from visloc.kapture.matches import open_matches, write_matches

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
PAIRS = {"query/q.jpg": ("db/a.jpg", "db/b.jpg", "db/none.jpg")}


@pytest.fixture
def reader(tmp_path: Path) -> FeatureReader:
    random = np.random.default_rng(0)
    for number, name in enumerate(("query/q.jpg", "db/a.jpg", "db/b.jpg")):
        keypoints = random.uniform(10, 400, (5 + number, 2)).astype(np.float32)
        descriptors = random.normal(size=(5 + number, 4)).astype(np.float32)
        write_local_features(tmp_path, "sp", name, keypoints, descriptors, name="sp")
    folder = tmp_path / "reconstruction" / "matches" / "sp"
    write_matches(folder, "query/q.jpg", "db/a.jpg", np.array([[1, 5], [4, 0]]))
    write_matches(folder, "query/q.jpg", "db/b.jpg", np.array([[2, 6]]))
    matches = PhotoMatches(open_matches(folder), PAIRS)
    files = open_local_features(tmp_path, "sp")
    return FeatureReader("kapture:sp", *files, {}, PixelOrigin.CENTER, matches)


def test_rows_become_pixels_of_the_mapping_photo(reader: FeatureReader) -> None:
    sent = reader(Query("query/q.jpg", Path(), CAMERA, None))
    assert list(sent.matches) == list(PAIRS["query/q.jpg"])
    theirs = reader.keypoints.read("db/a.jpg")[:, :2] + 0.5  # from the centre of the first pixel
    found = sorted(sent.matches["db/a.jpg"].tolist())
    np.testing.assert_allclose(found, [[1, *theirs[5]], [4, *theirs[0]]])
    assert sent.matches["db/b.jpg"].shape == (1, 3)
    # A pair without a file has no match, which is not the same as no word about it.
    assert sent.matches["db/none.jpg"].shape == (0, 3)
    again = type(sent)(sent.kind, sent.keypoints, sent.descriptors, {}, sent.matches).as_json()
    assert again["matches"]["db/a.jpg"]["shape"] == [2, 3]


def test_a_row_that_the_mapping_photo_does_not_have_is_refused(
    reader: FeatureReader, tmp_path: Path
) -> None:
    folder = tmp_path / "reconstruction" / "matches" / "sp"
    write_matches(folder, "query/q.jpg", "db/a.jpg", np.array([[1, 6]]))
    with pytest.raises(DatasetError) as caught:
        reader(Query("query/q.jpg", Path(), CAMERA, None))
    assert caught.value.code == "kapture.match_values"
    assert "row 6 of the 6 keypoints of db/a.jpg" in str(caught.value)
