"""HDR video as standard pictures, by one plain curve for each transfer function.

A code value becomes light relative to diffuse white, then x (1 + x / w^2) / (1 + x) (Reinhard et
al. 2002, equation 4) with w the brightest light, scaled so that diffuse white stays bright, then
sRGB's gamma. Each channel goes alone and the gamut stays as it is: features look at brightness.
"""

from __future__ import annotations

import functools

import av
import numpy as np
from numpy.typing import NDArray

# ITU-T H.273, table 3: SMPTE ST 2084 (PQ) and ARIB STD-B67 (HLG).
_PQ, _HLG = 16, 18
_CODES = 1024  # ten bits; of twelve, what features see is not lost
# ITU-R BT.2408: diffuse white is 203 cd/m2 in PQ, and a signal of 75 % in HLG.
_WHITE_NITS, _WHITE_HLG = 203.0, 0.75
_PEAK_NITS = 1000.0


def is_high_range(frame: av.VideoFrame) -> bool:
    """Whether a frame says that its values are PQ or HLG."""
    return int(frame.color_trc) in (_PQ, _HLG)


def to_standard_range(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return a PQ or HLG frame as (H, W, 3) uint8 RGB."""
    rgb = np.asarray(frame.to_ndarray(format="rgb48le"), dtype=np.uint16)
    return np.asarray(_curve(int(frame.color_trc))[rgb >> 6], dtype=np.uint8)


@functools.cache
def _curve(transfer: int) -> NDArray[np.uint8]:
    """8-bit values (1024,) for the code values of a transfer function."""
    signal = np.arange(_CODES) / (_CODES - 1)
    if transfer == _PQ:
        light, peak = _pq_nits(signal) / _WHITE_NITS, _PEAK_NITS / _WHITE_NITS
    else:
        white = float(_hlg_light(np.array([_WHITE_HLG]))[0])
        light, peak = _hlg_light(signal) / white, 1.0 / white
    light = np.minimum(light, peak)
    shown = light * (1.0 + light / peak**2) / (1.0 + light)  # 1 at the peak, about 1/2 at white
    gamma = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(255.0 * gamma + 0.5, 0, 255), dtype=np.uint8)


def _pq_nits(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """SMPTE ST 2084, equation 4.1: cd/m2 of signals from 0 to 1."""
    m1, m2 = 2610 / 16384, 2523 / 32
    c1, c2, c3 = 3424 / 4096, 2413 / 128, 2392 / 128
    root = signal ** (1 / m2)
    return np.asarray(10_000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1 / m1))


def _hlg_light(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """ARIB STD-B67 (BT.2100, table 5): scene light from 0 to 1 of signals from 0 to 1."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
