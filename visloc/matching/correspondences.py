"""Matching a query's keypoints against the landmarks that mapping photos see."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.matching.on_device import nearest_on
from visloc.matching.products import EightBitRows, Nearest, in_threads, nearest
from visloc.runtime.device import has_cuda, torch_device

if TYPE_CHECKING:
    import torch

_MOST_PRODUCTS_ON_DEVICE = 2**26  # 256 MB of them
# Lowe's test of ambiguity: how much nearer than the second nearest the nearest must be. His 0.8 is
# for SIFT; learned descriptors of unlike points lie closer together, so 0.9, which was chosen
# before it was measured (docs/results.md).
CLEAR_RATIO = 0.9
# Photos matched again by a network: each costs more than all others together.
NUM_REMATCHED = 3

# Rows of one side, rows of the other, and the similarity of their descriptors.
Pairs = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """2D-3D correspondences, each keypoint and each landmark at most once, best first.

    Attributes:
        keypoints: (n,) int64 rows of the query's features.
        landmarks: (n,) int64 rows of the map's landmarks.
        support: (n,) float64, votes of the mapping photos that proposed the pair.
        similarities: (n,) float32, the best cosine similarity among them.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    support: NDArray[np.float64]
    similarities: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, slots=True, eq=False)
class Proposals:
    """Pairs that mapping photos propose; one keypoint may have several, in different photos.

    Attributes:
        keypoints: (n,) int64 rows of the query's features.
        landmarks: (n,) int64 rows of the map's landmarks.
        ranks: (n,) int64, the position of the photo among those asked, from 0.
        similarities: (n,) float32, cosine similarities.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    ranks: NDArray[np.int64]
    similarities: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.keypoints)

    def of(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Proposals:
        """Keep some of the pairs, by mask or by rows."""
        return Proposals(
            self.keypoints[which],
            self.landmarks[which],
            self.ranks[which],
            self.similarities[which],
        )

    def followed_by(self, others: Proposals, num_photos: int) -> Proposals:
        """Add the pairs of further photos, which come after so many."""
        return Proposals(
            np.concatenate([self.keypoints, others.keypoints]),
            np.concatenate([self.landmarks, others.landmarks]),
            np.concatenate([self.ranks, others.ranks + num_photos]),
            np.concatenate([self.similarities, others.similarities]),
        )

    def settled(self) -> Correspondences:
        """Settle conflicts by vote; each photo votes with 1 / rank."""
        votes = 1.0 / (self.ranks + 1)
        return settled(self.keypoints, self.landmarks, votes, self.similarities)

    def settled_rows(self) -> NDArray[np.intp]:
        """Return a row of each pair that is left when conflicts are settled, in that order."""
        chosen = self.settled()
        size = int(self.landmarks.max(initial=0)) + 1
        pairs = self.keypoints * size + self.landmarks
        order = np.argsort(pairs, kind="stable")
        wanted = chosen.keypoints * size + chosen.landmarks
        return np.asarray(order[np.searchsorted(pairs[order], wanted)])

    @staticmethod
    def none() -> Proposals:
        """Return no pairs."""
        none = np.empty(0, dtype=np.int64)
        return Proposals(none, none, none, np.empty(0, dtype=np.float32))


def mutual_nearest_neighbours(
    a: EightBitRows, b: EightBitRows, max_ratio: float | None = None
) -> Pairs:
    """Pair the rows of a (n, D) and b (m, D) that are each other's most similar.

    Args:
        a: unit rows except for rounding.
        max_ratio: pairs are left out unless their distance is below this part of the distance of
            the row of a to the second nearest row of b (Lowe 2004, section 7.1); None keeps all.

    Returns:
        Rows of a, rows of b and their dot products. Ties go to the lower row of b, and of a.
    """
    if len(a) == 0 or len(b) == 0:
        return _no_pairs()
    found = nearest(a.rows, b.rows, with_second=max_ratio is not None)
    return _pairs(found, a.scale * b.scale, max_ratio)


def mutual_nearest_neighbours_on(
    device: torch.device,
    a: EightBitRows,
    others: Sequence[EightBitRows],
    max_ratio: float | None = None,
) -> list[Pairs]:
    """Return what ``mutual_nearest_neighbours`` gives of a and each of the others, from a device.

    Products are exact here too, so that the pairs are the same. The device gets as many of the
    others at a time as keep their products within 256 MB; those of a photo alone may be more.
    """
    found = [_no_pairs() for _ in others]
    with_rows = [number for number, b in enumerate(others) if len(a) and len(b)]
    most = max((len(others[number]) for number in with_rows), default=1)
    step = max(1, _MOST_PRODUCTS_ON_DEVICE // (max(len(a), 1) * most))
    for start in range(0, len(with_rows), step):
        some = with_rows[start : start + step]
        rows = [others[number].rows for number in some]
        of_each = nearest_on(device, a.rows, rows, with_second=max_ratio is not None)
        for number, of_photo in zip(some, of_each, strict=True):
            found[number] = _pairs(of_photo, a.scale * others[number].scale, max_ratio)
    return found


def _no_pairs() -> Pairs:
    none = np.empty(0, dtype=np.int64)
    return none, none, np.empty(0, dtype=np.float32)


def _pairs(found: Nearest, scale: float, max_ratio: float | None) -> Pairs:
    """Return the mutual rows that are clear and the first ones of their column, as pairs."""
    mutual, rows, best, second = found
    # Rows with equal similarity to one column (duplicate descriptors): the first one keeps it.
    mutual = mutual[_first_rows(rows[mutual]) == np.arange(len(mutual))]
    if second is not None and max_ratio is not None:
        # The squared distance of unit vectors is 2 - 2 cos.
        half_squares = (1 - np.clip(s[mutual] * scale, -1, 1) for s in (best, second))
        of_nearest, of_second = half_squares
        mutual = mutual[of_nearest < max_ratio**2 * of_second]
    return mutual, rows[mutual], (best[mutual] * scale).astype(np.float32)


def propose_landmarks(
    query: EightBitRows,
    photos: Iterable[tuple[NDArray[np.integer], EightBitRows]],
    max_ratio: float | None = None,
    rematch: Callable[[int], Pairs] | None = None,
) -> Proposals:
    """Match a query against several mapping photos, each by mutual nearest neighbours.

    Args:
        query: (n, D) descriptors of the query.
        photos: of each mapping photo, most similar first, the landmarks (m,) that it observes
            and their descriptors (m, D).
        max_ratio: for each photo's nearest neighbours, see ``mutual_nearest_neighbours``.
        rematch: a better and slower way to match the query with a photo, given its position in
            ``photos``: keypoints, landmarks and similarities. What it says of the photos with the
            most pairs replaces those.
    """
    photos = list(photos)
    if not photos:
        return Proposals.none()
    descriptors = [rows for _, rows in photos]
    if has_cuda():
        pairs = mutual_nearest_neighbours_on(torch_device(), query, descriptors, max_ratio)
    else:
        pairs = in_threads(
            partial(mutual_nearest_neighbours, query, max_ratio=max_ratio), descriptors
        )
    found = [
        (i, landmarks[j].astype(np.int64), similarity)
        for (landmarks, _), (i, j, similarity) in zip(photos, pairs, strict=True)
    ]
    if rematch is not None:
        best = sorted(range(len(found)), key=lambda photo: -len(found[photo][0]))[:NUM_REMATCHED]
        for photo, better in zip(best, in_threads(rematch, best), strict=True):
            found[photo] = better
    return proposals_of(found)


def proposals_of(found: Sequence[Pairs]) -> Proposals:
    """Join what mapping photos propose, best photo first: keypoints, landmarks, similarities."""
    if not found:
        return Proposals.none()
    keypoints, landmarks, similarities = map(np.concatenate, zip(*found, strict=True))
    ranks = np.repeat(np.arange(len(found)), [len(i) for i, _, _ in found])
    return Proposals(keypoints, landmarks, ranks, similarities)


def match_landmarks(
    query: EightBitRows,
    photos: Iterable[tuple[NDArray[np.integer], EightBitRows]],
    max_ratio: float | None = None,
    rematch: Callable[[int], Pairs] | None = None,
) -> Correspondences:
    """Match a query against several mapping photos and settle conflicts by vote.

    Every photo proposes pairs of keypoint and landmark and votes for
    them with 1 / rank: the photo most like the query sees a corner most as the query does, and
    shares the errors of the map there; several further photos that agree can outvote it. The pair
    with more support wins, then the more similar one; each keypoint and each landmark is used
    once. Measured beside the alternatives in docs/decisions/0005-votes-by-rank.md, the 8 bits in
    0015-whole-number-matching.md. Arguments as of ``propose_landmarks``.
    """
    return propose_landmarks(query, photos, max_ratio, rematch).settled()


def settled(
    keypoints: NDArray[np.int64],
    landmarks: NDArray[np.int64],
    votes: NDArray[np.float64],
    similarity: NDArray[np.float32],
) -> Correspondences:
    """Choose among proposed pairs (n,): the most votes first, then the most similar."""
    if len(keypoints) == 0:
        return Correspondences(keypoints, landmarks, votes, similarity)
    # One row per distinct pair, with its support and its best similarity. One sort of one number
    # takes half the time of a sort by two.
    size = int(landmarks.max()) + 1
    pairs = keypoints * size + landmarks
    order = np.argsort(pairs, kind="stable")
    pairs = pairs[order]
    first = np.flatnonzero(np.diff(pairs, prepend=-1))
    support = np.add.reduceat(votes[order], first)
    similarity = np.maximum.reduceat(similarity[order], first)

    best = np.lexsort((-similarity, -support))  # stable: of equal pairs, the first keypoint's
    keypoints, landmarks = np.divmod(pairs[first][best], size)
    chosen = _each_once(keypoints, landmarks)
    return Correspondences(
        keypoints[chosen], landmarks[chosen], support[best][chosen], similarity[best][chosen]
    )


def _each_once(keypoints: NDArray[np.int64], landmarks: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which pairs (n,) to take, best first, so that no keypoint or landmark is taken twice."""
    of_keypoint, of_landmark = _first_rows(keypoints), _first_rows(landmarks)
    rows = np.arange(len(keypoints))
    taken: NDArray[np.bool_] = (of_keypoint == rows) & (of_landmark == rows)
    # Most pairs are taken at once, or conflict with one that is. The others wait for each other.
    waiting = np.flatnonzero(~(taken[of_keypoint] | taken[of_landmark]))
    taken_keypoints: set[int] = set()
    taken_landmarks: set[int] = set()
    for row, keypoint, landmark in zip(
        waiting.tolist(), keypoints[waiting].tolist(), landmarks[waiting].tolist(), strict=True
    ):
        if keypoint not in taken_keypoints and landmark not in taken_landmarks:
            taken_keypoints.add(keypoint)
            taken_landmarks.add(landmark)
            taken[row] = True
    return taken


def _first_rows(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each value (n,) the first row that has it."""
    first = np.empty(int(values.max(initial=-1)) + 1, dtype=np.int64)
    first[values[::-1]] = np.arange(len(values))[::-1]
    return first[values]
