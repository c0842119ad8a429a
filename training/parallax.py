"""Pairs with true parallax, from photographs of synthetic rooms with exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visloc.geometry import Camera, Pose

# A surface is seen by both cameras if its depths agree to this share; else something is before it.
_SAME_DEPTH = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One photograph of a room.

    Attributes:
        image: (3, H, W) uint8.
        depth: (H, W) float32 metres along the optical axis, 0 where nothing is seen.
        camera: a PINHOLE.
        cam_from_world: its pose.
    """

    image: Tensor
    depth: Tensor
    camera: Camera
    cam_from_world: Pose


def flow_of_views(first: View, second: View, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    raise NotImplementedError


def random_parallax(
    rng: np.random.Generator, room: tuple[View, ...], crop_px: int
) -> tuple[Tensor, Tensor, Tensor]:
    raise NotImplementedError
