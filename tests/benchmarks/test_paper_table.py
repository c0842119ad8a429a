from __future__ import annotations

import re

import numpy as np
import pytest

from benchmarks.paper import SETS, run_stamp, table
from visloc.accuracy import Compared, accuracy_of
from visloc.geometry import Pose

TRUTH = Pose.from_quaternion((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def moved(metres: float) -> Compared:
    return Compared(TRUTH, Pose(TRUTH.rotation, TRUTH.translation + np.array([metres, 0.0, 0.0])))


def test_figures_stand_beside_the_papers() -> None:
    photos = [moved(0.01), moved(0.02), moved(0.3), Compared(TRUTH, None)]
    accuracy = accuracy_of(photos, [SETS["7scenes"].threshold])

    stamp, _, heading, _, row = table(
        SETS["7scenes"], [("redkitchen", 4, 3, accuracy)], "xfeat", "X"
    )

    assert stamp == "xfeat, rgbd, config1, top 20; X"
    assert heading.count("within 0.05 m, 5 deg") == 2
    assert row == "| redkitchen | 4 | 3 | 50.0 | 0.16 m, 0 deg | 73.8 | 0.03 m, 1.1 deg |"


def test_a_median_that_is_infinite_is_said_in_words_and_unknown_scenes_have_no_figures() -> None:
    accuracy = accuracy_of(
        [moved(0.01), *[Compared(TRUTH, None)] * 2], [SETS["cambridge"].threshold]
    )
    *_, row = table(SETS["cambridge"], [("elsewhere", 3, 1, accuracy)], "xfeat", "X")
    assert row == "| elsewhere | 3 | 1 | 33.3 | most are refused | - | - |"


def test_the_papers_means_are_those_of_its_scenes() -> None:
    """The averages that the paper prints, of the same tables."""
    for name, mean in (("7scenes", 82.47), ("cambridge", 93.98)):
        percents = [scene.percent for scene in SETS[name].scenes.values()]
        assert sum(percents) / len(percents) == pytest.approx(mean, abs=0.01)


def test_a_run_is_stamped_with_commit_and_date() -> None:
    assert re.fullmatch(r"commit \S+, \d{4}-\d\d-\d\d|commit no git, .*", run_stamp())
