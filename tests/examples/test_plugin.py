"""The example package is installed as a stranger would, and its names work in the commands."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mapping.sample import write_sample

PLUGIN = Path(__file__).parents[2] / "examples" / "plugin"
LOCALIZE = """
import sys
from pathlib import Path
from service.values import MapFolder, Signals, WorkerSettings, photo_job
from service.workers.vision import Vision
from visloc.archive import MapStore
from visloc.kapture import read_dataset
from visloc.options import (LocalizeOptions)

maps_dir, queries = Path(sys.argv[1]), read_dataset(Path(sys.argv[2]))
opened = MapStore(maps_dir).open("room")
served = MapFolder(opened.ref, MapStore(maps_dir).folder("room"))
settings = WorkerSettings(None, 1, 10**9, 8, 8, 10**8, 10**8)
record = queries.images[0]
job = photo_job(
    (), queries.path_of(record).read_bytes(), queries.sensors[record.sensor_id].camera,
    LocalizeOptions(),
)
answer = Vision(settings, Signals()).localize(job, [served], 0.0).answer
print(*answer.pose.rig_from_world.center - queries.pose(record).center)
print(*answer.images[0].evidence.retrieved[0].similarities)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed package, built from a copy of its sources."""
    sources = tmp_path_factory.mktemp("sources") / "plugin"
    shutil.copytree(PLUGIN, sources, ignore=shutil.ignore_patterns("__pycache__"))
    target = tmp_path_factory.mktemp("installed")
    offline = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    pip = [sys.executable, "-m", "pip", "install", *offline, "--target", str(target), str(sources)]
    subprocess.run(pip, check=True, capture_output=True, timeout=100)
    return target


def python(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join([str(installed), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths, "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=100
    )


def test_a_map_of_an_installed_plugin_is_built_and_localized_in(
    installed: Path, tmp_path: Path
) -> None:
    sample, maps_dir = tmp_path / "sample", tmp_path / "maps"
    write_sample(sample, images=12, size=(320, 240))
    features = "--local-features example-orb --global-features example-thumbnail"
    build = f"build {sample}/mapping --map room --maps-dir {maps_dir} {features} --workers 2"
    built = python(installed, "-m", "mapping.cli.main", *build.split())
    assert built.returncode == 0, built.stderr

    localized = python(installed, "-c", LOCALIZE, str(maps_dir), str(sample / "query"))
    assert localized.returncode == 0, localized.stderr
    offset, names = localized.stdout.splitlines()
    assert max(abs(float(metres)) for metres in offset.split()) < 0.05
    assert names == "example-thumbnail"


def test_names_of_installed_plugins_are_offered(installed: Path) -> None:
    said = python(installed, "-m", "mapping.cli.main", "build", "--help").stdout
    assert "example-orb" in said
    assert "example-thumbnail" in said
