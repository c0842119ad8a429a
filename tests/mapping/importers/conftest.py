"""Small videos, made here."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def texture(width: int, height: int, seed: int = 0) -> Picture:
    """(H, W, 3) with corners everywhere, at several scales."""
    noise = np.random.default_rng(seed)
    grey = np.zeros((height, width), np.float32)
    for side in (8, 24, 64):
        small = noise.uniform(0, 80, (height // side + 2, width // side + 2)).astype(np.float32)
        grey += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def panned(count: int, step: int, size: tuple[int, int] = (320, 240)) -> list[Picture]:
    """Frames of a window that moves right by so many pixels each."""
    width, height = size
    wall = texture(width + count * step + 8, height)
    return [wall[:, i * step : i * step + width].copy() for i in range(count)]


@contextmanager
def _priority_kept() -> Iterator[None]:
    """Set the priority of this thread back.

    As root, SVT-AV1 gives the thread that calls it real-time priority 99, for good. Threads and
    processes started later inherit that, and starve all others.
    """
    if not hasattr(os, "sched_setscheduler"):  # macOS
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


@pytest.fixture
def make_video(tmp_path: Path) -> Callable[..., Path]:
    """Encode pictures: ``make_video(pictures, name=..., codec=..., times=..., tags=...)``."""

    def make(
        pictures: Iterable[Picture],
        name: str = "walk.mp4",
        *,
        codec: str = "libx264",
        pix_fmt: str = "yuv420p",
        times_ms: list[int] | None = None,
        tags: dict[str, str] | None = None,
        **context: Any,
    ) -> Path:
        path = tmp_path / name
        with (
            _priority_kept(),
            av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container,
        ):
            container.metadata.update(tags or {})
            stream = container.add_stream(codec, rate=10)
            assert isinstance(stream, av.VideoStream)
            stream.pix_fmt = pix_fmt
            stream.codec_context.time_base = Fraction(1, 1000)
            for key, value in context.items():
                setattr(stream.codec_context, key, value)
            for i, picture in enumerate(pictures):
                if i == 0:
                    stream.height, stream.width = picture.shape[:2]
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                frame.pts = i * 100 if times_ms is None else times_ms[i]
                frame.time_base = Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path

    return make
