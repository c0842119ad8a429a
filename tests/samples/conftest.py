from __future__ import annotations

import pytest

from samples.scene import Scene, make_room


@pytest.fixture(scope="session")
def room() -> Scene:
    """The room of seed 0; painting it takes seconds."""
    return make_room(0)
