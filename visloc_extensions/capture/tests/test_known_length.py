from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.mapping.importers.conftest import panned
from visloc.errors import InvalidInput
from visloc_extensions.capture.job import Outlook, capture_map
from visloc_extensions.capture.settings import CaptureSettings


def begins(_: Outlook) -> None:
    raise AssertionError("the long work began")


@pytest.mark.parametrize(
    ("first", "second", "got"),
    [
        ("walk.mp4@0.5", "walk.mp4@80", "it ends at 1.9"),
        ("walk.mp4@nan", "walk.mp4@1", "walk.mp4@nan"),
        ("walk.mp4@-1", "walk.mp4@1", "walk.mp4@-1"),
        ("walk.mp4@inf", "walk.mp4@1", "walk.mp4@inf"),
        ("walk.mp4@1", "walk.mp4@1", "for both"),
    ],
)
def test_a_length_between_moments_that_are_not_two_is_refused_before_the_long_work(
    make_video: Callable[..., Path], tmp_path: Path, first: str, second: str, got: str
) -> None:
    film = make_video(panned(20, step=8), "walk.mp4")
    settings = CaptureSettings([film], "room", tmp_path / "maps", scale=(first, second, "1m"))
    with pytest.raises(InvalidInput) as caught:
        capture_map(settings, lambda *_: None, begins)
    assert caught.value.code == "capture.photo"
    assert got in str(caught.value.got)
