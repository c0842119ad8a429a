from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from service.values import (
    Abandoned,
    ImageJob,
    MapFolder,
    RigJob,
    SequenceJob,
    Signals,
    WorkerSettings,
    photo_job,
)
from service.workers import open_maps as opening
from service.workers import vision
from service.workers.instants import DecodedQuery
from service.workers.open_maps import OpenMaps
from service.workers.process import _reply_to
from service.workers.vision import Vision
from visloc.archive import MapStore
from visloc.errors import Conflict, InvalidInput, NotFound, WeightsError
from visloc.features import GlobalDescriptor, make_global_descriptor
from visloc.options import Inference, LocalizeOptions, Matcher, Solver
from visloc.priors import NO_PRIORS
from visloc.runtime.threads import count_of_threads, threads
from visloc.types import QueryFeatures

WEIGHTS = Path("weights")
SETTINGS = WorkerSettings(WEIGHTS, 1, 10**9, 8, 8, 10**8, 10**8, Inference.FP32)


def test_global_descriptors_are_made_once_for_all_maps_with_the_settings(
    built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[object, ...]] = []

    def make(*arguments: object) -> GlobalDescriptor:
        made.append(arguments)
        return make_global_descriptor(str(arguments[0]))

    monkeypatch.setattr(opening, "make_global_descriptor", make)
    maps = OpenMaps(SETTINGS, Signals())
    folder = MapStore(built_maps).folder("room")
    for ref in ("room@1", "room@2"):
        maps.localizer(MapFolder(ref, folder))
    settings = (WEIGHTS, Inference.FP32, 1)
    assert made == [("densevlad", *settings), ("localvlad", *settings)]


def test_a_task_computes_with_the_threads_that_it_was_given() -> None:
    one = Vision(SETTINGS, Signals())
    with threads(2):
        reply = pickle.loads(_reply_to(pickle.dumps((methodcaller("ping"), 1)), one))
        assert reply.result == os.getpid()
        assert count_of_threads() == 1
        _reply_to(pickle.dumps((methodcaller("ping"), 2)), one)
        assert count_of_threads() == min(2, len(os.sched_getaffinity(0)))


def test_a_map_whose_descriptor_has_no_weights_here_is_a_conflict(
    built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(*_: object) -> GlobalDescriptor:
        raise WeightsError("weights.missing", "no weights")

    monkeypatch.setattr(opening, "make_global_descriptor", make)
    with pytest.raises(Conflict) as caught:
        OpenMaps(SETTINGS, Signals()).localizer(
            MapFolder("room@1", MapStore(built_maps).folder("room"))
        )
    assert caught.value.code == "weights.missing"


def test_a_version_that_another_replica_removed_is_no_damaged_map(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="the version was removed") as caught:
        OpenMaps(SETTINGS, Signals()).open(MapFolder("room@1", tmp_path / "room" / "1"))
    assert caught.value.code == "map.version"


def test_work_that_was_given_up_ends_when_its_photo_is_decoded(
    open_maps: tuple[Vision, list[MapFolder]], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, maps = open_maps
    given_up = Signals()
    process = Vision(SETTINGS, given_up)

    def decode(*_: object) -> DecodedQuery:
        given_up.abandoned = True
        return DecodedQuery(QueryFeatures("sift", *[np.empty((0, 2))] * 2, {}), {}, {})

    monkeypatch.setattr(vision, "decode", decode)
    image = ImageJob("left", IMAGE, None)
    with pytest.raises(Abandoned):
        process.look_at_image(image, maps, None, LocalizeOptions(), NO_PRIORS, 0.0)


# Options that do not fit


@pytest.fixture(scope="module")
def open_maps(
    built_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Vision, list[MapFolder]]:
    """``room``, and ``hall``, the same without localvlad."""
    maps = tmp_path_factory.mktemp("maps") / "maps"
    shutil.copytree(built_maps, maps)
    shutil.copytree(maps / "room", maps / "hall")
    manifest = MapStore(maps).folder("hall") / "manifest.json"
    record = json.loads(manifest.read_text())
    record["id"] = "hall"
    record["global_features"] = record["global_features"][:1]
    manifest.write_text(json.dumps(record))
    folders = [MapStore(maps).folder(name) for name in ("room", "hall")]
    refs = [MapStore(maps).open(name).ref for name in ("room", "hall")]
    return Vision(SETTINGS, Signals()), [
        MapFolder(ref, folder) for ref, folder in zip(refs, folders, strict=True)
    ]


IMAGE = b"no photo: options are looked at first"


def ask_photo(process: Vision, maps: Sequence[MapFolder], options: LocalizeOptions) -> object:
    return process.localize(photo_job((), IMAGE, None, options), maps, 0.0)


def ask_rig(process: Vision, maps: Sequence[MapFolder], options: LocalizeOptions) -> object:
    images = (ImageJob("left", IMAGE, None),)
    return process.check_rig(RigJob((), "rig", images, None, options), maps)


def ask_sequence(process: Vision, maps: Sequence[MapFolder], options: LocalizeOptions) -> object:
    return process.open_sequence(SequenceJob((), "rig", None, 1.0, options), maps)


@pytest.mark.parametrize("ask", [ask_photo, ask_rig, ask_sequence])
@pytest.mark.parametrize(
    ("options", "field", "refusing"),
    [
        ({"fusion_weights": {"gem": 1.0}}, "options.fusion_weights", ("room", "hall")),
        ({"fusion_weights": {"localvlad": 1.0}}, "options.fusion_weights", ("hall",)),
        ({"matcher": Matcher.LIGHTGLUE}, "options.matcher", ("room", "hall")),
    ],
)
def test_options_that_do_not_fit_one_of_several_maps_are_refused_with_its_name(
    ask: Callable[..., object],
    options: dict[str, Any],
    field: str,
    refusing: tuple[str, ...],
    open_maps: tuple[Vision, list[MapFolder]],
) -> None:
    process, maps = open_maps
    with pytest.raises(InvalidInput) as caught:
        ask(process, maps, LocalizeOptions(**options))
    error = caught.value
    refs = [of.ref for of in maps if of.ref.partition("@")[0] in refusing]
    assert (error.code, error.field) == (field, field)
    assert f"({', '.join(refs)}); in {refs[0]}: " in error.message
    with pytest.raises(InvalidInput) as caught:
        ask(process, maps[1:], LocalizeOptions(**options))
    assert caught.value.code == field
    assert "hall" not in caught.value.message  # the caller has named it


@pytest.mark.parametrize("ask", [ask_rig, ask_sequence])
def test_weights_that_are_not_here_are_no_fault_of_an_image(
    ask: Callable[..., object],
    open_maps: tuple[Vision, list[MapFolder]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def make(_: str) -> NoReturn:
        raise WeightsError("weights.missing", "no weights")

    process, maps = open_maps
    monkeypatch.setattr(process._maps.localizer(maps[0]), "_make_matcher", make)
    with pytest.raises(WeightsError):
        ask(process, maps[:1], LocalizeOptions(matcher=Matcher.LIGHTGLUE))


def test_registration_takes_a_sequence_of_one_camera(
    open_maps: tuple[Vision, list[MapFolder]],
) -> None:
    process, maps = open_maps
    options = LocalizeOptions(solver=Solver.REGISTRATION)
    assert process.open_sequence(SequenceJob((), None, None, 1.0, options), maps)
    with pytest.raises(InvalidInput) as caught:
        ask_sequence(process, maps, options)
    assert caught.value.code == "options.solver"
