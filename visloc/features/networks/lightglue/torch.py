"""LightGlue computed with torch, section 3 of the paper, names of tensors as the authors have them.

The keypoints of both photos are rows of one matrix, those of the first photo before those of the
second: what happens to each keypoint alone happens to all at once.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc.features.networks.lightglue.model import Design, SeenKeypoints
from visloc.features.weights.checkpoint import Checkpoint


class LightGlue:
    """Matches keypoints of two photos. Safe to call from several threads."""

    def __init__(self, design: Design, checkpoint: Checkpoint) -> None:
        self.design = design
        self._tensors = {name: torch.tensor(a) for name, a in checkpoint.tensors.items()}
        # Published as (head, channel, query or key or value): grouped, each is one block.
        for layer in range(design.num_layers):
            for part in ("weight", "bias"):
                name = f"transformers.{layer}.self_attn.Wqkv.{part}"
                mixed = self._tensors[name]
                grouped = mixed.view(design.width, 3, *mixed.shape[1:]).transpose(0, 1)
                self._tensors[name] = grouped.reshape(mixed.shape)

    @torch.inference_mode()
    def match(
        self, a: SeenKeypoints, b: SeenKeypoints
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
        """Pair keypoints of photo a (n) with those of photo b (m), each at most once.

        Returns:
            Rows of a, ascending, rows of b, and the probability of each match.
        """
        rows = torch.arange(len(a.keypoints)), torch.arange(len(b.keypoints))
        states = self._linear(
            "input_proj", torch.tensor(np.concatenate([a.descriptors, b.descriptors]))
        )
        places = torch.tensor(np.concatenate([_normalized(a), _normalized(b)]))
        angles = F.linear(places, self._tensors["posenc.Wr.weight"])
        turns = torch.polar(torch.ones_like(angles), angles)
        num_keypoints, layer = len(states), 0
        for layer in range(self.design.num_layers):
            n, m = map(len, rows)
            if n == 0 or m == 0:
                none = np.empty(0, dtype=np.int64)
                return none, none, np.empty(0, dtype=np.float32)
            states = self._self_attention(layer, states, turns, n)
            states = self._cross_attention(layer, states, n)
            if layer + 1 == self.design.num_layers:
                break
            keep = self._matchability(layer, states).sigmoid() > self.design.min_matchability
            if self.design.stop_share is not None:
                unsure = ~self._sure(layer, states)
                if 1 - int(unsure.sum()) / num_keypoints > self.design.stop_share:
                    break  # those left out were sure
                keep |= unsure
            states, turns = states[keep], turns[keep]
            rows = rows[0][keep[:n]], rows[1][keep[n:]]
        i, j, scores = self._assign(layer, states, len(rows[0]))
        return rows[0][i].numpy(), rows[1][j].numpy(), scores.numpy()

    def _self_attention(self, layer: int, states: Tensor, turns: Tensor, n: int) -> Tensor:
        """Equations 3 to 5: keypoints of one photo; scores depend on where they are to each other.

        Queries and keys are turned, each pair of channels by an angle that is linear in the
        position (``turns``, complex), so that their product tells the difference of positions.
        """
        block = f"transformers.{layer}.self_attn"
        query, key, value = self._heads(self._linear(f"{block}.Wqkv", states), 3)
        query, key = _turned(query, turns), _turned(key, turns)
        message = torch.cat(
            [_attend(query[:, o], key[:, o], value[:, o]) for o in (slice(n), slice(n, None))], 1
        )
        return self._updated(block, "out_proj", states, message)

    def _cross_attention(self, layer: int, states: Tensor, n: int) -> Tensor:
        """Equation 6: keypoints of one photo look at those of the other, as they are looked at."""
        block = f"transformers.{layer}.cross_attn"
        (key,) = self._heads(self._linear(f"{block}.to_qk", states), 1)
        (value,) = self._heads(self._linear(f"{block}.to_v", states), 1)
        message = torch.cat(
            [
                _attend(key[:, :n], key[:, n:], value[:, n:]),
                _attend(key[:, n:], key[:, :n], value[:, :n]),
            ],
            1,
        )
        return self._updated(block, "to_out", states, message)

    def _updated(self, block: str, projection: str, states: Tensor, message: Tensor) -> Tensor:
        """Equation 1: add what a small network makes of state and message."""
        joined = self._linear(f"{block}.{projection}", message.transpose(0, 1).flatten(1))
        hidden = self._linear(f"{block}.ffn.0", torch.cat([states, joined], 1))
        gain, shift = (self._tensors[f"{block}.ffn.1.{part}"] for part in ("weight", "bias"))
        hidden = F.gelu(F.layer_norm(hidden, gain.shape, gain, shift))
        return states + self._linear(f"{block}.ffn.3", hidden)

    def _sure(self, layer: int, states: Tensor) -> Tensor:
        """Section 3.3: whether each keypoint's state will hardly change; (n + m,) bool."""
        threshold = 0.8 + 0.1 * math.exp(-4.0 * layer / self.design.num_layers)
        logits = self._linear(f"token_confidence.{layer}.token.0", states)[:, 0]
        return logits.sigmoid() > threshold

    def _matchability(self, layer: int, states: Tensor) -> Tensor:
        return self._linear(f"log_assignment.{layer}.matchability", states)[:, 0]

    def _assign(self, layer: int, states: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """Equations 7 and 8: double softmax times the matchability of both; mutual best pairs."""
        projected = self._linear(f"log_assignment.{layer}.final_proj", states)
        projected = projected / self.design.width**0.25
        matchability = F.logsigmoid(self._matchability(layer, states))
        similarity = projected[:n] @ projected[n:].T
        of_a = matchability[:n] - similarity.logsumexp(1)
        of_b = matchability[n:] - similarity.logsumexp(0)
        log_scores = similarity.mul_(2).add_(of_a[:, None]).add_(of_b)
        best, j = log_scores.max(1)
        mutual = log_scores.argmax(0)[j] == torch.arange(n)
        i = torch.nonzero(mutual & (best > math.log(self.design.min_score)))[:, 0]
        return i, j[i], best[i].exp()

    def _linear(self, name: str, rows: Tensor) -> Tensor:
        return F.linear(rows, self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"])

    def _heads(self, rows: Tensor, parts: int) -> Tensor:
        """Turn (n, parts * width) into (parts, heads, n, width / heads)."""
        return rows.view(len(rows), parts, self.design.num_heads, -1).permute(1, 2, 0, 3)


def _normalized(seen: SeenKeypoints) -> NDArray[np.float32]:
    """Positions from the centre of the photo, in halves of its longer side."""
    size = np.array([seen.width, seen.height], dtype=np.float32)
    return np.asarray((seen.keypoints - size / 2) / (size.max() / 2), dtype=np.float32)


def _turned(heads: Tensor, turns: Tensor) -> Tensor:
    pairs = torch.view_as_complex(heads.reshape(*heads.shape[:-1], -1, 2))
    return torch.view_as_real(pairs * turns).flatten(-2)


def _attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Softmax attention (heads, n, channels) with scores over the root of the channels."""
    return F.scaled_dot_product_attention(query[None], key[None], value[None])[0]
