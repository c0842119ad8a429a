from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.errors import InvalidInput
from visloc.features.local.readymade import (
    is_ready_made,
    ready_made_fingerprint,
    ready_made_type,
    to_global_descriptor,
    to_local_features,
)
from visloc.kapture import FeatureSet

KEYPOINTS = np.array([[0.5, 0.5], [10.0, 20.0], [3.0, 4.0]], dtype=np.float32)


def feature_set(metric: str | None = "L2", type_name: str = "D2-Net") -> FeatureSet:
    return FeatureSet(
        "descriptors", type_name, "d2net", np.dtype("<f4"), 512, "D2-Net", metric, Path("f"), None
    )


def test_the_name_tells_ready_made_features() -> None:
    assert is_ready_made("kapture:AP-GeM-LM18")
    assert not is_ready_made("densevlad")
    assert ready_made_type("kapture:AP-GeM-LM18") == "AP-GeM-LM18"
    with pytest.raises(InvalidInput):
        ready_made_type("densevlad")


def test_the_fingerprint_tells_what_the_files_tell() -> None:
    fingerprint = ready_made_fingerprint(feature_set())
    assert (fingerprint.name, fingerprint.revision) == ("kapture:D2-Net", 1)
    assert fingerprint.weights_sha256 is None
    assert dict(fingerprint.parameters) == {
        "dtype": "float32",
        "dsize": 512,
        "metric_type": "l2",
        "method": "d2net",
    }
    assert fingerprint == ready_made_fingerprint(feature_set("l2"))
    assert fingerprint != ready_made_fingerprint(feature_set("cosine"))
    assert fingerprint != ready_made_fingerprint(feature_set(type_name="d2-net"))


@pytest.mark.parametrize("metric", ["Hamming", "", "L1", None])
def test_other_metrics_are_refused_with_those_that_work(metric: str | None) -> None:
    with pytest.raises(InvalidInput, match="L2, cosine or dot") as caught:
        ready_made_fingerprint(feature_set(metric))
    assert caught.value.code == "features.metric"


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32, np.float64])
def test_rows_keep_their_order_and_direction(dtype: type) -> None:
    rows = np.array([[3, 4, 0], [0, 0, 200], [255, 255, 255]], dtype=dtype)
    features = to_local_features(KEYPOINTS, rows)
    assert np.array_equal(features.keypoints, KEYPOINTS)
    assert features.descriptors.dtype == np.float32
    expected = [[0.6, 0.8, 0], [0, 0, 1], [3**-0.5] * 3]
    assert features.descriptors == pytest.approx(np.array(expected), abs=1e-7)
    for ones in (features.scores, features.scales):
        assert ones.dtype == np.float32
        assert ones.tolist() == [1, 1, 1]


def test_an_image_without_keypoints_is_fine() -> None:
    features = to_local_features(KEYPOINTS[:0], np.empty((0, 128), dtype=np.uint8))
    assert len(features) == 0
    assert features.descriptors.shape == (0, 128)


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1.0, 1e200])
def test_length_does_not_matter_however_long(scale: float) -> None:
    vector = to_global_descriptor(np.array([3.0, 4.0]) * scale)
    assert vector.dtype == np.float32
    assert vector == pytest.approx(np.array([0.6, 0.8]), abs=1e-7)


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, -np.inf])
def test_a_row_without_direction_is_refused(bad: float) -> None:
    rows = np.ones((3, 4))
    rows[1] = bad
    with pytest.raises(InvalidInput, match="row 1") as caught:
        to_local_features(KEYPOINTS, rows)
    assert caught.value.code == "features.descriptor"
    with pytest.raises(InvalidInput):
        to_global_descriptor(rows[1])


@pytest.mark.parametrize(
    ("keypoints", "descriptors"),
    [
        (KEYPOINTS[:2], np.ones((3, 4))),
        (KEYPOINTS[:, :1], np.ones((3, 4))),
        (KEYPOINTS, np.ones(3)),
        (KEYPOINTS[0], np.ones((2, 4))),
    ],
)
def test_shapes_that_do_not_fit_are_refused(keypoints: np.ndarray, descriptors: np.ndarray) -> None:
    with pytest.raises(InvalidInput) as caught:
        to_local_features(keypoints, descriptors)
    assert caught.value.code == "features.shape"
    with pytest.raises(InvalidInput):
        to_global_descriptor(np.ones((1, 4)))
