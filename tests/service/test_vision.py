from __future__ import annotations

import ctypes
from pathlib import Path

import pytest

from service import vision
from service.vision import Vision
from service.worker import MapFolder, WorkerSettings
from visloc.archive import MapStore
from visloc.errors import Conflict, WeightsError
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.types import Inference

WEIGHTS = Path("weights")
SETTINGS = WorkerSettings(WEIGHTS, 1, 10**9, 8, 8, 10**8, 10**8, Inference.FP32)


def test_global_descriptors_are_made_once_for_all_maps_with_the_settings(
    built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[object, ...]] = []

    def make(*arguments: object) -> GlobalDescriptor:
        made.append(arguments)
        return make_global_descriptor(str(arguments[0]))

    monkeypatch.setattr(vision, "make_global_descriptor", make)
    process = Vision(SETTINGS, ctypes.c_bool())
    folder = MapStore(built_maps).folder("room")
    for ref in ("room@1", "room@2"):
        process.localizer(MapFolder(ref, folder))
    settings = (WEIGHTS, Inference.FP32, 1)
    assert made == [("densevlad", *settings), ("localvlad", *settings)]


def test_a_map_whose_descriptor_has_no_weights_here_is_a_conflict(
    built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(*_: object) -> GlobalDescriptor:
        raise WeightsError("weights.missing", "no weights")

    monkeypatch.setattr(vision, "make_global_descriptor", make)
    with pytest.raises(Conflict) as caught:
        Vision(SETTINGS, ctypes.c_bool()).localizer(
            MapFolder("room@1", MapStore(built_maps).folder("room"))
        )
    assert caught.value.code == "weights.missing"
