"""What light, weather, lenses, sensors and their programs do to a photo.

A photo is taken back to linear light. There its surfaces, the lamps, the air, the lens and the
sensor act in the order in which light passes them; then it is developed, as a camera does, and
compressed. What happens to a photo is drawn by NumPy, in one piece for all photos of a step; the
pixels stay on their device, and the same operations run whatever was drawn, so that a GPU can
record them once.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

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
_GREY = (0.299, 0.587, 0.114)  # of RGB (ITU-R BT.601)
_BLOCK_PX = 8
_REACH_PX = 6  # of the blur: a motion of up to 12 px
_STRIP = 1 << 22  # numbers of noise


class Conditions(NamedTuple):
    """What happens to n photos, in arrays or tensors: (n,) each unless said otherwise.

    Of most, 0 does nothing.

    Attributes:
        leaves: (n, 3), logarithms of what green is multiplied by.
        snow: share of what may lie under snow.
        wet: how much wet ground darkens and mirrors.
        horizon: height from which it does, 0 to 1 from the top.
        shadow: how dark shadows are.
        edge: how sharp they are.
        night: 0 or 1.
        ambient: light that is left at night, besides lamps.
        lit: light in patches, as from windows.
        lamps: (n, lamps, 8): x, y in 0 to 1, brightness, reach, size of the glow, and RGB.
        fog: optical depth of the furthest.
        air: brightness of the fog.
        rain: brightness of its streaks.
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
        compression: coarseness of the cosine transform.
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


def draw_conditions(
    rng: np.random.Generator, photos: int, strength: float, night_share: float, weather_share: float
) -> Conditions:
    """Draw what happens to photos, each on its own.

    Args:
        rng: random numbers.
        photos: how many.
        strength: 0 to 1; at 0 nothing happens.
        night_share: of the photos, at full strength.
        weather_share: of them have a weather, a season, or shadows, if they draw it.
    """
    at_night = rng.random(photos) < night_share * strength
    has_weather = rng.random(photos) < weather_share

    def amount(
        share: float | tuple[float, float], lowest: float = 0.0, highest: float = 1.0
    ) -> Numbers:
        """Return 0 where it does not happen; the share may be one by day and one at night."""
        by_day, by_night = share if isinstance(share, tuple) else (share, share)
        happens = rng.random(photos) < strength * np.where(at_night, by_night, by_day)
        return np.where(happens, strength * rng.uniform(lowest, highest, photos), 0.0)

    def weather(share: float, lowest: float = 0.0, highest: float = 1.0) -> Numbers:
        return np.where(has_weather, amount(share, lowest, highest), 0.0)

    def around(low: float, high: float) -> Numbers:
        """Return numbers whose logarithms are spread evenly."""
        return np.exp(rng.uniform(np.log(low), np.log(high), photos))

    colour = amount(_COLOUR_SHARE)[:, None] * rng.uniform(-1, 1, (photos, 8))
    tone = amount(_TONE_SHARE)[:, None] * rng.uniform(-1, 1, (photos, 2))
    noisy = amount(_NOISE_SHARE, 0.3) > 0
    electrons = np.where(at_night, around(30, 2000), around(300, 20_000))
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
        motion=amount(_MOTION_SHARE, 2.0, 2.0 * _REACH_PX - 2),
        direction=rng.uniform(0, np.pi, photos),
        exposure=0.6 * colour[:, 0],
        target=around(0.015, 0.2),
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
        starts=rng.integers(_STRIP, size=photos).astype(np.float64),
        shift=rng.integers(_BLOCK_PX, size=(photos, 2)).astype(np.float64),
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


def augment(images: Tensor, conditions: Conditions) -> Tensor:
    """Return photos (n, 3, H, W) in 0 to 1 as other cameras at other times might take them.

    Args:
        images: H and W are multiples of 8.
        conditions: NumPy's, or tensors on the device of the photos.
    """
    told = _Told(conditions, images)
    light = _linear(images)
    light = _shone_on(_surfaces(light, told), told)
    light = _through_the_air(light, told)
    light = _through_the_lens(light, told)
    light = _on_the_sensor(light, told)
    return _compressed(_developed(light, told), told).clamp(0, 1)


class _Told:
    """Conditions as tensors that multiply photos, noise, and the places of pixels."""

    def __init__(self, conditions: Conditions, images: Tensor) -> None:
        photos, _, self.height, self.width = images.shape
        self._values = {
            name: torch.as_tensor(value).to(images.device, images.dtype)
            for name, value in conditions._asdict().items()
            if name not in ("starts", "shift")
        }
        self.strip = _noise_strip(images.device)
        self.starts = torch.as_tensor(conditions.starts).to(images.device).long()
        self.shift = torch.as_tensor(conditions.shift).to(images.device).long()[0]
        self._taken = 0
        self.photos = photos
        self.x = (torch.arange(self.width, device=images.device) + 0.5) / self.width
        self.y = ((torch.arange(self.height, device=images.device) + 0.5) / self.height)[:, None]

    def __getitem__(self, name: str) -> Tensor:
        """Return (n, 1, 1, 1), or (n, 3, 1, 1) for colours."""
        value = self._values[name]
        return value.view(self.photos, -1, 1, 1)

    def each(self, name: str) -> Tensor:
        """Return a list of things (n, things, properties, 1, 1)."""
        return self._values[name][..., None, None]

    def noise(self, channels: int, height: int, width: int) -> Tensor:
        """Return (n, channels, height, width) of standard deviation 1, never the same again."""
        count = channels * height * width
        places = torch.arange(self._taken, self._taken + count, device=self.strip.device)
        self._taken += count
        taken = self.strip[(self.starts[:, None] + places) % len(self.strip)]
        return taken.view(self.photos, channels, height, width)

    def field(self) -> Tensor:
        """Return (n, 1, H, W), smooth, of about standard deviation 1."""
        size = (self.height, self.width)
        coarse = F.interpolate(self.noise(1, 5, 5), size, mode="bicubic", align_corners=False)
        fine = F.interpolate(self.noise(1, 17, 17), size, mode="bicubic", align_corners=False)
        return coarse + 0.5 * fine


@cache
def _noise_strip(device: torch.device) -> Tensor:
    """Return noise from which every photo reads a part: the same on every device."""
    return torch.randn(_STRIP, generator=torch.Generator().manual_seed(0)).to(device)


@cache
def _grey_weights(device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.tensor(_GREY, dtype=dtype).to(device).view(1, 3, 1, 1)


def _luminance(image: Tensor) -> Tensor:
    return (image * _grey_weights(image.device, image.dtype)).sum(dim=1, keepdim=True)


def _linear(encoded: Tensor) -> Tensor:
    """Undo the curve of sRGB (IEC 61966-2-1)."""
    return torch.where(
        encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055).clamp_min(1e-6) ** 2.4
    )


def _encoded(light: Tensor) -> Tensor:
    light = light.clamp(0, 1)
    return torch.where(
        light <= 0.0031308, light * 12.92, 1.055 * light.clamp_min(1e-6) ** (1 / 2.4) - 0.055
    )


def _roughly(image: Tensor, cells: int) -> Tensor:
    """Return the image as means of about cells x cells parts, interpolated."""
    small = F.avg_pool2d(image, (image.shape[2] // cells, image.shape[3] // cells))
    return F.interpolate(small, image.shape[2:], mode="bilinear", align_corners=False)


def _surfaces(light: Tensor, told: _Told) -> Tensor:
    """Change what is there: leaves in autumn, snow on what lies flat, wet ground that mirrors."""
    red, green, blue = light.chunk(3, dim=1)
    greenness = ((green - torch.maximum(red, blue)) / (green + 0.02)).clamp(0, 1)
    light = light * torch.exp(greenness * 2 * told["leaves"])

    # Snow takes the place of a surface and keeps its large shades.
    low = told.y - 0.5
    covered = torch.sigmoid(8 * (told.field() + low + 2 * told["snow"] - 1.5))
    covered = covered * (told["snow"] > 0)
    shade = _luminance(_roughly(light, 16))
    bright = 0.9 * (0.45 + 0.55 * shade / (shade.amax(dim=(2, 3), keepdim=True) + 1e-3))
    light = light + covered * (bright + 0.15 * (light - shade) - light)

    rows = torch.arange(told.height, device=light.device, dtype=light.dtype)[None, None, :, None]
    level = told["horizon"] * told.height
    mirrored = (2 * level - rows).clamp(0, told.height - 1).long().expand_as(light)
    ground = torch.sigmoid((rows - level) / 2) * torch.sigmoid(3 * told.field())
    wet = told["wet"] * ground
    reflected = F.avg_pool2d(light.gather(2, mirrored), (5, 1), stride=1, padding=(2, 0))
    return light * (1 - 0.5 * wet) + 0.4 * wet * reflected


def _shone_on(light: Tensor, told: _Told) -> Tensor:
    """Light what is there in another way: shadows, or at night lamps, which are seen, too."""
    hidden = torch.sigmoid(told["edge"] * told.field())
    light = light * (1 - told["shadow"] * hidden)

    x, y, brightness, reach, glow, *colour = told.each("lamps").unbind(dim=2)
    across, down = told.x - x, told.y - y
    squared = across.square() + down.square()  # (n, lamps, H, W)
    received = brightness / (1 + squared / reach.square())
    near = squared / glow.square()
    star = torch.exp(-across.abs() / (0.2 * glow) - down.abs() / (6 * glow)) + torch.exp(
        -down.abs() / (0.2 * glow) - across.abs() / (6 * glow)
    )
    shining = brightness * (torch.exp(-near) + 0.06 / (1 + near) + 0.15 * star)
    tint = torch.stack(colour, dim=2)  # (n, lamps, 3, 1, 1)
    lamps, glows = ((each[:, :, None] * tint).sum(dim=1) for each in (received, shining))
    windows = told["lit"] * torch.sigmoid(10 * (told.field() - 1))
    night = told["night"]
    # What is bright and smooth by day is mostly sky, which is dark then.
    even = _luminance(_roughly(light, 16))
    sky = torch.sigmoid(12 * (even - 0.5))
    dark = light * (1 - 0.9 * sky) * (told["ambient"] + lamps + windows) + glows
    return light + night * (dark - light)


def _through_the_air(light: Tensor, told: _Told) -> Tensor:
    """Add fog, denser further away, which is mostly up, and rain."""
    distance = (1.1 - told.y + 0.35 * told.field()).clamp(0, 2)
    passing = torch.exp(-told["fog"] * distance)
    mean = _luminance(light).mean(dim=(2, 3), keepdim=True)
    air = told["air"] * torch.where(told["night"] > 0, 2 * mean, torch.ones_like(mean))
    light = air + (light - air) * passing
    # At half the size, streaks of twice the length.
    sparse = (told.noise(1, told.height // 2, told.width // 2) - 2).clamp_min(0)
    along = told["fall"] + torch.pi / 2
    streaks = _filtered(sparse, _kernels(0.4, 2.0 * _REACH_PX, along))
    streaks = F.interpolate(streaks, light.shape[2:], mode="bilinear", align_corners=False)
    return light + told["rain"] * 4 * streaks * (0.5 * mean + 0.05)


def _through_the_lens(light: Tensor, told: _Told) -> Tensor:
    """Put drops onto the lens, defocus, move the camera."""
    x, y, radius = told.each("drops").unbind(dim=2)
    distance = ((told.x - x).square() + (told.y - y).square()).sqrt()
    inside = torch.sigmoid(60 * (radius - distance)) * (radius > 0)
    covered = inside.amax(dim=1, keepdim=True)
    light = light + covered * (_roughly(light, 16) - light)
    return _filtered(light, _kernels(told["defocus"], told["motion"], told["direction"]))


def _kernels(sigma: Tensor | float, length: Tensor | float, angle: Tensor) -> Tensor:
    """Return kernels (n, 1, K, K) of a Gaussian drawn along a line; of nothing, one pixel."""
    steps = torch.arange(-_REACH_PX, _REACH_PX + 1, device=angle.device, dtype=angle.dtype)
    x, y = steps, steps[:, None]
    along = x * torch.cos(angle) + y * torch.sin(angle)
    beside = y * torch.cos(angle) - x * torch.sin(angle)
    # Beyond the ends of the line the distance to them counts.
    beyond = (along.abs() - 0.5 * length).clamp_min(0)
    width = torch.as_tensor(sigma).clamp_min(0.1) + 0.4 * (torch.as_tensor(length) > 0)
    kernel = torch.exp(-0.5 * (beside.square() + beyond.square()) / width**2)
    return kernel / kernel.sum(dim=(2, 3), keepdim=True)


def _filtered(images: Tensor, kernels: Tensor) -> Tensor:
    """Filter each photo with its own kernel."""
    photos, channels = images.shape[:2]
    padded = F.pad(images, (_REACH_PX,) * 4, mode="reflect")
    planes = padded.reshape(1, photos * channels, *padded.shape[2:])
    every = kernels.expand(-1, channels, -1, -1).reshape(-1, 1, *kernels.shape[2:])
    return F.conv2d(planes, every, groups=photos * channels).view(images.shape)


def _on_the_sensor(light: Tensor, told: _Told) -> Tensor:
    """Expose, and count electrons: shot noise grows with the root of the light."""
    mean = _luminance(light).mean(dim=(2, 3), keepdim=True)
    at_night = told["target"] / (mean + 1e-4)
    gain = torch.exp(told["exposure"])
    light = light * torch.where(told["night"] > 0, gain * at_night, gain)
    light = (light * torch.exp(told["balance"])).clamp(0, 4)
    deviation = (told["shot"] * light + told["read"].square()).clamp_min(0).sqrt()
    noise = told.noise(3, told.height, told.width)
    # Cameras smooth their noise, which leaves grains.
    grains = F.avg_pool2d(noise, 3, stride=1, padding=1) * 2
    return light + deviation * (noise + told["smoothing"] * (grains - noise))


def _developed(light: Tensor, told: _Told) -> Tensor:
    """Make a picture of light, as the programs of cameras do."""
    image = _encoded(light)
    mean = image.mean(dim=(1, 2, 3), keepdim=True)
    image = mean + (image - mean) * (1 + told["contrast"])
    grey = _luminance(image)
    colour = (1 + told["saturation"]) * (1 - told["grey"])
    image = (grey + (image - grey) * colour).clamp(0, 1)
    gamma = torch.exp(told["gamma"])
    image = torch.where(told["gamma"] == 0, image, image.clamp_min(1e-4) ** gamma)
    image = image + told["curve"] * image * (1 - image) * (2 * image - 1)
    # About the local mean, with the same deviation everywhere, but not more than four times.
    local = _roughly(image, 8)
    spread = _roughly((image - local).square().mean(dim=1, keepdim=True), 8).clamp_min(0)
    evened = (
        0.45
        + 0.4 * (local - 0.45)
        + (image - local) * (0.18 / (spread + 1e-6).sqrt()).clamp(0.5, 4)
    )
    return (image + told["local_contrast"] * (evened - image)).clamp(0, 1)


def _compressed(image: Tensor, told: _Told) -> Tensor:
    """Round the cosine transform of blocks as JPEG does, more coarsely for fine detail.

    The grid of blocks is shifted at random: at fixed places the network would learn it.
    """
    photos, _, height, width = image.shape
    rows = (torch.arange(height, device=image.device) + told.shift[0]) % height
    columns = (torch.arange(width, device=image.device) + told.shift[1]) % width
    shifted = image[:, :, rows][..., columns]
    grey = _luminance(shifted)
    colour = F.avg_pool2d(shifted - grey, 2)  # JPEG keeps colour at half the resolution
    colour = F.interpolate(colour, scale_factor=2.0, mode="bilinear", align_corners=False)
    transform = _cosine_transform(image.device, image.dtype)
    order = torch.arange(_BLOCK_PX, device=image.device, dtype=image.dtype)
    coarse = told["compression"][..., None].clamp_min(1e-4) * (
        1 + 0.5 * (order[:, None] + order[None])
    )
    blocks = grey.view(photos, height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX)
    blocks = blocks.transpose(2, 3)
    kept = ((transform @ blocks @ transform.T) / coarse).round() * coarse
    restored = (transform.T @ kept @ transform).transpose(2, 3).reshape(grey.shape) + colour
    back_rows = (torch.arange(height, device=image.device) - told.shift[0]) % height
    back_columns = (torch.arange(width, device=image.device) - told.shift[1]) % width
    restored = restored[:, :, back_rows][..., back_columns]
    return torch.where(told["compression"] > 0, restored, image)


@cache
def _cosine_transform(device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the orthonormal DCT-II of 8 values, (8, 8)."""
    k = torch.arange(_BLOCK_PX, dtype=torch.float64)
    matrix = torch.cos(torch.pi * (k[None] + 0.5) * k[:, None] / _BLOCK_PX)
    matrix *= torch.where(k > 0, 2.0, 1.0).sqrt()[:, None] / _BLOCK_PX**0.5
    return matrix.to(device, dtype)
