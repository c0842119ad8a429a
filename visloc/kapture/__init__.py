"""Reading and writing kapture datasets: posed photos, depth maps, rigs, GNSS. NumPy only."""

from visloc.kapture.dataset import Dataset, FileRecord, GnssRecord, Sensor
from visloc.kapture.features import write_global_features, write_local_features
from visloc.kapture.reader import read_dataset
from visloc.kapture.writer import write_dataset

__all__ = [
    "Dataset",
    "FileRecord",
    "GnssRecord",
    "Sensor",
    "read_dataset",
    "write_dataset",
    "write_global_features",
    "write_local_features",
]
