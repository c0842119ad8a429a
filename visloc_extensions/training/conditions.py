"""What happens to photos in training, drawn by NumPy in one piece for all photos of a step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

# How often each happens at full strength; by day and by night where they differ.
_TONE_SHARE = 0.5
_COLOUR_SHARE = 0.8
_BLUR_SHARE = (0.25, 0.4)
_MOTION_SHARE = (0.1, 0.25)
_NOISE_SHARE = (0.5, 1.0)
_LOCAL_CONTRAST_SHARE = (0.15, 0.4)
_GREY_SHARE = (0.05, 0.2)
_COMPRESSION_SHARE = (0.3, 0.5)
# The same with each weather, of what weather is drawn for.
_LEAVES_SHARE = 0.2
_SNOW_SHARE = 0.08
_WET_SHARE = 0.1
_SHADOW_SHARE = 0.35
_FOG_SHARE = 0.15
_RAIN_SHARE = 0.1
_DROPS_SHARE = 0.1

_LAMPS, _DROPS = 4, 6
_LAMP_COLOURS = np.array([[1.5, 0.8, 0.25], [1.2, 1.0, 0.7], [0.85, 1.0, 1.2]])  # sodium to LED
BLOCK_PX = 8
REACH_PX = 6  # of the blur: a motion of up to 12 px
NOISE_STRIP = 1 << 22  # numbers of noise


class Conditions(NamedTuple):
    """What happens to n photos, in arrays or tensors: (n,) each unless said otherwise.

    Of most, 0 does nothing.

    Attributes:
        leaves: (n, 3), logarithms of what green is multiplied by.
        snow: share of what may lie under snow.
        wet: how much wet ground darkens and mirrors.
        horizon: height from which it does, 0 to 1 from the top.
        night: 0 or 1.
        ambient: light that is left at night, besides lamps.
        lit: light in patches, as from windows.
        lamps: (n, lamps, 8): x, y in 0 to 1, brightness, reach, size of the glow, and RGB.
        fall: angle of the streaks from the vertical, radians.
        drops: (n, drops, 3): x, y in 0 to 1, radius; on the lens.
        defocus: standard deviation, px.
        motion: length, px.
        direction: of the motion, radians.
        exposure: logarithm of the gain by day.
        target: mean that the camera exposes for at night, linear.
        balance: (n, 3), logarithms.
        shot: 1 / electrons of white.
        read: read noise, share of white.
        smoothing: of the noise, as cameras do, 0 to 1.
        contrast: relative change of it.
        saturation: relative change of it.
        gamma: logarithm.
        curve: S of the tone curve.
        local_contrast: share of a local normalization, as CLAHE does.
        grey: share of grey.
        starts: where in the strip of noise a photo's begins.
        shift: (n, 2), of the grid of blocks, px; the first counts for all.
    """

    leaves: Any
    snow: Any
    wet: Any
    horizon: Any
    shadow: Any
    edge: Any
    night: Any
    ambient: Any
    lit: Any
    lamps: Any
    fog: Any
    air: Any
    rain: Any
    fall: Any
    drops: Any
    defocus: Any
    motion: Any
    direction: Any
    exposure: Any
    target: Any
    balance: Any
    shot: Any
    read: Any
    smoothing: Any
    contrast: Any
    saturation: Any
    gamma: Any
    curve: Any
    local_contrast: Any
    grey: Any
    compression: Any
    starts: Any
    shift: Any


class _Drawing:
    """Numbers for photos, each on its own, as ``draw_conditions`` was asked for them."""

    def __init__(
        self,
        rng: np.random.Generator,
        photos: int,
        strength: float,
        night_share: float,
        weather_share: float,
    ) -> None:
        self._rng, self._photos, self._strength = rng, photos, strength
        self.at_night = rng.random(photos) < night_share * strength
        self._has_weather = rng.random(photos) < weather_share

    def amount(
        self, share: float | tuple[float, float], lowest: float = 0.0, highest: float = 1.0
    ) -> Numbers:
        """Return 0 where it does not happen; the share may be one by day and one at night."""
        by_day, by_night = share if isinstance(share, tuple) else (share, share)
        happens = self._rng.random(self._photos) < self._strength * np.where(
            self.at_night, by_night, by_day
        )
        amounts = self._strength * self._rng.uniform(lowest, highest, self._photos)
        return np.where(happens, amounts, 0.0)

    def weather(self, share: float, lowest: float = 0.0, highest: float = 1.0) -> Numbers:
        """Return 0 for photos without a weather, too."""
        return np.where(self._has_weather, self.amount(share, lowest, highest), 0.0)

    def around(self, low: float, high: float) -> Numbers:
        """Return numbers whose logarithms are spread evenly."""
        return np.exp(self._rng.uniform(np.log(low), np.log(high), self._photos))


def draw_conditions(
    rng: np.random.Generator, photos: int, strength: float, night_share: float, weather_share: float
) -> Conditions:
    """Draw what happens to photos, each on its own.

    Args:
        strength: 0 to 1; at 0 nothing happens.
        night_share: of the photos, at full strength.
        weather_share: of them have a weather, a season, or shadows, if they draw it.
    """
    drawing = _Drawing(rng, photos, strength, night_share, weather_share)
    amount, weather, around = drawing.amount, drawing.weather, drawing.around
    at_night = drawing.at_night
    colour = amount(_COLOUR_SHARE)[:, None] * rng.uniform(-1, 1, (photos, 8))
    tone = amount(_TONE_SHARE)[:, None] * rng.uniform(-1, 1, (photos, 2))
    noisy = amount(_NOISE_SHARE, 0.3) > 0
    electrons = np.where(at_night, around(100, 4000), around(300, 20_000))
    lamp_tints = np.where(at_night, 0.3, 0.12)[:, None]
    return Conditions(
        leaves=weather(_LEAVES_SHARE, 0.3)[:, None]
        * rng.uniform([-0.2, -0.8, -0.8], [1, 0.2, 0.2], (photos, 3)),
        snow=weather(_SNOW_SHARE, 0.4),
        wet=weather(_WET_SHARE, 0.3),
        horizon=rng.uniform(0.2, 0.8, photos),
        shadow=weather(_SHADOW_SHARE, 0.2, 0.85),
        edge=around(2, 40),
        night=at_night.astype(np.float64),
        ambient=around(0.01, 0.3),
        lit=rng.uniform(0, 1, photos) * rng.integers(0, 2, photos),
        lamps=_draw_lamps(rng, photos),
        fog=weather(_FOG_SHARE, 0.3, 2.5),
        air=around(0.15, 0.7),
        rain=weather(_RAIN_SHARE, 0.2),
        fall=rng.uniform(-0.4, 0.4, photos),
        drops=np.concatenate(
            [
                rng.uniform(0, 1, (photos, _DROPS, 2)),
                rng.uniform(0.02, 0.09, (photos, _DROPS, 1))
                * (weather(_DROPS_SHARE, 0.5)[:, None, None] > 0),
            ],
            axis=2,
        ),
        defocus=amount(_BLUR_SHARE, 0.3, 1.4),
        motion=amount(_MOTION_SHARE, 2.0, 2.0 * REACH_PX - 2),
        direction=rng.uniform(0, np.pi, photos),
        exposure=0.6 * colour[:, 0],
        target=around(0.03, 0.35),
        balance=colour[:, 1:4] * lamp_tints,
        shot=noisy * strength / electrons,
        read=noisy * strength * rng.uniform(1, 4, photos) / electrons,
        smoothing=rng.uniform(0, 1, photos) * rng.integers(0, 2, photos),
        contrast=0.3 * colour[:, 4],
        saturation=0.5 * colour[:, 5],
        gamma=0.5 * tone[:, 0],
        curve=0.6 * tone[:, 1],
        local_contrast=amount(_LOCAL_CONTRAST_SHARE, 0.3),
        grey=np.where(amount(_GREY_SHARE) > 0, 1.0, 0.0),
        compression=amount(_COMPRESSION_SHARE, 0.01, 0.06),
        starts=rng.integers(NOISE_STRIP, size=photos).astype(np.float64),
        shift=rng.integers(BLOCK_PX, size=(photos, 2)).astype(np.float64),
    )


def _draw_lamps(rng: np.random.Generator, photos: int) -> Numbers:
    """Return lamps (photos, lamps, 8), some of them outside of the photo."""
    count = (photos, _LAMPS)
    place = rng.uniform(-0.3, 1.3, (*count, 2))
    is_on = rng.random(count) < 0.6
    brightness = np.exp(rng.uniform(np.log(0.3), np.log(3.0), count)) * is_on
    reach = np.exp(rng.uniform(np.log(0.08), np.log(0.6), count))
    glow = np.exp(rng.uniform(np.log(0.008), np.log(0.05), count))
    return np.concatenate(
        [
            place,
            np.stack([brightness, reach, glow], axis=2),
            _LAMP_COLOURS[rng.integers(len(_LAMP_COLOURS), size=count)],
        ],
        axis=2,
    )
