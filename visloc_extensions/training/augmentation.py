"""What light, weather, lenses, sensors and their programs do to a photo.

A photo is taken back to linear light. There its surfaces, the lamps, the air, the lens and the
sensor act in the order in which light passes them; then it is developed, as a camera does, and
compressed. What happens is drawn beforehand (``conditions``); the pixels stay on their device, and
the same operations run whatever was drawn, so that a GPU can record them once.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor

from visloc_extensions.training.conditions import BLOCK_PX, NOISE_STRIP, REACH_PX, Conditions

_GREY = (0.299, 0.587, 0.114)  # of RGB (ITU-R BT.601)


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
    return torch.randn(NOISE_STRIP, generator=torch.Generator().manual_seed(0)).to(device)


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
    streaks = _filtered(sparse, _kernels(0.4, 2.0 * REACH_PX, along))
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
    steps = torch.arange(-REACH_PX, REACH_PX + 1, device=angle.device, dtype=angle.dtype)
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
    padded = F.pad(images, (REACH_PX,) * 4, mode="reflect")
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
    order = torch.arange(BLOCK_PX, device=image.device, dtype=image.dtype)
    coarse = told["compression"][..., None].clamp_min(1e-4) * (
        1 + 0.5 * (order[:, None] + order[None])
    )
    blocks = grey.view(photos, height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
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
    k = torch.arange(BLOCK_PX, dtype=torch.float64)
    matrix = torch.cos(torch.pi * (k[None] + 0.5) * k[:, None] / BLOCK_PX)
    matrix *= torch.where(k > 0, 2.0, 1.0).sqrt()[:, None] / BLOCK_PX**0.5
    return matrix.to(device, dtype)
