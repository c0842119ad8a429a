from __future__ import annotations

import pytest

from service.workers.pool import Turn, share_of_cores


@pytest.mark.parametrize(
    ("cores", "running", "most", "threads"),
    [
        (2, 1, 2, 2),  # a photo alone
        (2, 2, 2, 1),
        (16, 1, 16, 16),
        (16, 3, 16, 5),
        (16, 16, 16, 1),
        (16, 2, 4, 4),  # no more than were asked for
        (2, 3, 2, 1),  # more workers than cores
    ],
)
def test_photos_that_are_localized_at_the_same_time_share_the_cores(
    cores: int, running: int, most: int, threads: int
) -> None:
    assert share_of_cores(cores, running, most) == threads


def test_a_request_falls_back_by_what_was_spent_on_it_but_not_behind_new_ones() -> None:
    earlier, later = Turn(), Turn()
    assert earlier.rank() < later.rank()
    earlier.worked(0.1)
    assert later.rank() < earlier.rank() <= Turn().rank()


def test_a_silent_stream_earns_no_right_to_overtake_all_others() -> None:
    silent = Turn(since=Turn().since - 3600.0)
    waiting = Turn(since=Turn().since - 30.0)
    silent.rank()
    silent.worked(3.0)
    assert waiting.rank() < silent.rank()
