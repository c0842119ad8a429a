"""A film in which a poster walks through the painted room, mapped as users map it."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.moving import NUM_PHOTOS, SIZE, built, write_photos
from samples.trajectories import mapping_trajectory, stereo_rig
from visloc.archive import MapStore


@pytest.mark.slow
def test_a_map_that_something_moving_bent_is_not_put_into_use(tmp_path: Path) -> None:
    mounted = stereo_rig(*SIZE)["left"].cam_from_rig
    true = [mounted @ pose for pose in mapping_trajectory(NUM_PHOTOS)]
    assert 0.1 < write_photos(tmp_path / "photos", "crossing:0.4", true) < 0.2
    opened = built(tmp_path, true, "estimate")
    assert opened is not None
    assert MapStore(tmp_path / "maps").ids() == []
    doubts = {doubt.kind: doubt for doubt in opened.manifest.parts.doubts}
    assert "contradict the poses" in doubts["matches"].message
    assert set(doubts["matches"].photos) <= {f"{number:02}.png" for number in range(NUM_PHOTOS)}
