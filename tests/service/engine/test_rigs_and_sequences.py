"""Rigs, sequences, and photos in several maps."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.engine.engine import Engine
from service.values import ImageJob, InstantJob, Localization, RigJob, SequenceJob
from tests.service.engine.engines import (
    Query,
    WithEngine,
    held_back,
    job_for,
    make,
    publish,
    started,
    until,
)
from visloc.archive import MapStore
from visloc.errors import InvalidInput, NotFound, Overloaded, TooLarge, Unavailable
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.options import LocalizeOptions
from visloc.priors import NO_PRIORS, GravityPrior, PositionPrior, Priors
from visloc.sequences.filling import Odometry, TimeUnit
from visloc.types import PoseSource, Reason, RigSensor

FAST = LocalizeOptions(top_k=4)


@dataclass(frozen=True)
class RigPhotos:
    """One instant of the sample's rig."""

    photos: dict[str, bytes]
    sensors: dict[str, RigSensor]
    rig_from_world: Pose


@pytest.fixture(scope="module")
def rig_photos(sample: Path) -> RigPhotos:
    dataset = read_dataset(sample / "query")
    first = dataset.images[0].timestamp
    records = {r.sensor_id: r for r in dataset.images if r.timestamp == first}
    sensors = {
        name: RigSensor(dataset.rigs["rig"][name], dataset.sensors[name].camera) for name in records
    }
    pose = dataset.pose(records["left"])
    assert pose is not None
    return RigPhotos(
        {name: dataset.path_of(record).read_bytes() for name, record in records.items()},
        sensors,
        sensors["left"].cam_from_rig.inverse() @ pose,
    )


def blank() -> bytes:
    return cv2.imencode(".png", np.full((192, 256), 128, np.uint8))[1].tobytes()


def scramble(maps_dir: Path, map_id: str) -> None:
    """Mix up the landmarks of a map: nothing is localized in it."""
    path = MapStore(maps_dir).folder(map_id) / "landmarks.npy"
    np.save(path, np.random.default_rng(0).permutation(np.load(path)))


def rig_job(rig_photos: RigPhotos, **changes: Any) -> RigJob:
    images = tuple(ImageJob(name, photo, None) for name, photo in rig_photos.photos.items())
    job = RigJob(("room",), rig_photos.sensors, images, 5, FAST)
    return replace(job, **changes)


@pytest.fixture(scope="module")
def with_two_maps(
    built_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WithEngine]:
    """An engine with ``room``, and ``hall``, whose landmarks are mixed up."""
    maps_dir = tmp_path_factory.mktemp("two") / "maps"
    shutil.copytree(built_maps, maps_dir)
    publish(maps_dir, "v1", map_id="hall")
    scramble(maps_dir, "hall")
    with started(maps_dir) as with_engine:
        yield with_engine


@pytest.fixture(scope="module")
def with_a_map_without_down(
    built_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WithEngine]:
    """An engine with a map that does not know which way is down."""
    maps_dir = tmp_path_factory.mktemp("no_down") / "maps"
    shutil.copytree(built_maps, maps_dir)
    manifest = MapStore(maps_dir).folder("room") / "manifest.json"
    record = json.loads(manifest.read_text())
    record["world"].pop("gravity", None)
    record["world"].pop("anchor", None)
    manifest.write_text(json.dumps(record))
    with started(maps_dir) as with_engine:
        yield with_engine


def test_of_several_maps_the_one_with_the_best_answer_is_named(
    with_two_maps: WithEngine, query: Query, rig_photos: RigPhotos
) -> None:
    async def play(engine: Engine) -> None:
        alone = await engine.localize(replace(job_for(query), options=FAST))
        for maps in (("hall", "room"), ("room", "hall")):
            found = await engine.localize(replace(job_for(query), maps=maps, options=FAST))
            assert found.map_id == "room"
            assert found.answer.pose is not None
            assert alone.answer.pose is not None
            assert np.array_equal(found.answer.pose.covariance, alone.answer.pose.covariance)

        both = await engine.localize_rig(rig_job(rig_photos, maps=("hall", "room")))
        assert (both.map_id, both.answer.timestamp) == ("room", 5)
        assert both.answer.pose is not None

        lost = await engine.localize(replace(job_for(query), maps=("hall",), options=FAST))
        assert lost.map_id == "hall"
        assert lost.answer.pose is None

    with_two_maps(play)


def test_the_rig_of_the_sample_is_localized_within_a_few_millimetres(
    with_two_workers: WithEngine, rig_photos: RigPhotos
) -> None:
    # 256 x 192 pixels and 8 mapping photos: measured 1.1 mm and 0.037 degrees.
    async def play(engine: Engine) -> None:
        inline = await engine.localize_rig(rig_job(rig_photos))
        named = await engine.localize_rig(rig_job(rig_photos, rig="rig"))
        for found in (inline, named):
            pose = found.answer.pose
            assert pose is not None
            position_m, orientation_deg = pose_error(pose.rig_from_world, rig_photos.rig_from_world)
            assert position_m < 0.003
            assert orientation_deg < 0.05
            assert pose.source is PoseSource.ESTIMATED
            used = [image.evidence.camera for image in found.answer.images if image.evidence]
            assert used == [sensor.camera for sensor in rig_photos.sensors.values()]

    with_two_workers(play)


def test_an_image_that_cannot_be_read_fails_alone(
    with_engine: WithEngine, rig_photos: RigPhotos
) -> None:
    left, right = (ImageJob(name, photo, None) for name, photo in rig_photos.photos.items())

    async def play(engine: Engine) -> None:
        other_size = Camera("SIMPLE_PINHOLE", 640, 300, (500.0, 320.0, 150.0))
        for broken, code in (
            (replace(right, query=b""), "image.empty"),
            (replace(right, query=b"no photo"), "image.format"),
            (replace(right, query=b"\xff\xd8\xff" + bytes(10**6)), "image.too_large"),
            (replace(right, camera=other_size), "camera.size_mismatch"),
        ):
            found = await engine.localize_rig(rig_job(rig_photos, images=(left, broken)))
            assert found.answer.pose is not None
            errors = [image.error for image in found.answer.images]
            assert errors[0] is None
            assert errors[1] is not None
            assert errors[1].code == code
        assert errors[1] is not None
        found = await engine.localize_rig(
            rig_job(rig_photos, images=(replace(left, query=b""), replace(right, query=b"x")))
        )
        assert found.answer.refusal is not None
        assert found.answer.refusal.reason is Reason.NO_USABLE_IMAGE

    with_engine(play)


@pytest.mark.parametrize(
    ("change", "kind", "code", "field"),
    [
        (lambda _: {"images": ()}, InvalidInput, "rig.empty", "images"),
        (lambda _: {"rig": "car"}, NotFound, "rig.unknown", "rig"),
        (lambda _: {"rig": {}}, InvalidInput, "rig.sensor", "images[0].sensor"),
        (lambda r: {"rig": {"left": r.sensors["left"]}}, InvalidInput, "rig.sensor", None),
        (
            lambda r: {"images": (ImageJob("left", r.photos["left"], None),) * 2},
            *(InvalidInput, "rig.duplicate", "images"),
        ),
        (
            lambda _: {"images": tuple(ImageJob(str(i), b"", None) for i in range(17))},
            *(TooLarge, "rig.too_many_images", "images"),
        ),
        (lambda _: {"maps": ("room", "cellar")}, NotFound, "map.unknown", None),
        (
            lambda _: {"priors": Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), 0.02))},
            *(InvalidInput, "priors.gravity", "priors.gravity"),
        ),
    ],
)
def test_a_rig_that_does_not_fit_is_refused_before_any_photo_is_read(
    change: Callable[[RigPhotos], dict[str, Any]],
    kind: type[Exception],
    code: str,
    field: str | None,
    with_a_map_without_down: WithEngine,
    rig_photos: RigPhotos,
) -> None:
    async def play(engine: Engine) -> None:
        with pytest.raises(kind) as caught:
            await engine.localize_rig(rig_job(rig_photos, **change(rig_photos)))
        error: Any = caught.value
        assert error.code == code
        assert field is None or error.field == field
        assert error.expected or error.message

    with_a_map_without_down(play)


def instants_of(
    photos: Sequence[bytes], camera: Camera, *, start: int = 1_700_000_000_000
) -> list[InstantJob]:
    return [
        InstantJob(start + 100 * i, (ImageJob("camera", photo, camera),), None, None)
        for i, photo in enumerate(photos)
    ]


START = SequenceJob(("room",), None, None, 1.0, FAST)


async def answers_of(
    engine: Engine, start: SequenceJob, instants: Sequence[InstantJob]
) -> list[Localization]:
    """Sent one by one, as a stream is."""

    async def sent() -> AsyncIterator[InstantJob]:
        for instant in instants:
            yield instant

    return [answer async for answer in engine.localize_sequence(start, sent())]


def test_a_sequence_in_several_maps_keeps_the_first_that_localizes_and_all_its_answers(
    with_two_maps: WithEngine, query: Query
) -> None:
    instants = instants_of([blank(), b"broken", query.image, blank()], query.camera)
    start = replace(START, maps=("hall", "room"))

    async def play(engine: Engine) -> None:
        found = await answers_of(engine, start, instants)
        assert [each.map_id for each in found] == ["room"] * 4
        assert [each.answer.timestamp for each in found] == [i.timestamp for i in instants]
        sources = [each.answer.pose and each.answer.pose.source for each in found]
        nearest = PoseSource.NEAREST
        assert sources == [nearest, nearest, PoseSource.ESTIMATED, nearest]
        # Those that are all there are checked first, and answered the same.
        at_once = [each async for each in engine.localize_sequence(start, instants)]
        assert [each.answer.num_inliers for each in at_once] == [
            each.answer.num_inliers for each in found
        ]
        # Where none is localized, the first map answers for all.
        lost = await answers_of(engine, start, instants[:2])
        assert [each.map_id for each in lost] == ["hall", "hall"]
        assert [each.answer.pose for each in lost] == [None, None]

    with_two_maps(play)


def test_a_sequence_is_answered_as_it_comes(with_engine: WithEngine, query: Query) -> None:
    first, second, third = instants_of([query.image, blank(), query.image], query.camera)
    taken: list[int] = []

    async def sent() -> AsyncIterator[InstantJob]:
        for instant in (first, second, third):
            taken.append(instant.timestamp)
            yield instant

    async def play(engine: Engine) -> None:
        answers = engine.localize_sequence(START, sent())
        assert (await anext(answers)).answer.timestamp == first.timestamp
        # The next is not taken before this one has been.
        assert taken == [first.timestamp]
        assert (await anext(answers)).answer.timestamp == second.timestamp
        assert len(taken) == 3
        assert [a.answer.timestamp async for a in answers] == [third.timestamp]

    with_engine(play)


def odometry() -> Odometry:
    return Odometry(Pose.identity(), None)


@pytest.mark.parametrize(
    ("change", "start", "kind", "code", "field"),
    [
        (lambda _: [], {}, InvalidInput, "sequence.empty", "instants"),
        (
            lambda i: [i[0], replace(i[1], timestamp=i[0].timestamp)],
            *({}, InvalidInput, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            lambda i: [i[1], i[0]],
            *({}, InvalidInput, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            lambda i: [replace(i[0], timestamp=0)],
            *({}, InvalidInput, "sequence.time_unit", "time_unit"),
        ),
        (
            lambda i: [replace(i[0], timestamp=-5)],
            *({}, InvalidInput, "sequence.time_unit", None),
        ),
        (
            lambda i: [replace(i[0], timestamp=t) for t in range(10_000)],
            *({"time_unit": TimeUnit.S}, TooLarge, "sequence.too_many_instants", "instants"),
        ),
        (
            lambda i: [replace(i[0], images=i[0].images * 2)],
            *({}, InvalidInput, "sequence.rig", "instants[0].images"),
        ),
        (
            lambda i: [i[0], replace(i[1], images=i[0].images)],
            *({"rig": "car"}, NotFound, "rig.unknown", "rig"),
        ),
        (
            lambda i: i,
            *({"rig": "rig"}, InvalidInput, "rig.sensor", "instants[0].images[0].sensor"),
        ),
        (lambda i: i, {"max_gap_s": 61.0}, InvalidInput, "sequence.max_gap", "max_gap_s"),
        (lambda i: i, {"maps": ("room", "attic")}, NotFound, "map.unknown", None),
    ],
)
def test_a_sequence_that_cannot_be_is_refused_by_name(
    change: Callable[[list[InstantJob]], list[InstantJob]],
    start: dict[str, Any],
    kind: type[Exception],
    code: str,
    field: str | None,
    with_engine: WithEngine,
    query: Query,
) -> None:
    instants = change(instants_of([b"x", b"y"], query.camera))

    async def play(engine: Engine) -> None:
        # One by one, and all at once: then nothing is answered before.
        changed = replace(START, **start)
        for asked in (
            answers_of(engine, changed, instants),
            anext(engine.localize_sequence(changed, instants)),
        ):
            with pytest.raises(kind) as caught:
                await asked
            error: Any = caught.value
            assert error.code == code
            assert field is None or error.field == field

    with_engine(play)


def test_priors_of_an_instant_replace_those_of_the_sequence(
    with_engine: WithEngine, query: Query
) -> None:
    lie = Priors(PositionPrior(np.array([900.0, 0.0, 0.0]), 1.0))
    one, two = instants_of([query.image, query.image], query.camera)

    async def play(engine: Engine) -> None:
        start = replace(START, priors=lie, max_gap_s=0.0)
        found = await answers_of(engine, start, [one, replace(two, priors=NO_PRIORS)])
        refusals = [each.answer.refusal for each in found]
        assert refusals[0] is not None
        assert refusals[0].reason is Reason.NO_PHOTO_NEAR
        assert refusals[1] is None

    with_engine(play)


def test_instants_without_images_live_on_odometry(with_engine: WithEngine, query: Query) -> None:
    seen, *unseen = instants_of([query.image, b"", b""], query.camera)
    instants = [replace(seen, odometry=odometry())]
    instants += [replace(instant, images=(), odometry=odometry()) for instant in unseen]

    async def play(engine: Engine) -> None:
        found = await answers_of(engine, START, instants)
        poses = [each.answer.pose for each in found]
        assert [pose and pose.source for pose in poses] == [
            PoseSource.ESTIMATED,
            PoseSource.MOTION,
            PoseSource.MOTION,
        ]

    with_engine(play)


def test_a_sequence_does_not_queue_behind_all_photos_for_each_of_its_tasks(
    built_maps: Path, query: Query
) -> None:
    clients, instants = 30, instants_of([query.image] * 4, query.camera)

    photo = replace(job_for(query), options=FAST)

    async def play(engine: Engine) -> None:
        answered = 0

        async def ask_on() -> None:
            nonlocal answered
            while True:
                await engine.localize(photo)
                answered += 1

        asking = [asyncio.create_task(ask_on()) for _ in range(clients)]
        try:
            await until(lambda: answered > 0)
            before = answered
            assert all(each.answer.pose for each in await answers_of(engine, START, instants))
            # It takes a dozen tasks, or thrice as many photos of each client as there are instants.
            assert answered - before < 2 * len(instants) * clients
        finally:
            for each in asking:
                each.cancel()
            await asyncio.gather(*asking, return_exceptions=True)

    with started(built_maps, max_queue=clients) as with_engine:
        with_engine(play)


def test_batches_have_places_of_their_own(built_maps: Path) -> None:
    engine = make(built_maps, max_batches=2)
    with pytest.raises(Unavailable) as early, engine.admit_batch():
        pass
    assert early.value.code == "server.starting"
    engine._started = True
    with engine.admit_batch():
        with engine.admit_batch(), pytest.raises(Overloaded) as caught, engine.admit_batch():
            pass
        assert caught.value.code == "server.busy"
        # A place is given back whatever happened in it.
        with pytest.raises(ZeroDivisionError), engine.admit_batch():
            raise ZeroDivisionError
        with engine.admit_batch():
            pass
    with engine.admit_batch(), engine.admit_batch():
        pass


def test_a_sequence_that_is_given_up_frees_everything(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        instants = instants_of([query.image] * 20, query.camera)

        async def ask() -> None:
            with engine.admit_batch():
                await answers_of(engine, START, instants)

        async with held_back(engine):
            asking = asyncio.create_task(ask())
            await until(lambda: engine.workers.running == 1)
            with pytest.raises(Overloaded), engine.admit_batch():
                pass
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            with engine.admit_batch():  # at once, not when the photo is done
                pass
        # Closed between two answers instead.
        answers = engine.localize_sequence(START, instants)
        await anext(answers)
        await answers.aclose()
        await engine.localize(replace(job_for(query), options=FAST))
        assert engine.workers.waiting == 0

    with_engine(play)


def test_a_sequence_survives_the_death_of_a_worker_between_two_instants(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        answers = engine.localize_sequence(START, instants_of([query.image] * 3, query.camera))
        first = await anext(answers)
        (pid,) = engine.workers.pids
        os.kill(pid, signal.SIGKILL)
        await until(lambda: pid not in engine.workers.pids and engine.workers.alive == 1)
        others = [each async for each in answers]
        assert [each.answer.num_inliers for each in others] == [first.answer.num_inliers] * 2

    with_engine(play)
