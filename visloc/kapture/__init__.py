"""Reading and writing kapture datasets: posed photos, depth maps, rigs, GNSS, features, points.

NumPy only.
"""

from visloc.kapture.dataset import Dataset, FileRecord, GnssRecord, Sensor
from visloc.kapture.feature_layout import READY_MADE_PREFIX, FeatureKind
from visloc.kapture.feature_reader import (
    FeatureSet,
    feature_types,
    open_features,
    open_local_features,
)
from visloc.kapture.features import write_global_features, write_keypoints, write_local_features
from visloc.kapture.local_features import read_local
from visloc.kapture.reader import read_dataset
from visloc.kapture.reconstruction import (
    Reconstruction,
    read_reconstruction,
    write_reconstruction,
)
from visloc.kapture.writer import write_dataset

__all__ = [
    "READY_MADE_PREFIX",
    "Dataset",
    "FeatureKind",
    "FeatureSet",
    "FileRecord",
    "GnssRecord",
    "Reconstruction",
    "Sensor",
    "feature_types",
    "open_features",
    "open_local_features",
    "read_dataset",
    "read_local",
    "read_reconstruction",
    "write_dataset",
    "write_global_features",
    "write_keypoints",
    "write_local_features",
    "write_reconstruction",
]
