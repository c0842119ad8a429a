from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from samples.papers import art_poster
from visloc.errors import InvalidInput
from visloc.features.networks.r2d2.architecture import ARCHITECTURES
from visloc.features.networks.r2d2.extractor import R2D2Extractor
from visloc.features.networks.r2d2.load import load_faster2d2
from visloc.options import Inference
from visloc.photos.reading import read_photo_file
from visloc_extensions.training.__main__ import main
from visloc_extensions.training.checkpoint import FILE_NAME, load_state
from visloc_extensions.training.export import export
from visloc_extensions.training.network import TrainableR2D2
from visloc_extensions.training.pairs import make_sources
from visloc_extensions.training.photos import Photo, photo_levels
from visloc_extensions.training.run import LOG_NAME, Trainer, learning_rate, resume, train
from visloc_extensions.training.settings import PRESETS, Settings
from visloc_extensions.training.validation import features_of, validate, validation_pairs

CPU = torch.device("cpu")
SMOKE = PRESETS["smoke"]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def photos(sample: Path) -> tuple[Photo, ...]:
    """The mapping photos of the sample."""
    paths = sorted((sample / "mapping").rglob("*.jpg"))
    return tuple(Photo(path.name, photo_levels(read_photo_file(path).rgb)) for path in paths)


def _trainer(photos: tuple[Photo, ...], settings: Settings = SMOKE) -> Trainer:
    return Trainer(settings, make_sources(photos, (), CPU), {"photos": "of the sample"})


def _train(trainer: Trainer, folder: Path, stop_at: int | None = None) -> bool:
    return train(
        trainer,
        folder,
        seconds=None,
        checkpoint_every_s=1e9,
        should_stop=lambda: trainer.step == stop_at,
    )


def _log(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / LOG_NAME).read_text().splitlines()]


def test_twenty_steps_lower_the_loss(photos: tuple[Photo, ...], tmp_path: Path) -> None:
    assert _train(_trainer(photos), tmp_path)
    totals = [line["total"] for line in _log(tmp_path)]
    assert len(totals) == SMOKE.steps == 20
    assert np.mean(totals[-5:]) < np.mean(totals[:5]) - 0.1


def test_a_run_that_was_stopped_goes_on_bit_by_bit(
    photos: tuple[Photo, ...], tmp_path: Path
) -> None:
    settings = replace(SMOKE, steps=4)
    whole = _trainer(photos, settings)
    assert _train(whole, tmp_path / "whole")
    assert not _train(_trainer(photos, settings), tmp_path / "parts", stop_at=2)
    again = _trainer(photos, settings)
    resume(again, tmp_path / "parts")
    assert again.step == 2
    assert _train(again, tmp_path / "parts")
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, again.network.state_dict()[name]), name
    ours, theirs = (
        [{**line, "seconds": 0} for line in _log(tmp_path / each)] for each in ("whole", "parts")
    )
    assert ours == theirs


def test_lines_after_the_checkpoint_are_cut(photos: tuple[Photo, ...], tmp_path: Path) -> None:
    settings = replace(SMOKE, steps=3)
    _train(_trainer(photos, settings), tmp_path, stop_at=2)
    with (tmp_path / LOG_NAME).open("a") as log:
        log.write('{"step": 2, "total": 0.0}\n')
    again = _trainer(photos, settings)
    resume(again, tmp_path)
    _train(again, tmp_path)
    assert [line["step"] for line in _log(tmp_path)] == [0, 1, 2]
    assert _log(tmp_path)[2]["total"] > 0


@pytest.mark.parametrize(("warm_up", "steps"), [(4, 5), (0, 3)])
def test_a_run_does_no_more_steps_than_fit(
    photos: tuple[Photo, ...], tmp_path: Path, warm_up: int, steps: int
) -> None:
    trainer = _trainer(photos, replace(SMOKE, steps=1000, warm_up_steps=warm_up))
    # No time is left when the steps have been timed: one step more, the last.
    assert train(trainer, tmp_path, seconds=None, checkpoint_every_s=1e9, fit_seconds=0.0)
    assert trainer.step == trainer.settings.steps == steps
    assert load_state(tmp_path / FILE_NAME, CPU).settings.steps == steps


def test_a_run_with_other_settings_is_not_mixed_in(
    photos: tuple[Photo, ...], tmp_path: Path
) -> None:
    _train(_trainer(photos, replace(SMOKE, steps=1)), tmp_path)
    with pytest.raises(InvalidInput, match="other settings") as caught:
        resume(_trainer(photos, replace(SMOKE, steps=1, seed=5)), tmp_path)
    assert caught.value.field == "seed"


def test_a_checkpoint_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / FILE_NAME
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(InvalidInput) as caught:
        load_state(path, CPU)
    assert caught.value.code == "training.checkpoint"
    torch.save({"version": 1, "settings": {"steps": -1}}, path)
    with pytest.raises(InvalidInput):
        load_state(path, CPU)


@pytest.mark.parametrize(
    ("name", "value"),
    [("crop_px", 100), ("crop_px", 32), ("patch_px", 7), ("steps", 0), ("learning_rate", 0.0)],
)
def test_settings_that_cannot_work_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        replace(Settings(), **{name: value})
    assert caught.value.field == name


def test_the_learning_rate_warms_up_stays_and_falls() -> None:
    settings = replace(
        Settings(),
        steps=100,
        warm_up_steps=10,
        decay_from=0.5,
        learning_rate=1e-3,
        final_learning_rate=1e-5,
    )
    rates = [learning_rate(settings, step) for step in range(100)]
    assert rates[0] < rates[5] < rates[10] == 1e-3 == rates[49]
    assert rates[99] == pytest.approx(1e-5)
    assert np.all(np.diff(rates[50:]) <= 0)
    assert {learning_rate(Settings(), step) for step in (0, 20_000, 39_999)} == {1e-4}


def test_exported_weights_give_the_maps_of_the_network_that_was_trained(
    photos: tuple[Photo, ...], tmp_path: Path
) -> None:
    trainer = _trainer(photos)
    _train(trainer, tmp_path)
    path = tmp_path / "faster2d2.safetensors"
    assert export(load_state(tmp_path / FILE_NAME, CPU), path) == path.stat().st_size < 2_000_000
    extractor = load_faster2d2(tmp_path, Inference.TORCH)
    assert isinstance(extractor, R2D2Extractor)
    rgb = photos[0].levels[0].permute(1, 2, 0).numpy()
    image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        maps = trainer.network.eval()(image)
    with extractor.network.look(rgb.astype(np.float32)) as seen:
        reliability, repeatability = torch.from_numpy(seen.logits)
        y, x = np.mgrid[3:190:40, 5:250:40].reshape(2, -1)
        descriptors = torch.from_numpy(seen.descriptors(x, y))
    softplus = F.softplus(repeatability)
    # What 16 bits leave of the weights.
    torch.testing.assert_close(torch.sigmoid(reliability), maps.reliability[0], rtol=0, atol=5e-3)
    expected = maps.repeatability[0]
    torch.testing.assert_close(softplus / (1 + softplus), expected, rtol=0, atol=5e-3)
    enlarged = F.interpolate(maps.features.permute(0, 3, 1, 2), scale_factor=2, mode="bilinear")
    trained = F.normalize(enlarged[0, :, y, x].T, dim=1)
    assert (descriptors * trained).sum(dim=1).min() > 0.9999


@pytest.mark.parametrize("name", ["r2d2", "faster2d2"])
def test_every_architecture_says_something_about_every_pixel(name: str) -> None:
    network = TrainableR2D2(ARCHITECTURES[name])
    maps = network(torch.rand(2, 3, 24, 32))
    assert maps.reliability.shape == maps.repeatability.shape == (2, 24, 32)
    assert maps.stride == ARCHITECTURES[name].stride
    lengths = maps.squared_length
    assert (lengths >= 0).all()


def test_a_checkpoint_is_validated_as_it_would_be_shipped(
    photos: tuple[Photo, ...], tmp_path: Path
) -> None:
    _train(_trainer(photos, replace(SMOKE, steps=1)), tmp_path)
    extractor = features_of(load_state(tmp_path / FILE_NAME, CPU))
    score = validate(extractor, validation_pairs(photos[:1]))
    assert len(score.matching_accuracy) == 3
    assert 0 <= score.matching_accuracy[0] <= score.matching_accuracy[2] <= 1


def test_perfect_features_match_perfectly(photos: tuple[Photo, ...]) -> None:
    from visloc.features import make_local_features

    pair = validation_pairs(photos[:1])[0]
    same = replace(pair, second=pair.first, second_from_first=np.eye(3))
    score = validate(make_local_features("sift"), [same])
    assert score.matching_accuracy == pytest.approx((1.0, 1.0, 1.0))
    assert score.repeatability == 1.0


def test_the_command_packs_trains_resumes_exports_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, licence in (("free", "CC0 1.0"), ("some_research", "NC"), ("validation", "CC0")):
        (tmp_path / "photos" / folder).mkdir(parents=True)
        for number in range(2):
            poster = art_poster(np.random.default_rng(number), 400, 420)
            cv2.imwrite(str(tmp_path / "photos" / folder / f"{number}.jpg"), poster)
        table = f"file\tlicence\n0.jpg\t{licence}\n1.jpg\t{licence}\n"
        (tmp_path / "photos" / folder / "SOURCES.tsv").write_text(table)
    pack, held_back, run = (str(tmp_path / name) for name in ("pack", "held_back", "run"))
    photos = str(tmp_path / "photos")
    assert main(["pack", photos, "--output", pack]) == 0
    assert "2 photos" in capsys.readouterr().out
    assert main(["pack", photos, "--output", held_back, "--validation"]) == 0
    begin = ["run", run, "--photos", pack, "--preset", "smoke", "--steps", "2", "--threads", "1"]
    validation = ["--validate-every", "1", "--validation", held_back]
    assert main([*begin, *validation, "--for-seconds", "0"]) == 0
    assert "step 1 of 2" in capsys.readouterr().out
    assert main(begin) == 1
    assert "use resume" in capsys.readouterr().err
    assert main(["resume", run, "--photos", pack, *validation]) == 0
    assert "step 2 of 2: finished" in capsys.readouterr().out
    state = load_state(Path(run) / FILE_NAME, CPU)
    assert state.sources["licences"] == "2 CC0 1.0"
    assert main(["export", f"{run}/{FILE_NAME}", f"{run}/faster2d2.safetensors"]) == 0
    assert main(["plots", run]) == 0
    for name in ("loss.png", "validation.png"):
        assert (Path(run) / name).read_bytes().startswith(b"\x89PNG")


def test_a_missing_pack_is_told_how_to_make(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(tmp_path / "run"), "--photos", str(tmp_path / "none")]) == 1
    assert "python -m visloc_extensions.training pack" in capsys.readouterr().err
