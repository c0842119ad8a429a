"""Maps on disk: the manifest, the JSON files, the arrays and the models.

Flag 1 makes sizes, checksums and hashes those of the altered files, so that what they hold is
looked into. Without it nothing altered may pass.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.fuzz.edits import Edit, EditedFolder, decode, encode
from tests.fuzz.target import holds, refusal
from tests.fuzz.tiny_map import write_tiny_map
from visloc.archive import open_map, verify_map
from visloc.archive.checks import SCALES, content_hash, json_text, manifest_hash
from visloc.errors import MapCorrupt
from visloc.geometry import Pose
from visloc.retrieval.index import IndexKind

_MADE_RIGHT = 1


class Archive:
    """Verifies a small map of which some files are altered."""

    def __init__(self, folder: Path) -> None:
        write_tiny_map(folder / "map", index=IndexKind.IVF)
        self._map = EditedFolder(folder / "map")

    def run(self, data: bytes) -> str:
        """Alter the map and verify it; what is accepted must be usable."""
        flags, edits = decode(self._map.names, data)
        try:
            contents = dict(self._map.alter(edits))
            if flags & _MADE_RIGHT and self._has_manifest():
                self._make_right(contents)
            self._search()
            try:
                outcome = self._verify()
            except MapCorrupt as error:
                return refusal(error, "map.")
            unaltered = len(contents) == len(edits) and all(
                content == self._map.good[name] for name, content in contents.items()
            )
            assert unaltered or flags & _MADE_RIGHT, "an altered map passed for the good one"
        finally:
            self._map.restore()
        return outcome

    def repair(self, data: bytes) -> bytes:
        """Have sizes and hashes made right."""
        return bytes([data[0] | _MADE_RIGHT]) + data[1:] if data else data

    def seeds(self) -> Iterator[bytes]:
        """Yield edits of every kind, and every file as it is."""
        names, good = self._map.names, self._map.good
        for name in names:
            edits = [Edit(name, "content", good[name])]
            yield encode(names, edits)
            yield encode(names, edits, _MADE_RIGHT)
            yield encode(names, [Edit(name, "patch", b"\x60\0\x01")], _MADE_RIGHT)
        for kind in ("cut", "missing", "folder", "link", "pipe"):
            yield encode(names, [Edit(names[0], kind, b"\x10\0")])
            yield encode(names, [Edit("manifest.json", kind, b"\x10\0")])
        yield encode(names, [Edit(name, "content", good[name]) for name in names[:3]], _MADE_RIGHT)
        for lists in _lists(good["index/densevlad.lists"]):
            yield encode(names, [Edit("index/densevlad.lists", "content", lists)], _MADE_RIGHT)
        for sizes in ([0, 0, 3], [2, 2, -1], [2**62, 2**62, 2**63 - 1]):
            file = io.BytesIO()
            np.save(file, np.array(sizes, np.int64))
            edit = Edit("index/densevlad.sizes.npy", "content", file.getvalue())
            yield encode(names, [edit], _MADE_RIGHT)
        for model in _models():
            yield encode(names, [Edit("global/densevlad.model.npz", "content", model)], _MADE_RIGHT)

    def _search(self) -> None:
        """Search an index as a map is served: opening does not read its lists."""
        try:
            opened = open_map(self._map.folder)
        except MapCorrupt:
            return
        for rows in opened.global_descriptors.values():
            if rows.inverted is None:
                continue
            query = np.ones(rows.values.shape[1], np.float32)
            lists = rows.inverted.nearest_lists(query, 2)
            for allowed in (None, np.arange(len(rows)) > 0):
                found, _ = rows.inverted.rough_cosines(query, lists, allowed)
                assert ((found >= 0) & (found < len(rows))).all()
                assert allowed is None or allowed[found].all()

    def _verify(self) -> str:
        opened = verify_map(self._map.folder)
        with holds("usable"):
            manifest = opened.manifest
            assert len(opened.images) == len(opened.image_poses) == manifest.counts.images
            assert opened.size_bytes >= 0
            assert opened.gravity is None or abs(np.linalg.norm(opened.gravity) - 1) < 1e-6
            for i, row in enumerate(opened.image_poses):
                Pose.from_quaternion(row[:4], row[4:])
                assert opened.images[i].camera in opened.cameras
                landmarks, descriptors = opened.observations(i)
                assert descriptors.shape == (len(landmarks), manifest.local_features.descriptor_dim)
                assert descriptors.dtype == np.int8
                assert np.isfinite(opened.landmarks[landmarks]).all()
        return "accepted"

    def _has_manifest(self) -> bool:
        path = self._map.folder / "manifest.json"
        return path.is_file() and not path.is_symlink()

    def _make_right(self, contents: dict[str, bytes]) -> None:
        try:
            manifest = json.loads(contents.get("manifest.json", self._map.good["manifest.json"]))
            for name, content in contents.items():
                if name != "manifest.json":
                    digest = hashlib.sha256(content).hexdigest()
                    manifest["files"][name] = {"size": len(content), "sha256": digest}
            manifest["content_hash"] = content_hash(manifest)
            manifest["manifest_hash"] = manifest_hash(manifest)
            text = json_text(manifest).encode()
        except (ValueError, TypeError, LookupError, RecursionError, AttributeError):
            return  # not such a manifest that could be made right
        self._map.write("manifest.json", text)


def _lists(good: bytes) -> Iterator[bytes]:
    """Yield lists with ids out of range or twice, and codes that no row has."""
    words = np.frombuffer(good, "<i8").reshape(3, 3)  # of each photo: bits, two float32, its id
    for column, value in ((2, 2**62), (2, -1), (2, 1), (1, -1), (0, -1)):
        altered = words.copy()
        altered[:, column] = value
        yield altered.tobytes()


def _models() -> Iterator[bytes]:
    """Yield models in 8 bits; in the last, scales have scales."""
    matrix, scales = np.ones((3, 2), np.int8), np.ones(2, np.float32)
    for arrays in (
        {"a": matrix, "a" + SCALES: scales},
        {"a" + SCALES: matrix, "a" + 2 * SCALES: scales},
        {"a": matrix, "a" + SCALES: scales, "a" + 2 * SCALES: scales},
    ):
        file = io.BytesIO()
        # The savez stub takes no mapping of arrays as keywords beside allow_pickle.
        np.savez(file, **arrays)  # type: ignore[arg-type]
        yield file.getvalue()
