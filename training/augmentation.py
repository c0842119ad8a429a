"""What light, lenses, sensors and compression do to a photo.

Every crop draws its own; what is drawn comes from a NumPy generator, the pixels stay on their
device.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

# How often each happens at full strength.
_NIGHT_SHARE = 0.15
_TONE_SHARE = 0.5
_COLOUR_SHARE = 0.8
_BLUR_SHARE = 0.25
_NOISE_SHARE = 0.5
_COMPRESSION_SHARE = 0.3

_GREY = (0.299, 0.587, 0.114)  # of RGB (ITU-R BT.601)
_BLOCK_PX = 8


def augment(images: Tensor, rng: np.random.Generator, strength: float) -> Tensor:
    """Return photos (B, 3, H, W) in 0 to 1 as other cameras at other times might take them.

    H and W are multiples of 8; strength is 0 to 1.
    """
    return torch.stack([_augmented(image, rng, strength) for image in images]).clamp_(0, 1)


def _augmented(image: Tensor, rng: np.random.Generator, strength: float) -> Tensor:
    # Always as many random numbers, whatever happens.
    chances = rng.random(6) / max(strength, 1e-6)
    drawn = rng.uniform(-1, 1, 16) * strength
    seed = int(rng.integers(2**31))
    if chances[0] < _NIGHT_SHARE:
        image = _night(image, drawn)
    elif chances[1] < _TONE_SHARE:
        image = _tone(image, drawn)
    if chances[2] < _COLOUR_SHARE:
        image = _colour(image, drawn)
    if chances[3] < _BLUR_SHARE:
        image = _blurred(image, 0.4 + 1.0 * abs(drawn[10]))
    if chances[4] < _NOISE_SHARE:
        image = _noisy(image, 0.06 * abs(drawn[11]), seed)
    if chances[5] < _COMPRESSION_SHARE:
        image = _compressed(image.clamp(0, 1), 0.01 + 0.05 * abs(drawn[12]), seed)
    return image


def _night(image: Tensor, drawn: np.ndarray) -> Tensor:
    """Darken as night photos are: shadows crushed, lights kept, warm or cold lamps."""
    image = image.clamp_min(1e-4) ** (1.6 + 0.8 * abs(drawn[0]))
    gain = 0.55 + 0.3 * abs(drawn[1])
    warm = 0.3 * drawn[2]
    return image * _colour_vector(image, (gain * (1 + warm), gain, gain * (1 - warm)))


def _tone(image: Tensor, drawn: np.ndarray) -> Tensor:
    """Bend the tone curve: a gamma, then an S or its inverse."""
    image = image.clamp_min(1e-4) ** float(np.exp(0.6 * drawn[0]))
    return image + float(0.6 * drawn[1]) * image * (1 - image) * (2 * image - 1)


def _colour(image: Tensor, drawn: np.ndarray) -> Tensor:
    """Change brightness, contrast, saturation and white balance."""
    image = image * float(1 + 0.3 * drawn[3])
    mean = image.mean()
    image = mean + (image - mean) * float(1 + 0.3 * drawn[4])
    grey = (image * _colour_vector(image, _GREY)).sum(dim=0, keepdim=True)
    image = grey + (image - grey) * float(1 + 0.5 * drawn[5])
    balance = tuple(float(1 + 0.12 * each) for each in drawn[6:9])
    return image * _colour_vector(image, balance)


def _colour_vector(image: Tensor, values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=image.dtype).to(image.device)[:, None, None]


def _blurred(image: Tensor, sigma: float) -> Tensor:
    reach = int(np.ceil(2.5 * sigma))
    steps = torch.arange(-reach, reach + 1, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (steps / sigma) ** 2)
    kernel = (kernel / kernel.sum()).to(image.device).expand(3, 1, 1, -1)
    padded = F.pad(image[None], (reach,) * 4, mode="reflect")
    across = F.conv2d(padded, kernel, groups=3)
    return F.conv2d(across, kernel.transpose(2, 3), groups=3)[0]


def _noisy(image: Tensor, sigma: float, seed: int) -> Tensor:
    generator = torch.Generator(image.device).manual_seed(seed)
    noise = torch.randn(image.shape, generator=generator, device=image.device, dtype=image.dtype)
    return image + sigma * noise


def _compressed(image: Tensor, step: float, seed: int) -> Tensor:
    """Round the cosine transform of blocks as JPEG does, more coarsely for fine detail.

    The grid of blocks is shifted at random: at fixed places the network would learn it.
    """
    shift = (seed % _BLOCK_PX, seed // _BLOCK_PX % _BLOCK_PX)
    image = torch.roll(image, shift, dims=(1, 2))
    grey = (image * _colour_vector(image, _GREY)).sum(dim=0, keepdim=True)
    colour = F.avg_pool2d((image - grey)[None], 2)  # JPEG keeps colour at half the resolution
    colour = F.interpolate(colour, scale_factor=2.0, mode="bilinear", align_corners=False)[0]
    transform = _cosine_transform().to(image)
    order = torch.arange(_BLOCK_PX, device=image.device, dtype=image.dtype)
    coarse = step * (1 + 0.5 * (order[:, None] + order[None]))
    _, height, width = grey.shape
    blocks = grey.view(height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX)
    blocks = blocks.transpose(1, 2)
    kept = ((transform @ blocks @ transform.T) / coarse).round() * coarse
    restored = (transform.T @ kept @ transform).transpose(1, 2).reshape(grey.shape)
    return torch.roll(restored + colour, (-shift[0], -shift[1]), dims=(1, 2))


def _cosine_transform() -> Tensor:
    """Return the orthonormal DCT-II of 8 values, (8, 8)."""
    k = torch.arange(_BLOCK_PX, dtype=torch.float64)
    matrix = torch.cos(torch.pi * (k[None] + 0.5) * k[:, None] / _BLOCK_PX)
    matrix *= torch.where(k > 0, 2.0, 1.0).sqrt()[:, None] / _BLOCK_PX**0.5
    return matrix
