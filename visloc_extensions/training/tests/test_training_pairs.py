from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc.geometry import Camera, Pose
from visloc_extensions.training.atlas import levels_to_look_at, look, make_atlas
from visloc_extensions.training.augmentation import augment
from visloc_extensions.training.conditions import Conditions, draw_conditions
from visloc_extensions.training.homographies import (
    applied,
    pixel_centres,
    random_looks,
    strength_at,
)
from visloc_extensions.training.pairs import Sources, draw, make, make_pairs, make_sources
from visloc_extensions.training.parallax import Rooms, View, make_rooms, other_view, random_views
from visloc_extensions.training.photos import Photo, photo_levels
from visloc_extensions.training.settings import Settings

CPU = torch.device("cpu")
PLAIN = Settings(crop_px=64, batch=4, border_px=8, patch_px=8)


def _smooth_photo(height: int, width: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width] + 0.5
    waves = [np.sin(x / 17 + c) + np.cos(y / 23 - c) + np.sin((x + y) / 31) for c in range(3)]
    return np.asarray(127.5 + 40 * np.stack(waves, axis=-1), np.uint8)


def _sources(*sizes: tuple[int, int]) -> Sources:
    photos = [Photo(str(size), photo_levels(_smooth_photo(*size))) for size in sizes]
    return make_sources(photos, (), CPU)


def _unlit(conditions: Conditions) -> Conditions:
    """Nothing happens."""
    return draw_conditions(np.random.default_rng(0), len(conditions.snow), 0.0, 0.0, 0.0)


def _disagreement(images: Tensor, flow: Tensor) -> tuple[float, float]:
    """Return how far images differ where the flow joins them, and the share that it joins."""
    first, second = images.chunk(2)
    side = images.shape[-1]
    grid = torch.nan_to_num(flow / side * 2 - 1, nan=5.0)
    seen = F.grid_sample(second, grid, align_corners=False, padding_mode="border")
    known = ~flow[..., 0].isnan()
    gap = (first - seen).abs().mean(dim=1)
    return float(gap[known].mean()), float(known.float().mean())


def test_homographies_take_pixel_centres_where_they_should() -> None:
    # The first crop shows the photo from (10, 20), the second from (11, 20) at twice the size.
    first = torch.tensor([[[1.0, 0, 10], [0, 1, 20], [0, 0, 1]]], dtype=torch.float64)
    second = torch.tensor([[[0.5, 0, 11], [0, 0.5, 20], [0, 0, 1]]], dtype=torch.float64)
    flow = applied(second.inverse(), applied(first, pixel_centres(16, CPU)))[0]
    # The centre of pixel (3, 2) is (3.5, 2.5): in the photo (13.5, 22.5), in the second (5, 5).
    assert flow[2, 3].tolist() == [5.0, 5.0]
    assert flow[0, 1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("step", range(5))
def test_both_looks_show_the_same_photo_where_the_flow_says(step: int) -> None:
    sources = _sources((400, 500), (300, 200))
    drawn, conditions = draw(sources, PLAIN, step)
    numbers = type(drawn)(*(torch.from_numpy(np.asarray(each, np.float64)) for each in drawn))
    pairs = make(sources, PLAIN, numbers, _unlit(conditions))
    gap, share = _disagreement(pairs.images, pairs.flow)
    assert gap < 0.01
    assert share > 0.3


def test_flow_leads_into_the_second_crop_or_nowhere() -> None:
    flow = make_pairs(_sources((200, 220)), PLAIN, 1).flow
    known = flow[~flow[..., 0].isnan()]
    assert 0 <= known.min() <= known.max() < PLAIN.crop_px
    assert flow.isnan().any()


def test_looks_are_about_the_same_part_of_a_photo() -> None:
    sizes = np.array([[400, 500], [300, 200], [512, 512]])
    first, second = random_looks(np.random.default_rng(0), sizes, 64, 1.0)
    middle = torch.full((3, 1, 1, 2), 32.0, dtype=torch.float64)
    one, other = (applied(torch.from_numpy(each), middle)[:, 0, 0] for each in (first, second))
    assert (one >= 0).all()
    assert (one < torch.tensor(sizes[:, ::-1].copy())).all()
    assert (one - other).norm(dim=1).max() < 64


def test_an_unmoved_look_is_the_photo_itself() -> None:
    photos = [_smooth_photo(70, 64), _smooth_photo(80, 96)]
    atlas = make_atlas([Photo("", photo_levels(rgb)) for rgb in photos], CPU)
    still = np.tile(np.eye(3), (2, 1, 1))
    begins, sizes, matrices = map(
        torch.from_numpy, levels_to_look_at(atlas, np.array([1, 0]), still, 64)
    )
    seen = look(atlas.pixels, begins, sizes, matrices, 64)
    for image, rgb in zip(seen, photos[::-1], strict=True):
        np.testing.assert_allclose(image.numpy() * 255, rgb[:64, :64].transpose(2, 0, 1), atol=0.01)


def test_beyond_its_edges_a_photo_is_mirrored() -> None:
    rgb = _smooth_photo(64, 64)
    atlas = make_atlas([Photo("", photo_levels(rgb))], CPU)
    left = np.array([[[1.0, 0, -64], [0, 1, 0], [0, 0, 1]]])
    begins, sizes, matrices = map(torch.from_numpy, levels_to_look_at(atlas, [0], left, 64))
    seen = look(atlas.pixels, begins, sizes, matrices, 64)[0]
    np.testing.assert_allclose(seen.numpy() * 255, rgb[:, ::-1].transpose(2, 0, 1), atol=0.01)


def test_pairs_grow_harder_during_the_mild_steps() -> None:
    assert strength_at(0, 0) == 1.0
    assert [strength_at(step, 100) for step in (0, 50, 100, 200)] == [0.25, 0.625, 1.0, 1.0]


def _photos(count: int, height: int = 32, width: int = 40) -> Tensor:
    return torch.rand((count, 3, height, width), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("seed", range(10))
def test_augmented_photos_stay_photos_and_repeat_by_seed(seed: int) -> None:
    images = _photos(6)
    first, again = (
        augment(images, draw_conditions(np.random.default_rng(seed), 6, 1.0, 0.5, 1.0))
        for _ in range(2)
    )
    assert first.shape == images.shape
    assert 0 <= first.min() <= first.max() <= 1
    assert torch.equal(first, again)
    assert not torch.equal(first, images)


def test_no_strength_changes_nothing() -> None:
    images = _photos(2, 16, 16)
    same = augment(images, draw_conditions(np.random.default_rng(0), 2, 0.0, 1.0, 1.0))
    torch.testing.assert_close(same, images, rtol=0, atol=1e-5)


def _nothing_but(**changes: float) -> Conditions:
    still = draw_conditions(np.random.default_rng(0), 1, 0.0, 0.0, 0.0)
    return still._replace(**{name: np.array([value]) for name, value in changes.items()})


def test_a_camera_exposes_for_the_mean_at_night() -> None:
    lamps = np.zeros((1, 1, 8))
    lamps[..., 3:5] = 1  # off
    night = _nothing_but(night=1.0, ambient=0.05, target=0.1, lit=0.0)._replace(lamps=lamps)
    image = augment(_photos(1, 64, 64) * 0.5, night).double()
    linear = torch.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    grey = (linear * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(dim=1)
    assert float(grey.mean()) == pytest.approx(0.1, rel=0.05)


def test_shot_noise_grows_with_the_root_of_the_light() -> None:
    encoded = torch.full((1, 3, 64, 64), 0.5)
    encoded[..., 32:] = 0.25
    image = augment(encoded, _nothing_but(shot=1e-3)).double()
    linear = ((image + 0.055) / 1.055) ** 2.4
    bright, dark = linear[..., :30], linear[..., 34:]
    expected = (bright.mean() / dark.mean()).sqrt()
    assert float(bright.std() / dark.std()) == pytest.approx(float(expected), rel=0.05)
    assert float(bright.std()) == pytest.approx(float((1e-3 * bright.mean()).sqrt()), rel=0.05)


def test_fog_brings_everything_nearer_to_its_own_brightness() -> None:
    images = _photos(1, 64, 64)
    image = augment(images, _nothing_but(fog=2.0, air=0.5))
    assert image.std() < 0.7 * images.std()
    assert image[..., :32, :].std() < image[..., 32:, :].std()  # what is up is far


def test_a_moving_camera_smears_along_its_way_only() -> None:
    stripes = torch.zeros((1, 3, 64, 64))
    stripes[..., ::8] = 1.0
    along, across = (
        augment(stripes, _nothing_but(motion=8.0, direction=angle)) for angle in (np.pi / 2, 0.0)
    )
    assert along[..., 16:48, 16:48].std() > 2 * across[..., 16:48, 16:48].std()


CAMERA = Camera("PINHOLE", 64, 48, (50.0, 52.0, 31.0, 25.0))


def _view(depth: NDArray[np.float64], cam_from_world: Pose) -> View:
    return View(torch.zeros((3, 48, 64), dtype=torch.uint8), 1 / depth, cam_from_world, CAMERA)


def _rooms(*views: View) -> Rooms:
    return make_rooms([views], CPU)


def _seen(first: View, second: View) -> NDArray[np.float64]:
    """Return where all pixels of the first view (48, 64, 2) are in the second."""
    rooms = _rooms(first, second)
    y, x = np.mgrid[:48, :64] + 0.5
    found = other_view(
        rooms.inverse_depth,
        torch.tensor(rooms.pairs[:1]),
        torch.tensor(rooms.intrinsics[rooms.pairs[:1]]),
        torch.tensor(rooms.second_from_first[:1]),
        torch.from_numpy(np.stack([x, y], axis=-1))[None],
    )
    return np.asarray(found[0].numpy())


def test_flow_between_views_is_the_projection_of_the_points() -> None:
    y, x = np.mgrid[:48, :64] + 0.5
    rays = np.stack([(x - 31) / 50, (y - 25) / 52, np.ones_like(x)], axis=-1)
    # A slanted wall, z = 3 + 0.4 x: seen from the world's origin, and from the side.
    first = _view(3 / (1 - 0.4 * rays[..., 0]), Pose.identity())
    turn = Pose.from_quaternion([0.999, 0.02, -0.03, 0.05], [0.2, -0.1, 0.15])
    normal = turn.rotation @ [-0.4, 0.0, 1.0]
    second = _view((3 + normal @ turn.translation) / (rays @ normal), turn)
    flow = _seen(first, second)[4:36, 8:40]
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
    known = ~np.isnan(_seen(_view(wall, still), _view(screen, still))[..., 0])
    assert known[:, :29].all()
    assert not known[:, 30:].any()


def test_what_is_behind_the_second_camera_or_nowhere_has_no_flow() -> None:
    wall = np.full((48, 64), 4.0)
    first = _view(wall, Pose.identity())
    behind = _view(wall, Pose(np.eye(3), np.array([0.0, 0.0, -5.0])))
    assert np.isnan(_seen(first, behind)).all()
    nothing = View(first.image, np.zeros((48, 64)), Pose.identity(), CAMERA)
    assert np.isnan(_seen(nothing, first)).all()


def test_looks_at_two_views_overlap() -> None:
    wall = np.full((48, 64), 4.0)
    rooms = _rooms(
        *(_view(wall, Pose(np.eye(3), np.array([shift, 0.0, 0.0]))) for shift in (0.0, 0.3, -0.4))
    )
    assert len(rooms.pairs) == 6
    pair, first, second = random_views(np.random.default_rng(0), rooms, 5, 24, 1.0)
    assert pair.shape == (5,)
    assert first.shape == second.shape == (5, 3, 3)


def test_views_of_a_place_agree_where_the_flow_says() -> None:
    wall = np.full((48, 64), 4.0)
    wide = _smooth_photo(48, 128)
    # 5 px of a wall at 4 m are 0.4 m.
    place = tuple(
        replace(
            _view(wall, Pose(np.eye(3), np.array([-0.08 * shift, 0.0, 0.0]))),
            image=torch.from_numpy(wide[:, shift : shift + 64].transpose(2, 0, 1).copy()),
        )
        for shift in (0, 5, 10)
    )
    photo = Photo("a", photo_levels(_smooth_photo(100, 100)))
    sources = make_sources([photo], [place], CPU)
    settings = replace(PLAIN, crop_px=24, border_px=4, parallax_share=1.0)
    drawn, conditions = draw(sources, settings, 0)
    assert drawn.in_room.all()
    numbers = type(drawn)(*(torch.from_numpy(np.asarray(each, np.float64)) for each in drawn))
    pairs = make(sources, settings, numbers, _unlit(conditions))
    gap, share = _disagreement(pairs.images, pairs.flow)
    assert gap < 0.02
    assert share > 0.3


def test_pairs_of_a_step_depend_on_seed_and_step_only() -> None:
    sources = _sources((200, 220))
    settings = replace(PLAIN, crop_px=48, batch=2, night_share=0.5, weather_share=1.0)
    first, again, later = (make_pairs(sources, settings, step) for step in (3, 3, 4))
    assert first.images.shape == (4, 3, 48, 48)
    assert first.queries.shape == (2, (48 - 16) ** 2 // 64, 2)
    for here, there in zip(first, again, strict=True):
        assert torch.equal(torch.nan_to_num(here), torch.nan_to_num(there))
    assert not torch.equal(first.images, later.images)
