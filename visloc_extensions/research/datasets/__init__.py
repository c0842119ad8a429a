"""Public data sets as their authors publish them, made into mapping and query datasets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from mapping.stages.outputs import complete_output
from visloc.errors import refuse
from visloc.kapture import Dataset, write_dataset
from visloc_extensions.research.datasets.aachen import read_aachen, read_aachen_v1_1
from visloc_extensions.research.datasets.cambridge import read_cambridge
from visloc_extensions.research.datasets.cmu import read_cmu
from visloc_extensions.research.datasets.robotcar import read_robotcar
from visloc_extensions.research.datasets.seven_scenes import read_seven_scenes

# The parts of a data set by name, such as mapping and query; root is the folder of the photos.
Reader = Callable[[Path], Mapping[str, Dataset]]

READERS: Mapping[str, Reader] = {
    "7scenes": read_seven_scenes,
    "cambridge": read_cambridge,
    "aachen": read_aachen,
    "aachen-v1.1": read_aachen_v1_1,
    "robotcar": read_robotcar,
    "cmu": read_cmu,
}
# Sets of the paper without a reader, and why.
WITHOUT_READER: Mapping[str, str] = {
    "inloc": "no public source tells how the pose of a cut-out follows from that of its scan; use "
    "kapture's copy of InLoc as it is",
}


def write_parts(name: str, folder: Path, output: Path) -> Mapping[str, Dataset]:
    """Write a folder for each part of a data set; photos are links to the archive.

    Returns:
        The parts; their notes tell what was left out.
    """
    reader = READERS.get(name)
    if reader is None:
        why = WITHOUT_READER.get(name)
        got = name if why is None else f"{name}: {why}"
        raise refuse("archive.unknown", field="SET", expected=READERS, got=got)
    if not folder.is_dir():
        raise refuse("archive.missing", field=str(folder), expected="the unpacked archive")
    parts = reader(folder)
    with complete_output(output, "import.exists") as partial:
        for part, dataset in parts.items():
            sensors = partial / part / "sensors"
            sensors.mkdir(parents=True)
            (sensors / "records_data").symlink_to(dataset.root.resolve())
            write_dataset(replace(dataset, root=partial / part))
    return parts
