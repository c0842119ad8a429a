from __future__ import annotations

import pytest

from service.workers.pool import share_of_cores


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
