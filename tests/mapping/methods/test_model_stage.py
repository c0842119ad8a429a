"""What a worker hands back is the model that it made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapping.methods.model_stage import _from_item, _to_item
from tests.mapping.methods.test_sfm import FOUND, model_of, photo_of


def test_a_model_comes_back_as_it_went() -> None:
    photos = [photo_of(number, "film") for number in range(4)]
    model = replace(model_of(FOUND, None, None, None), undone=3)
    again = _from_item(_to_item(model), photos)
    assert (again.undone, again.on_rigs) == (3, False)
    assert [view is None for view in again.views] == [False, True, True, True]
    view, known = again.views[0], model.views[0]
    assert view is not None
    assert known is not None
    assert view.camera == known.camera
    np.testing.assert_array_equal(view.cam_from_world.rotation, known.cam_from_world.rotation)
