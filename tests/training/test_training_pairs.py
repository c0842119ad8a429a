from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from training.augmentation import augment
from training.homographies import Matrix, flow_between, look, random_looks, strength_at
from training.pairs import Sources, make_pairs
from training.parallax import View, flow_to_view, random_parallax
from training.photos import Photo, photo_levels
from training.settings import Settings
from visloc.geometry import Camera, Pose

CPU = torch.device("cpu")


def _smooth_photo(height: int, width: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width] + 0.5
    waves = [np.sin(x / 17 + c) + np.cos(y / 23 - c) + np.sin((x + y) / 31) for c in range(3)]
    return np.asarray(127.5 + 40 * np.stack(waves, axis=-1), np.uint8)


def _moved(matrix: Matrix, x: float, y: float) -> NDArray[np.float64]:
    u, v, w = matrix @ [x, y, 1.0]
    return np.array([u / w, v / w])


def test_flow_of_a_shift_and_an_enlargement_is_exact_at_pixel_centres() -> None:
    # The first crop shows the photo from (10, 20), the second from (11, 20) at twice the size.
    first = np.array([[1.0, 0, 10], [0, 1, 20], [0, 0, 1]])
    second = np.array([[0.5, 0, 11], [0, 0.5, 20], [0, 0, 1]])
    flow = flow_between(first, second, 16, CPU)
    # The centre of pixel (3, 2) is (3.5, 2.5): in the photo (13.5, 22.5), in the second (5, 5).
    assert flow[2, 3].tolist() == [5.0, 5.0]
    assert flow[0, 0].isnan().all()  # (10.5, 20.5) is left of the second
    assert flow[0, 1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("seed", range(5))
def test_flow_of_random_looks_joins_pixels_that_see_the_same_spot(seed: int) -> None:
    first, second = random_looks(np.random.default_rng(seed), (400, 500), 64, 1.0)
    flow = flow_between(first, second, 64, CPU)
    known = ~flow[..., 0].isnan()
    assert known.float().mean() > 0.3
    for y, x in known.nonzero()[::97].tolist():
        u, v = flow[y, x].tolist()
        np.testing.assert_allclose(
            _moved(first, x + 0.5, y + 0.5), _moved(second, u, v), rtol=0, atol=1e-3
        )


@pytest.mark.parametrize("seed", range(8))
def test_both_looks_show_the_same_photo_where_the_flow_says(seed: int) -> None:
    levels = photo_levels(_smooth_photo(400, 500), CPU)
    looks = random_looks(np.random.default_rng(seed), (400, 500), 64, 1.0)
    first, second = (look(levels, each, 64) for each in looks)
    flow = flow_between(*looks, 64, CPU)
    grid = torch.nan_to_num(flow / 64 * 2 - 1, nan=5.0)
    seen = F.grid_sample(second[None], grid[None], align_corners=False, padding_mode="border")[0]
    known = ~flow[..., 0].isnan()
    assert (first - seen).abs()[:, known].mean() < 0.01


def test_an_unmoved_look_is_the_photo_itself() -> None:
    rgb = _smooth_photo(80, 96)
    seen = look(photo_levels(rgb, CPU), np.eye(3), 64)
    np.testing.assert_allclose(seen.numpy() * 255, rgb[:64, :64].transpose(2, 0, 1), atol=0.01)


def test_pairs_grow_harder_during_the_mild_steps() -> None:
    assert strength_at(0, 0) == 1.0
    assert [strength_at(step, 100) for step in (0, 50, 100, 200)] == [0.25, 0.625, 1.0, 1.0]


@pytest.mark.parametrize("seed", range(10))
def test_augmented_photos_stay_photos_and_repeat_by_seed(seed: int) -> None:
    images = torch.rand((3, 3, 32, 40), generator=torch.Generator().manual_seed(0))
    first, again = (augment(images, np.random.default_rng(seed), 1.0) for _ in range(2))
    assert first.shape == images.shape
    assert 0 <= first.min() <= first.max() <= 1
    assert torch.equal(first, again)
    assert not torch.equal(first, images)


def test_no_strength_changes_nothing() -> None:
    images = torch.rand((2, 3, 16, 16), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(augment(images, np.random.default_rng(0), 0.0), images)


CAMERA = Camera("PINHOLE", 64, 48, (50.0, 52.0, 31.0, 25.0))


def _view(depth: NDArray[np.float64], cam_from_world: Pose) -> View:
    return View(torch.zeros((3, 48, 64), dtype=torch.uint8), 1 / depth, cam_from_world, CAMERA)


def test_flow_between_views_is_the_projection_of_the_points() -> None:
    y, x = np.mgrid[:48, :64] + 0.5
    rays = np.stack([(x - 31) / 50, (y - 25) / 52, np.ones_like(x)], axis=-1)
    # A slanted wall, z = 3 + 0.4 x: seen from the world's origin, and from the side.
    first = _view(3 / (1 - 0.4 * rays[..., 0]), Pose.identity())
    turn = Pose.from_quaternion([0.999, 0.02, -0.03, 0.05], [0.2, -0.1, 0.15])
    normal = turn.rotation @ [-0.4, 0.0, 1.0]
    second = _view((3 + normal @ turn.translation) / (rays @ normal), turn)
    flow = flow_to_view(first, second, 8, 4, 32).numpy()
    seen = 0
    for row in range(0, 32, 3):
        for column in range(0, 32, 3):
            ray = rays[row + 4, column + 8]
            point = turn.apply(ray * 3 / (1 - 0.4 * ray[0]))
            expected = point[:2] / point[2] * [50, 52] + [31, 25]
            inside = 1 <= expected[0] <= 63 and 1 <= expected[1] <= 47
            if inside:
                seen += 1
                np.testing.assert_allclose(flow[row, column], expected, atol=1e-4)
    assert seen > 60


def test_what_something_nearer_hides_has_no_flow() -> None:
    wall = np.full((48, 64), 4.0)
    screen = wall.copy()
    screen[:, 30:] = 2.0  # hides the right part of the second view
    still = Pose.identity()
    flow = flow_to_view(_view(wall, still), _view(screen, still), 0, 0, 48)
    known = ~flow[..., 0].isnan()
    assert known[:, :29].all()
    assert not known[:, 30:].any()


def test_what_is_behind_the_second_camera_or_nowhere_has_no_flow() -> None:
    wall = np.full((48, 64), 4.0)
    first = _view(wall, Pose.identity())
    behind = _view(wall, Pose(np.eye(3), np.array([0.0, 0.0, -5.0])))
    assert flow_to_view(first, behind, 0, 0, 48).isnan().all()
    nothing = View(first.image, np.zeros((48, 64)), Pose.identity(), CAMERA)
    assert flow_to_view(nothing, first, 0, 0, 48).isnan().all()


def test_crops_of_two_views_overlap() -> None:
    wall = np.full((48, 64), 4.0)
    place = tuple(
        _view(wall, Pose(np.eye(3), np.array([shift, 0.0, 0.0]))) for shift in (0.0, 0.3, -0.4)
    )
    first, second, flow = random_parallax(np.random.default_rng(0), place, 24)
    assert first.shape == second.shape == (3, 24, 24)
    assert flow.shape == (24, 24, 2)
    assert (~flow[..., 0].isnan()).float().mean() > 0.5


def test_pairs_of_a_step_depend_on_seed_and_step_only() -> None:
    photo = Photo("a", photo_levels(_smooth_photo(200, 220), CPU))
    sources = Sources((photo,), (), CPU)
    settings = Settings(crop_px=48, batch=2, border_px=8, patch_px=8)
    first, again, later = (make_pairs(sources, settings, step) for step in (3, 3, 4))
    assert first.images.shape == (4, 3, 48, 48)
    assert first.queries.shape == (2, (48 - 16) ** 2 // 64, 2)
    for here, there in zip(first, again, strict=True):
        assert torch.equal(torch.nan_to_num(here), torch.nan_to_num(there))
    assert not torch.equal(first.images, later.images)
