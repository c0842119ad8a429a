"""Nearest neighbours of descriptors in many photos at once, on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.matching.products import LARGEST_PRODUCT, Nearest, exact_float

if TYPE_CHECKING:
    import torch


def nearest_on(
    device: torch.device,
    a: NDArray[np.int8],
    photos: Sequence[NDArray[np.int8]],
    *,
    with_second: bool,
) -> list[Nearest]:
    """Compare rows a (n, D) with those of each photo (m, D); neither n nor any m is 0.

    Photos are filled up to one size, so that one product does for all. Products are exact: they
    are sums of whole numbers that floats hold.
    """
    import torch

    count, most, dim = len(photos), max(map(len, photos)), a.shape[1]
    lowest = -dim * LARGEST_PRODUCT  # of all products; where there is no second
    filled = np.zeros((count, most, dim), np.int8)
    absent = np.full((count, most), lowest, np.int32)  # added to the product of each column
    for row, photo in enumerate(photos):
        filled[row, : len(photo)] = photo
        absent[row, : len(photo)] = 0
    number = exact_float(dim)
    left = torch.tensor(a, device=device).to(number)
    right = torch.from_numpy(filled).to(device).to(number)
    added = torch.from_numpy(absent).to(device).to(number).view(-1)
    products = torch.addmm(added, left, right.view(-1, dim).T).view(len(a), count, most)
    best, rows = products.max(dim=2)
    of_columns = products.amax(dim=0)
    mutual = best == of_columns.gather(1, rows.T).T
    second = products.scatter_(2, rows[:, :, None], lowest).amax(dim=2) if with_second else None
    # What leaves the device is small, and waits for all of the above once.
    mutual_rows = mutual.T.cpu().numpy()
    best_rows = rows.T.to(torch.int32).cpu().numpy().astype(np.int64)
    values = best.T.cpu().numpy().astype(np.float64)
    seconds = None if second is None else second.T.cpu().numpy().astype(np.float64)
    return [
        Nearest(
            np.flatnonzero(mutual_rows[row]),
            best_rows[row],
            values[row],
            None if seconds is None else seconds[row],
        )
        for row in range(count)
    ]
