from __future__ import annotations

import pickle
import subprocess
import sys

import pytest

from service.values import Abandoned
from service.workers import tasks
from service.workers.vision import Vision


def test_a_task_is_the_name_of_a_method_of_vision() -> None:
    assert str(tasks.Vision.localize) == Vision.localize.__name__


@pytest.mark.parametrize("received", [None, Abandoned()])
def test_the_main_process_loads_no_vision(received: object) -> None:
    heavy = {"torch", "cv2", "pycolmap", "service.workers.vision"}
    code = (
        f"import sys, pickle, service.server; pickle.loads({pickle.dumps(received)!r}); "
        f"sys.exit(bool({heavy} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")
