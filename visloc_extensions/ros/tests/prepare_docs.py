"""Make what the page starts from, in the folder of ``tests.docs_check``."""

from pathlib import Path

from visloc.kapture import read_dataset
from visloc_extensions.ros.tests.rosbags_made import write_bag

write_bag(Path("walk.bag"), read_dataset(Path("small/mapping")), ros1=True)
