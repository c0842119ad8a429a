"""What decides the result of a training run; kept in every checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from visloc.errors import refuse

_BLOCK_PX = 8
ARCHITECTURES = ("faster2d2", "r2d2", "xfeat")
_XFEAT_MULTIPLE_PX = 32  # its coarsest layers have a 32nd of the resolution


def _setting(default: Any, meaning: str) -> Any:
    return field(default=default, metadata={"meaning": meaning})


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything that decides the result, but for the photos; the defaults are the published ones.

    The published recipe: 192 px crops, batches of 8, Adam with 1e-4 throughout, 20 epochs of 2002
    steps; losses of patches of 16 px. The metadata of each field says what it means.
    """

    architecture: str = _setting("faster2d2", "r2d2, faster2d2, or xfeat with a teacher")
    seed: int = _setting(0, "of the first weights, the pairs and the sampler")
    steps: int = _setting(40_000, "of the optimizer")
    crop_px: int = _setting(192, "side of the square crops, a multiple of 8")
    batch: int = _setting(8, "pairs per step")
    learning_rate: float = _setting(1e-4, "Adam's, after warming up")
    final_learning_rate: float = _setting(1e-4, "at the last step")
    warm_up_steps: int = _setting(0, "in which the learning rate rises from almost zero")
    decay_from: float = _setting(1.0, "share of the steps after which it falls, half a cosine")
    weight_decay: float = _setting(5e-4, "added to the gradient, times the weight")
    patch_px: int = _setting(16, "of the repeatability losses, even")
    query_step_px: int = _setting(8, "one query per square of this side, placed at random")
    border_px: int = _setting(16, "from the crop's border in which there are no queries")
    good_precision: float = _setting(0.5, "average precision above which a place is reliable")
    mild_steps: int = _setting(0, "in which pairs grow from mild to as hard as they get")
    parallax_share: float = _setting(0.0, "of the pairs, from synthetic rooms instead of photos")
    night_share: float = _setting(0.0, "of the photos, taken as at night")
    weather_share: float = _setting(0.0, "of the photos that may have weather, season, shadows")
    unaltered_share: float = _setting(0.0, "of the photos that a student sees as its teacher does")
    closeness: float = _setting(1.0, "weight of likeness to the teacher on unaltered photos")
    bf16: bool = _setting(False, "convolutions in bfloat16, everything else in float32")
    compiled: bool = _setting(False, "compile the network: no gain on processors")

    def __post_init__(self) -> None:
        for name, is_right, expected in (
            ("architecture", self.architecture in ARCHITECTURES, " or ".join(ARCHITECTURES)),
            ("seed", self.seed >= 0, "0 or more"),
            ("steps", self.steps >= 1, "1 or more"),
            (
                "crop_px",
                self.crop_px % _BLOCK_PX == 0 and self.crop_px > 2 * self.border_px,
                f"a multiple of {_BLOCK_PX}, more than twice the border of {self.border_px}",
            ),
            (
                "crop_px",
                self.architecture != "xfeat" or self.crop_px % _XFEAT_MULTIPLE_PX == 0,
                f"a multiple of {_XFEAT_MULTIPLE_PX} for xfeat",
            ),
            ("unaltered_share", 0 <= self.unaltered_share <= 0.9, "0 to 0.9"),
            ("closeness", self.closeness >= 0, "0 or more"),
            ("batch", self.batch >= 1, "1 or more"),
            ("learning_rate", 0 < self.learning_rate < 1, "between 0 and 1"),
            ("final_learning_rate", 0 < self.final_learning_rate < 1, "between 0 and 1"),
            ("warm_up_steps", self.warm_up_steps >= 0, "0 or more"),
            ("decay_from", 0 <= self.decay_from <= 1, "0 to 1"),
            ("weight_decay", 0 <= self.weight_decay < 1, "0 to 1"),
            (
                "patch_px",
                self.patch_px % 2 == 0 and 2 <= self.patch_px <= self.crop_px,
                f"an even number up to the crop's {self.crop_px}",
            ),
            ("query_step_px", self.query_step_px >= 1, "1 or more"),
            ("border_px", self.border_px >= 0, "0 or more"),
            ("good_precision", 0 < self.good_precision < 1, "between 0 and 1"),
            ("mild_steps", self.mild_steps >= 0, "0 or more"),
            ("night_share", 0 <= self.night_share <= 1, "0 to 1"),
            ("weather_share", 0 <= self.weather_share <= 1, "0 to 1"),
            ("parallax_share", 0 <= self.parallax_share <= 1, "0 to 1"),
        ):
            if not is_right:
                raise refuse(
                    "training.setting", field=name, expected=expected, got=getattr(self, name)
                )

    @property
    def queries_per_image(self) -> int:
        """How many pixels of an image ask for their match."""
        return max(1, (self.crop_px - 2 * self.border_px) ** 2 // self.query_step_px**2)

    def difference_to(self, other: Settings) -> str | None:
        """Return the name of the first setting that differs, None if none does."""
        names = (each.name for each in fields(self))
        return next((n for n in names if getattr(self, n) != getattr(other, n)), None)


PRESETS = {
    "published": Settings(),
    # Measured on two processor cores, see README.md.
    "processor": Settings(
        steps=4_000,
        crop_px=128,
        batch=4,
        learning_rate=1e-3,
        final_learning_rate=1e-5,
        warm_up_steps=100,
        decay_from=0.0,
        query_step_px=6,
        mild_steps=1_000,
        parallax_share=0.2,
        night_share=0.15,
        bf16=True,
    ),
    # For one GPU, with light and weather beyond the published recipe.
    "gpu": Settings(
        learning_rate=1e-3,
        final_learning_rate=1e-5,
        warm_up_steps=600,
        decay_from=0.0,
        mild_steps=3_000,
        parallax_share=0.2,
        night_share=0.35,
        weather_share=0.7,
        bf16=True,
    ),
    # Measured on two processor cores, see README.md.
    "distillation": Settings(
        architecture="xfeat",
        steps=1_500,
        batch=8,
        learning_rate=3e-4,
        final_learning_rate=1e-6,
        warm_up_steps=50,
        decay_from=0.0,
        weight_decay=0.0,
        query_step_px=8,
        mild_steps=150,
        parallax_share=0.15,
        night_share=0.5,
        weather_share=0.5,
        unaltered_share=0.375,
        closeness=2.0,
    ),
    # For tests: seconds, and the loss falls.
    "smoke": Settings(
        steps=20,
        crop_px=64,
        batch=2,
        learning_rate=3e-3,
        final_learning_rate=1e-3,
        warm_up_steps=2,
        decay_from=0.0,
        patch_px=8,
        border_px=8,
        mild_steps=1_000,
    ),
}
