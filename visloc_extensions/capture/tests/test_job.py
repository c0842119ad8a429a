from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.mapping.importers.conftest import panned, texture
from visloc.archive import MapStore
from visloc.errors import Conflict, InvalidInput, Unavailable, WeightsError
from visloc.features import GLOBAL_FEATURES
from visloc.kapture import read_dataset
from visloc_extensions.capture import job
from visloc_extensions.capture.job import capture_map
from visloc_extensions.capture.settings import CaptureSettings


class Killed(Exception):
    """Stands for a signal that ends the process."""


def quiet(*_: object) -> None:
    pass


def test_a_capture_that_was_killed_after_publishing_is_told_and_not_made_again(
    make_video: Callable[..., Path], built_maps: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    maps = tmp_path / "maps"
    store = MapStore(maps)
    ready = MapStore(built_maps)
    (map_id, *_) = ready.ids()

    def published_and_killed(*_: object) -> Path:
        with store.incoming() as incoming:
            shutil.copytree(ready.folder(map_id), incoming, dirs_exist_ok=True)
            store.publish(incoming, map_id, ready.current_version(map_id))
        raise Killed

    monkeypatch.setattr(job, "build_map", published_and_killed)
    settings = CaptureSettings([make_video(panned(20, 12))], map_id, maps)
    with pytest.raises(Killed):
        capture_map(settings, quiet, quiet)
    monkeypatch.setattr(job, "build_map", lambda *_: pytest.fail("it is made already"))
    told = capture_map(settings, quiet, lambda _: pytest.fail("nothing is to be matched"))
    assert told.folder == store.folder(map_id)
    assert next(iter(told.photos)) == "walk/00000.000s.jpg"
    # Another capture is not taken for it, nor the same one after all was told.
    other = CaptureSettings(settings.sources, map_id, maps, photos=5)
    with pytest.raises(Conflict, match="exists"):
        capture_map(other, quiet, quiet)
    (video,) = settings.sources
    written = video.stat().st_mtime_ns
    os.utime(video, ns=(written, written + 1))  # as if it had been filmed again
    with pytest.raises(Conflict, match="exists"):
        capture_map(settings, quiet, quiet)
    os.utime(video, ns=(written, written))
    told.forget()
    with pytest.raises(Conflict, match="exists"):
        capture_map(settings, quiet, quiet)


def test_a_full_disk_is_told_and_the_same_command_goes_on(
    make_video: Callable[..., Path], tmp_path: Path, monkeypatch: Any
) -> None:
    """Files may not grow: as on a full disk, a write fails in the middle."""
    settings = CaptureSettings([make_video(panned(20, 12))], "room", tmp_path / "maps")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, hard))
    try:
        with pytest.raises(Unavailable) as refused:
            capture_map(settings, quiet, quiet)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused.value.code == "storage.failed"
    assert str(tmp_path / "maps") in str(refused.value.field)

    def built(build: Any, *_: object) -> Path:
        raise Killed(len(read_dataset(build.dataset).images))

    monkeypatch.setattr(job, "build_map", built)
    with pytest.raises(Killed, match="20"):
        capture_map(settings, quiet, quiet)


def test_photos_that_do_not_join_are_refused_with_what_to_film_and_what_was_left_out(
    tmp_path: Path,
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    # Of another scale: two textures have corners at the same pixels, which match by chance.
    other = cv2.resize(texture(107, 80, seed=1), (320, 240))
    for name, picture in (("0.png", texture(320, 240)), ("1.png", other)):
        cv2.imwrite(str(photos / name), picture)
    (photos / "broken.jpg").write_bytes(b"no photo")
    with pytest.raises(InvalidInput) as refused:
        capture_map(CaptureSettings([photos], "room", tmp_path / "maps"), quiet, quiet)
    assert refused.value.code == "sfm.no_matches"
    assert "overlaps the next" in str(refused.value)
    assert "--pairs" not in str(refused.value)
    assert any("broken.jpg" in note for note in refused.value.__notes__)


@pytest.mark.parametrize("known_before", [True, False])
def test_a_map_of_unknown_size_is_in_doubt_where_one_in_metres_is_in_use(
    make_video: Callable[..., Path],
    maps_dir: Path,
    tmp_path: Path,
    monkeypatch: Any,
    known_before: bool,
) -> None:
    in_metres = MapStore(maps_dir).open("room")
    world = in_metres.manifest.world.model_copy(update={"metric": False})
    sizeless = replace(in_metres, manifest=in_metres.manifest.model_copy(update={"world": world}))
    doubts: list[Any] = []

    def examined(*given: Any) -> Path:
        *_, examine = given
        doubts.extend(examine(sizeless))
        assert examine(in_metres) == ()
        return in_metres.path

    monkeypatch.setattr(job, "build_map", examined)
    maps = maps_dir if known_before else tmp_path / "no-maps"
    settings = CaptureSettings([make_video(panned(20, 12))], "room", maps, force=True)
    capture_map(settings, quiet, quiet)
    assert [doubt.kind for doubt in doubts] == (["size"] if known_before else [])
    assert all("--scale or --marker-size" in doubt.message for doubt in doubts)


@pytest.mark.parametrize("missing", ["local_features", "global_features"])
def test_missing_weights_are_refused_before_anything_is_read(
    make_video: Callable[..., Path], tmp_path: Path, missing: str, monkeypatch: Any
) -> None:
    maps = tmp_path / "maps"
    of_r2d2 = ("visloc.features.networks.r2d2.load", "load_r2d2")  # whose weights are missing
    monkeypatch.setitem(GLOBAL_FEATURES, "weighted", of_r2d2)
    settings = CaptureSettings([make_video(panned(20, 12))], "room", maps)
    without = {"local_features": "r2d2", "global_features": ("weighted",)}
    with pytest.raises(WeightsError) as refused:
        capture_map(replace(settings, **{missing: without[missing]}), quiet, quiet)
    assert refused.value.code == "weights.missing"
    assert not maps.exists()


def test_an_id_without_room_for_pieces_is_refused_before_the_long_work(
    make_video: Callable[..., Path], tmp_path: Path, monkeypatch: Any
) -> None:
    settings = CaptureSettings([make_video(panned(20, 12))], "a" * 61, tmp_path / "maps")
    monkeypatch.setattr(job, "study_videos", lambda *_: pytest.fail("the video is read"))
    with pytest.raises(InvalidInput) as refused:
        capture_map(settings, quiet, quiet)
    assert refused.value.code == "map.id"
