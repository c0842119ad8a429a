"""A version that its own test speaks against is published, but not put into use."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapping.cli.acceptance import require_acceptance, use
from mapping.maps.editing import content_of
from mapping.own_test.publishing import publish_edited
from mapping.own_test.trials import OwnTestRun, run_own_test
from mapping.own_test.verdict import doubts_about, misses_own_photos
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map, MapStore, OwnTest, open_map
from visloc.archive.schema import Doubt
from visloc.errors import Conflict, InvalidInput, NotFound
from visloc.geometry import Pose
from visloc.kapture import read_dataset, write_dataset


def ran(tested: int, refused: int, wrong: int) -> OwnTestRun:
    test = OwnTest(
        tested=tested,
        localized=tested - refused,
        wrong=wrong,
        position_factor=2.0,
        orientation_factor=2.0,
        independent=True,
    )
    rows = tuple(range(refused + wrong))
    return OwnTestRun(test, rows[:wrong], rows[wrong:])


@pytest.fixture(scope="module")
def square(
    make_map: Callable[..., Map], room: Callable[..., np.ndarray], looking: Callable[..., Pose]
) -> Map:
    points = room(np.random.default_rng(1), 3000)
    return make_map(points, [looking([0.5 * np.sin(i), 0.0, 0.0], 15.0 * i) for i in range(24)])


def estimated(opened: Map, poses: str = "estimate") -> Map:
    """The same map, as if its poses had been found in such a way."""
    method = opened.manifest.method.model_copy(update={"name": "sfm", "settings": {"poses": poses}})
    return replace(opened, manifest=opened.manifest.model_copy(update={"method": method}))


@pytest.mark.parametrize(
    ("tested", "refused", "wrong", "doubted"),
    [
        (12, 0, 0, False),
        (12, 2, 1, False),  # the weakest of the hallways that localize
        (12, 0, 2, True),
        (12, 7, 0, False),
        (12, 8, 0, True),
        (60, 0, 9, False),
        (60, 0, 10, True),
        (7, 7, 0, False),  # too few to say
    ],
)
def test_photos_that_do_not_come_back_speak_against_a_map(
    square: Map, tested: int, refused: int, wrong: int, doubted: bool
) -> None:
    found = doubts_about(estimated(square), ran(tested, refused, wrong))

    assert [doubt.kind for doubt in found] == (["own_test"] if doubted else [])
    # Where poses were given, photos that find no place tell that a map is sparse, not wrong.
    given = doubts_about(estimated(square, "given"), ran(tested, refused, wrong))
    assert bool(given) == (doubted and wrong > 0)
    if doubted:
        (doubt,) = found
        assert f"of {tested} photos" in doubt.message
        assert doubt.photos == tuple(square.images[i].name for i in range(refused + wrong))[:100]


@pytest.mark.parametrize(
    ("tested", "refused", "wrong", "misses"),
    [
        (12, 0, 0, False),
        (12, 1, 0, False),
        (12, 2, 0, True),  # nowhere and elsewhere count alike
        (12, 0, 2, True),
        (12, 1, 1, True),
        (20, 2, 1, False),
        (8, 8, 0, True),
        (7, 7, 0, False),  # too few to say
    ],
)
def test_a_map_that_misses_more_than_a_few_of_its_photos_says_so(
    tested: int, refused: int, wrong: int, misses: bool
) -> None:
    assert misses_own_photos(ran(tested, refused, wrong).test) == misses
    assert not misses_own_photos(None)


@pytest.mark.parametrize(("absent", "doubted"), [(0, False), (16, False), (17, True)])
def test_photos_without_a_place_speak_against_a_map(
    square: Map, absent: int, doubted: bool
) -> None:
    names = [f"absent/{i}.jpg" for i in range(absent)]

    found = doubts_about(square, ran(12, 0, 0), names)

    assert [(doubt.kind, doubt.photos) for doubt in found] == (
        [("left_out", tuple(names))] if doubted else []
    )


@pytest.mark.parametrize("poses", ["estimate", "given"])
def test_pieces_speak_against_a_map_unless_its_poses_were_given(
    make_map: Callable[..., Map],
    room: Callable[..., np.ndarray],
    looking: Callable[..., Pose],
    poses: str,
) -> None:
    rng = np.random.default_rng(1)
    here, there = room(rng, 1500), room(rng, 1500) + np.array([100.0, 0, 0])
    views = [looking([x, 0.0, 0.0], 30.0 * i) for x in (0.0, 100.0) for i in range(12)]
    opened = make_map(np.concatenate([here, there]), views)
    # What lies a hundred units away is hidden by the walls.
    centers = np.repeat([v.center[0] for v in views], np.diff(opened.observation_offsets))
    near = np.abs(opened.landmarks[opened.observation_landmarks, 0] - centers) < 50
    assert near.sum() > 100
    keep = np.flatnonzero(near)
    offsets = np.searchsorted(keep, opened.observation_offsets).astype(np.int64)
    split = replace(
        opened,
        observation_landmarks=opened.observation_landmarks[keep],
        observation_offsets=offsets,
    )

    found = doubts_about(estimated(split, poses), ran(12, 0, 0))

    assert [doubt.kind for doubt in found] == (["pieces"] if poses == "estimate" else [])


@pytest.fixture(scope="module")
def broken(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's mapping dataset with the poses of half of its photos exchanged."""
    folder = tmp_path_factory.mktemp("broken") / "mapping"
    shutil.copytree(sample / "mapping", folder)
    dataset = read_dataset(folder)
    given = dict(dataset.trajectories)
    keys = sorted(given)[::2]
    exchanged = {key: given[other] for key, other in zip(keys, [*keys[1:], keys[0]], strict=True)}
    for path in (folder / "sensors").glob("*.txt"):
        path.unlink()
    write_dataset(replace(dataset, trajectories={**given, **exchanged}))
    return folder


def build(dataset: Path, maps: Path, **settings: object) -> Map:
    values = {"local_features": "sift", "force": True} | settings
    return open_map(build_map(BuildSettings(dataset, "room", maps, **values), lambda *_: None))


def test_a_broken_build_is_published_and_the_map_before_stays_in_use(
    broken: Path, maps_dir: Path, tmp_path: Path
) -> None:
    store = MapStore(maps_dir)
    before = store.current_version("room")

    opened = build(broken, maps_dir)

    assert store.current_version("room") == before
    version = opened.manifest.version
    assert version in store.versions("room")
    doubt, *_ = opened.manifest.parts.doubts
    assert doubt.kind == "own_test"
    with pytest.raises(Conflict, match=f"mapping use room@{version}") as caught:
        require_acceptance(opened, accept=False, pictures=tmp_path / "pictures")
    assert caught.value.code == "map.doubtful"
    (picture,) = (tmp_path / "pictures").iterdir()
    pixels = cv2.imread(str(picture)).astype(int)
    red = (pixels[..., 2] - pixels[..., 0] > 100).sum()
    assert red > 50 * len(doubt.photos) / 2

    use(f"room@{version}", maps_dir)
    assert store.current_version("room") == version


def test_a_broken_first_build_leaves_nothing_in_use(broken: Path, tmp_path: Path) -> None:
    opened = build(broken, tmp_path)

    assert MapStore(tmp_path).ids() == []
    assert MapStore(tmp_path).versions("room") == [opened.manifest.version]
    build(broken, tmp_path, force=False, accept=True)
    assert MapStore(tmp_path).ids() == ["room"]


def test_what_is_accepted_keeps_its_doubts(broken: Path, maps_dir: Path, tmp_path: Path) -> None:
    opened = build(broken, maps_dir, accept=True)

    assert MapStore(maps_dir).current_version("room") == opened.manifest.version
    assert opened.manifest.parts.doubts
    require_acceptance(opened, accept=True, pictures=tmp_path)


def test_a_doubt_about_no_photo_in_particular_is_told_without_a_picture(
    maps_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = MapStore(maps_dir).open("room")
    parts = opened.manifest.parts.model_copy(
        update={"doubts": (Doubt(kind="size", message="its size is not known"),)}
    )
    opened = replace(opened, manifest=opened.manifest.model_copy(update={"parts": parts}))

    with pytest.raises(Conflict, match="mapping use room@"):
        require_acceptance(opened, accept=False, pictures=tmp_path / "pictures")
    assert capsys.readouterr().out == "doubt: its size is not known\n"
    assert not (tmp_path / "pictures").exists()


def test_a_good_build_is_put_into_use(maps_dir: Path) -> None:
    opened = MapStore(maps_dir).open("room")

    assert opened.manifest.parts.doubts == ()
    assert run_own_test(opened).wrong == ()


def test_what_is_made_from_maps_follows_the_same_rule(broken: Path, maps_dir: Path) -> None:
    store = MapStore(maps_dir)
    before = store.current_version("room")
    content = content_of(build(broken, maps_dir))

    folder = publish_edited(store, content, "room", based_on=before)
    assert store.current_version("room") == before

    accepted = publish_edited(store, content, "room", based_on=before, accept=True)
    assert store.current_version("room") == accepted.name != folder.name


def test_only_a_version_is_put_into_use(maps_dir: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        use("room", maps_dir)
    assert caught.value.code == "map.use"
    with pytest.raises(NotFound):
        use("room@nothing", maps_dir)


@pytest.mark.parametrize("poses", ["estimate", "given"])
def test_two_places_in_one_space_are_a_doubt_if_poses_were_estimated(
    make_map: Callable[..., Map],
    room: Callable[..., np.ndarray],
    looking: Callable[..., Pose],
    poses: str,
) -> None:
    """Of two rooms in one space, photos taken in turn see one and what both have in common."""
    points = np.concatenate([room(np.random.default_rng(seed), 800) for seed in range(3)])
    opened = make_map(
        points, [looking([0.05 * np.sin(i), 0.0, 0.0], 15.0 * (i // 2)) for i in range(48)]
    )
    first_row = {tuple(point): row for row, point in enumerate(points.astype(np.float32).tolist())}
    part = np.array([first_row[tuple(p)] // 800 for p in opened.landmarks.tolist()])
    photos = np.repeat(np.arange(48), np.diff(opened.observation_offsets))
    of_landmarks = part[opened.observation_landmarks]
    keep = np.flatnonzero((of_landmarks == 2) | (of_landmarks == photos % 2))
    folded = replace(
        opened,
        observation_landmarks=opened.observation_landmarks[keep],
        observation_keypoints=opened.observation_keypoints[keep],
        observation_descriptors=opened.observation_descriptors[keep],
        observation_offsets=np.searchsorted(keep, opened.observation_offsets).astype(np.int64),
    )

    found = doubts_about(estimated(folded, poses), ran(12, 0, 0))

    assert [doubt.kind for doubt in found] == (["places"] if poses == "estimate" else [])
    assert doubts_about(estimated(opened, poses), ran(12, 0, 0)) == ()
