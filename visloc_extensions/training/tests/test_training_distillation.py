from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from samples.papers import art_poster
from visloc.errors import InvalidInput
from visloc.features.networks.xfeat.extractor import XFeatExtractor, network_input
from visloc.features.networks.xfeat.load import load_xfeat
from visloc.options import Inference
from visloc_extensions.training.checkpoint import FILE_NAME, load_state
from visloc_extensions.training.distillation import Distillation, losses_of
from visloc_extensions.training.export import export
from visloc_extensions.training.files import read_about
from visloc_extensions.training.pairs import Pairs, make_sources
from visloc_extensions.training.photos import Photo, photo_levels
from visloc_extensions.training.run import Trainer, train
from visloc_extensions.training.settings import PRESETS, Settings

CPU = torch.device("cpu")
SMOKE = replace(
    PRESETS["distillation"], steps=12, crop_px=128, batch=3, parallax_share=0.0, warm_up_steps=2
)


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def photos() -> tuple[Photo, ...]:
    posters = (art_poster(np.random.default_rng(seed), 400, 420) for seed in range(3))
    return tuple(Photo(f"{n}", photo_levels(poster)) for n, poster in enumerate(posters))


def trainer(photos: tuple[Photo, ...], settings: Settings = SMOKE) -> Trainer:
    return Trainer(settings, make_sources(photos, (), CPU), {"photos": "posters"})


def unit(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    values = torch.from_numpy(rng.standard_normal(shape)).float()
    return torch.nn.functional.normalize(values, dim=1)


@dataclass(frozen=True)
class Trained:
    """A finished training: its folder, and the loss of one step before and after it."""

    folder: Path
    before: torch.Tensor
    after: torch.Tensor


@pytest.fixture(scope="module")
def trained(photos: tuple[Photo, ...], tmp_path_factory: pytest.TempPathFactory) -> Trained:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("trained")
    learning = trainer(photos)
    numbers = learning.task.numbers(3)
    before = learning.task.losses(numbers).detach().sum()
    assert train(learning, folder, seconds=None, checkpoint_every_s=1e9)
    return Trained(folder, before, learning.task.losses(numbers).detach().sum())


def test_the_loss_of_the_same_step_falls(trained: Trained) -> None:
    assert trained.after < 0.9 * trained.before


def test_unaltered_photos_stay_close_to_the_teacher_and_weights_ship(
    photos: tuple[Photo, ...], trained: Trained
) -> None:
    folder = trained.folder
    path = folder / "xfeat.safetensors"
    assert export(load_state(folder / FILE_NAME, CPU), path) == path.stat().st_size < 1_500_000
    about = read_about(path)
    assert about["licence"] == "Apache-2.0"
    student, teacher = load_xfeat(folder, Inference.TORCH), load_xfeat(None, Inference.TORCH)
    assert isinstance(student, XFeatExtractor)
    assert isinstance(teacher, XFeatExtractor)
    assert student.fingerprint.weights_sha256 != teacher.fingerprint.weights_sha256
    rgb = photos[0].levels[0].permute(1, 2, 0).contiguous().numpy()
    seen, taught = (each.network.look(network_input(rgb)) for each in (student, teacher))
    cosine = (seen.features * taught.features).sum(axis=2)
    assert np.median(cosine) > 0.9
    assert (cosine < 0.999).any()  # it did learn something


def test_nothing_is_left_to_learn_where_the_student_says_what_the_teacher_says() -> None:
    rng = np.random.default_rng(0)
    x, y = (torch.arange(64) + 0.5).expand(1, 64, 64), (torch.arange(64) + 0.5)[:, None]
    flow = torch.stack([x, y.expand(1, 64, 64)], dim=-1)
    grid = torch.arange(4, 64, 16)
    queries = torch.cartesian_prod(grid, grid)[None]
    # Both photos show the same: every place is found where it was.
    features = unit(rng, 1, 64, 8, 8).repeat(2, 1, 1, 1)
    logits = torch.zeros(2, 65, 8, 8)
    reliability = torch.full((2, 1, 8, 8), 1 - 1e-6)
    pairs = Pairs(torch.zeros(2, 3, 64, 64), flow, queries, queries)
    maps = (features, logits, reliability)
    losses = losses_of(maps, maps, pairs, torch.ones(2, 1, 1, 1))
    assert losses.max() < 0.05
    other = (unit(rng, 2, 64, 8, 8), logits, reliability)
    cross, own, features_loss, keypoints, _ = losses_of(
        other, maps, pairs, torch.ones(2, 1, 1, 1)
    ).tolist()
    assert min(cross, 2 * own) > 1.0
    assert features_loss > 2.0
    assert keypoints == pytest.approx(0.0, abs=1e-6)


def test_as_many_photos_stay_unaltered_in_every_step(photos: tuple[Photo, ...]) -> None:
    task = Distillation(SMOKE, make_sources(photos, (), CPU))
    lengths = {len(task.numbers(step)) for step in range(4)}
    assert len(lengths) == 1
    altered = task.numbers(0)[-4:]  # of 6, 2 stay: 37.5 %
    assert len(set(altered.tolist())) == 4
    assert altered.max() < 6


@pytest.mark.parametrize(
    ("name", "value"),
    [("crop_px", 200), ("unaltered_share", 1.0), ("closeness", -1.0), ("architecture", "sift")],
)
def test_settings_that_cannot_work_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        replace(SMOKE, **{name: value})
    assert caught.value.field == name
