"""The map of the tutorial of the beach finds photos where they were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import visloc
from mapping.cli.main import app
from tests.examples.test_beach import BEACH, fix_of
from visloc.geodesy import enu_from_geodetic
from visloc.types import Localized


@pytest.mark.slow
def test_the_map_finds_photos_where_the_drone_says_it_was(tmp_path: Path) -> None:
    words = ["capture", str(BEACH / "mapping"), "--map", "beach", "--maps-dir", str(tmp_path)]
    done = CliRunner().invoke(app, [*words, "--output", str(tmp_path / "beach.png")])
    assert done.exit_code == 0, done.output
    beach = visloc.open_map("beach", tmp_path)
    geodetic = beach.archive.manifest.world.anchor.geodetic
    assert geodetic is not None
    for photo in sorted((BEACH / "query").glob("*.jpg")):
        answer = beach.localize(photo).answer
        assert isinstance(answer, Localized)
        origin = np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])
        (fix,) = enu_from_geodetic(fix_of(photo)[None], origin)
        # The map's axes are east, north and up. Receivers of drones are good to a metre or two.
        assert np.linalg.norm(answer.cam_from_world.center - fix) < 3.0
