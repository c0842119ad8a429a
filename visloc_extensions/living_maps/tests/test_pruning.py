from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.editing import content_of, selected
from mapping.own_test.publishing import publish_edited
from mapping.own_test.trials import own_test
from visloc.archive import Map, MapStore, add_own_test
from visloc.archive.schema import Doubt
from visloc.errors import Conflict, InvalidInput, VislocError
from visloc_extensions.living_maps.prune_command import parse_size
from visloc_extensions.living_maps.pruning import Kept, Pruned, choose, prune_map, size_with
from visloc_extensions.living_maps.pruning.accuracy import BINS, Accuracy, lost
from visloc_extensions.living_maps.pruning.choosing import least, num_landmarks


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


@pytest.fixture(scope="module")
def built(build_sample: Callable[..., Map]) -> Map:
    return build_sample(keep_photos=True, keep_colours=True)


@pytest.fixture
def store(built: Map, tmp_path: Path) -> MapStore:
    shutil.copytree(built.path.parent, tmp_path / "maps" / "room")
    (tmp_path / "maps/room/current").write_text(built.manifest.version + "\n")
    return MapStore(tmp_path / "maps")


@pytest.fixture
def pruned(store: MapStore) -> Pruned:
    size = store.open("room").size_bytes
    return prune_map(store, "room", max_bytes=size * 7 // 10, progress=quiet)


def test_a_pruned_map_is_tested_anew(pruned: Pruned) -> None:
    learned = pruned.after.manifest.parts.own_test
    assert learned == own_test(pruned.after)
    assert learned != pruned.before.manifest.parts.own_test
    assert learned.localized > 0


def test_doubts_that_only_a_build_finds_stay_with_what_is_made_of_the_map(store: MapStore) -> None:
    before = store.open("room")
    test = before.manifest.parts.own_test
    assert test is not None
    found = [Doubt(kind="matches", message="bent"), Doubt(kind="own_test", message="tested anew")]
    with store.incoming() as incoming:
        shutil.copytree(before.path, incoming, dirs_exist_ok=True)
        version = add_own_test(incoming, test, version="20300101T000000.000Z-1", doubts=found)
        store.publish(incoming, "room", version)  # as with --accept
    doubted = store.open("room")

    after = prune_map(store, "room", max_bytes=doubted.size_bytes * 7 // 10, progress=quiet).after

    assert [doubt.kind for doubt in after.manifest.parts.doubts] == ["matches"]
    assert store.current_version("room") == after.manifest.version  # as the one before


def keep_all(opened: Map) -> Kept:
    count = len(opened.observation_landmarks)
    return Kept(np.ones(len(opened.images), np.bool_), np.ones(count, np.bool_), count)


def test_a_pruned_map_is_as_large_as_it_may_be_and_the_one_before_stays(
    pruned: Pruned, store: MapStore
) -> None:
    before, after = pruned.before, store.open("room")

    assert after.ref == pruned.after.ref
    assert 0.68 * before.size_bytes < after.size_bytes <= 0.7 * before.size_bytes
    assert store.versions("room") == [before.manifest.version, after.manifest.version]
    assert f"pruned from version {before.manifest.version}" in after.manifest.notes[-1]
    assert len(after.images) == len(before.images)
    assert after.photo(3) == before.photo(3)
    assert np.isin(after.landmarks.view("V12"), before.landmarks.view("V12")).all()
    assert pruned.accuracy[1].queries == 8
    assert len(pruned.accuracy[1].errors) >= len(pruned.accuracy[0].errors) - 1


def test_every_photo_keeps_as_many_and_from_everywhere(pruned: Pruned) -> None:
    before, after = pruned.before, pruned.after
    counts = np.diff(after.observation_offsets)
    had = np.diff(before.observation_offsets)
    most = counts.max()

    assert (counts == np.minimum(had, most)).all()
    for image in range(len(after.images)):
        taken, seen = after.keypoints(image), before.keypoints(image)
        for axis in range(2):
            assert np.ptp(taken[:, axis]) > 0.8 * np.ptp(seen[:, axis])


def test_sizes_are_foreseen(built: Map, tmp_path: Path) -> None:
    assert size_with(built, keep_all(built)) == built.size_bytes
    images = np.arange(8) < 5
    observations = np.repeat(images, np.diff(built.observation_offsets))
    observations &= np.arange(len(observations)) % 3 > 0
    kept = Kept(images, observations, 0)
    part = selected(content_of(built), images, observations=observations)
    pictures = [built.path / f"photos/{row:06d}.jpg" for row in range(5)]
    folder = publish_edited(MapStore(tmp_path), part, "room", photos=pictures)
    size = MapStore(tmp_path).open("room").size_bytes

    assert size == size_with(built, kept)
    assert num_landmarks(built, kept) == len(part.landmarks.points)
    assert folder.is_dir()


def test_photos_go_before_each_keeps_too_few(built: Map) -> None:
    smallest = least(built, whole_landmarks=False)
    limit = size_with(built, smallest)
    kept = choose(built, lambda part: size_with(built, part) <= limit, whole_landmarks=False)

    assert kept is not None
    assert 1 <= kept.images.sum() < 8, kept.images
    assert size_with(built, kept) <= limit
    of_dropped = np.repeat(~kept.images, np.diff(built.observation_offsets))
    assert not kept.observations[of_dropped].any()
    less = choose(built, lambda part: size_with(built, part) < limit // 2, whole_landmarks=False)
    assert less is None


def test_photos_are_put_in_order_only_when_some_must_go(
    built: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = built.size_bytes * 9 // 10
    expected = choose(built, lambda part: size_with(built, part) <= limit, whole_landmarks=False)
    monkeypatch.setattr(
        "visloc_extensions.living_maps.pruning.choosing._photos_by_need", None
    )  # slow in large maps
    kept = choose(built, lambda part: size_with(built, part) <= limit, whole_landmarks=False)

    assert kept is not None
    assert expected is not None
    assert kept.images.all()
    np.testing.assert_array_equal(kept.observations, expected.observations)


def test_landmarks_may_be_counted_instead_of_bytes(store: MapStore) -> None:
    before = store.open("room")
    count = len(before.landmarks) * 8 // 10
    after = prune_map(store, "room", max_landmarks=count, progress=quiet).after

    assert 0.9 * count < len(after.landmarks) <= count
    # Who stays keeps all its observations.
    rows = {tuple(point): row for row, point in enumerate(before.landmarks.tolist())}
    same = [rows[tuple(point)] for point in after.landmarks.tolist()]
    np.testing.assert_array_equal(after.track_lengths, before.track_lengths[same])


def test_what_is_too_small_names_the_least(store: MapStore) -> None:
    opened = store.open("room")
    with pytest.raises(InvalidInput) as error:
        prune_map(store, "room", max_bytes=1000, progress=quiet)
    assert error.value.code == "prune.too_small"
    assert "models of the global features alone take" in str(error.value)
    with pytest.raises(InvalidInput) as error:
        prune_map(store, "room", max_landmarks=10, progress=quiet)
    assert str(num_landmarks(opened, least(opened, whole_landmarks=True))) in str(
        error.value.expected
    )
    assert store.current_version("room") == opened.manifest.version


def test_a_map_that_is_small_enough_stays_as_it_is(store: MapStore) -> None:
    with pytest.raises(Conflict) as error:
        prune_map(store, "room", max_bytes=10**9, progress=quiet)
    assert error.value.code == "prune.small_already"
    assert len(store.versions("room")) == 1


def test_a_version_that_came_meanwhile_is_not_replaced(store: MapStore) -> None:
    opened = store.open("room")

    def interfere(_before: Map, _after: Map) -> tuple[Accuracy, Accuracy]:
        publish_edited(store, content_of(opened), "room")
        return Accuracy(1, ()), Accuracy(1, ())

    with pytest.raises(Conflict) as error:
        prune_map(
            store, "room", max_bytes=opened.size_bytes // 2, measure=interfere, progress=quiet
        )
    assert error.value.code == "map.outdated"
    assert len(store.versions("room")) == 2


def test_an_old_version_by_name_is_not_mistaken_for_the_one_in_use(store: MapStore) -> None:
    old = store.current_version("room")
    pruned = prune_map(
        store, "room", max_landmarks=len(store.open("room").landmarks) - 1, progress=quiet
    )
    told: list[str] = []
    with pytest.raises(Conflict) as error:
        prune_map(
            store,
            f"room@{old}",
            max_landmarks=10,
            progress=lambda stage, _done, _total: told.append(stage),
        )
    assert error.value.code == "map.outdated"
    assert told == []
    result = CliRunner().invoke(
        app, ["prune", f"room@{old}", "--max-bytes", "90%", "--maps-dir", str(store.root)]
    )
    assert isinstance(result.exception, Conflict)
    assert result.exception.code == "map.outdated"
    assert store.current_version("room") == pruned.after.manifest.version


def test_the_command_measures_with_queries(store: MapStore, sample: Path) -> None:
    arguments = ["prune", "room", "--maps-dir", str(store.root), "--queries"]
    result = CliRunner().invoke(
        app, [*arguments, str(sample / "query"), "--max-bytes", "80%"], catch_exceptions=False
    )
    assert "accuracy is that of 3 queries" in result.output
    assert "3 of 3" in result.output
    assert "5 cm, 5 deg" in result.output
    packed = CliRunner().invoke(app, ["prune", "room", "--maps-dir", str(store.root)])
    assert isinstance(packed.exception, InvalidInput)
    assert packed.exception.code == "prune.goal"


def test_queries_without_poses_are_refused(store: MapStore, sample: Path, tmp_path: Path) -> None:
    shutil.copytree(sample / "query", tmp_path / "unposed")
    (tmp_path / "unposed/sensors/trajectories.txt").unlink()
    result = CliRunner().invoke(
        app,
        [
            *("prune", "room", "--maps-dir", str(store.root), "--max-bytes", "80%"),
            *("--queries", str(tmp_path / "unposed")),
        ],
    )
    assert isinstance(result.exception, VislocError)
    assert result.exception.code == "prune.queries"
    assert len(store.versions("room")) == 1


@pytest.mark.parametrize(
    ("text", "size"),
    [("200MB", 200_000_000), ("1.5 GiB", 1_610_612_736), ("50%", 500), ("12345", 12345)],
)
def test_sizes_are_read(text: str, size: int) -> None:
    assert parse_size(text, 1000) == size


@pytest.mark.parametrize("text", ["", "0", "-5MB", "50 percent", "nan", "1e9", "0.01%"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput) as error:
        parse_size(text, 1000)
    assert error.value.code == "prune.max_bytes"


def test_the_worst_bin_tells_what_was_lost() -> None:
    before = Accuracy(4, ((0.01, 0.1), (0.02, 0.1), (0.2, 1.0), (0.4, 4.0)))
    after = Accuracy(4, ((0.01, 0.1), (0.06, 0.1), (0.2, 3.0)))

    assert [before.within(one) for one in BINS] == [2, 3, 4]
    assert [after.within(one) for one in BINS] == [1, 2, 3]
    assert lost(before, after, metric=True) == 1
    assert lost(before, Accuracy(4, ()), metric=False) == 4
    assert lost(after, before, metric=True) == -1
