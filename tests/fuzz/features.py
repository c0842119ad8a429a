"""Requests for one photo or a rig, in JSON and protobuf, above all features that are sent.

The first byte says how the others are to be read.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from service.api import jobs
from service.grpc.messages import localize_job_of, rig_job_of
from service.values import RigJob
from tests.fuzz.target import holds, refusal
from tests.fuzz.tiny_map import GLOBAL_DIM, LOCAL_DIM, write_tiny_map
from visloc.archive import open_map
from visloc.errors import InvalidInput
from visloc.geometry import Camera
from visloc.localization.query.features import checked_global_descriptors, checked_local_features
from visloc.types import QueryFeatures
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import BatchLimits, LocalizeRigRequest

_JSON, _PROTOBUF, _RIG_JSON, _RIG_PROTOBUF, _ARRAYS = range(5)
_LIMITS = BatchLimits(max_images=8, max_instants=20)
_DTYPES = {"float32": "<f4", "float16": "<f2", "uint8": "u1", "int8": "i1"}
_CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))


class Features:
    """Reads requests and checks the features in them against two maps."""

    def __init__(self, folder: Path) -> None:
        self._manifests = []
        for name in ("sift", "kapture:dense"):
            write_tiny_map(folder / name.replace(":", "-"), name)
            self._manifests.append(open_map(folder / name.replace(":", "-")).manifest)

    def run(self, data: bytes) -> str:
        """Read a request; features that are accepted can be matched."""
        try:
            job = _read(data[0] % 5 if data else 0, data[1:])
            for image in job.images:
                if isinstance(image.query, QueryFeatures):
                    self._check(image.query, image.camera or _CAMERA)
        except DecodeError:
            return "not protobuf"
        except InvalidInput as error:
            return refusal(error, "")
        return "accepted"

    def repair(self, data: bytes) -> bytes:
        """Take bytes that are no message as the numbers of arrays."""
        try:
            _read(data[0] % 5, data[1:])
        except DecodeError:
            return bytes([_ARRAYS]) + data[1:]
        except InvalidInput as error:
            if error.code == "request.malformed":
                return bytes([_ARRAYS]) + data[1:]
        except IndexError:
            pass  # no bytes at all
        return data

    def seeds(self) -> Iterator[bytes]:
        """Yield requests of every kind."""
        for kind in ("sift", "kapture:dense"):
            features = _features(kind, "float32", "float32", np.arange(6 + 3 * LOCAL_DIM))
            yield bytes([_JSON]) + json.dumps(_as_json(features)).encode()
            yield bytes([_PROTOBUF]) + _as_protobuf(features).SerializeToString()
        camera = {"model": "PINHOLE", "width": 64, "height": 48, "params": [50, 50, 32, 24]}
        image = base64.b64encode(b"photo").decode()
        pose = {"rotation_wxyz": [1, 0, 0, 0], "translation": [0, 0, 0]}
        priors = {
            "position": {"position": [1, 2, 3], "radius": 4},
            "height": {"min": 0, "max": 1},
            "pose": {
                "device_from_world": pose,
                "covariance": np.eye(6).ravel().tolist(),
            },
            "gravity": {"direction": [0, 1, 0], "std_deg": 1.5, "world": [0, 0, -1]},
        }
        options = {"preset": "config1", "top_k": 5, "read_as": "upright", "seed": 1}
        whole = {"map": "room", "image": image, "camera": camera, "priors": priors}
        yield bytes([_JSON]) + json.dumps(whole | {"options": options}).encode()
        near = {"latitude": 45.0, "longitude": 5.8, "radius": 100.0}
        yield bytes([_JSON]) + json.dumps({"near": near, "image": image, "ypr": True}).encode()
        rig = {"sensors": {"cam": {"cam_from_rig": pose, "camera": camera}}}
        images = [{"sensor": "cam", "image": image, "timestamp": 5}]
        request = {"map": "room", "rig": rig, "images": images, "priors": priors}
        yield bytes([_RIG_JSON]) + json.dumps(request).encode()
        yield bytes([_RIG_JSON]) + json.dumps(request | {"rig": "rig"}).encode()
        message = pb2.LocalizeRigRequest(maps=["a", "b@v1"], rig_id="rig")
        message.images.add(sensor="cam", features=_features("sift", "uint8", "int8", np.ones(9)))
        yield bytes([_RIG_PROTOBUF]) + message.SerializeToString()
        numbers = np.linspace(1, 40, 200).astype("<f4").tobytes()
        for local in range(4):
            yield bytes([_ARRAYS, local, 3 - local, local % 2, 3]) + numbers

    def _check(self, query: QueryFeatures, camera: Camera) -> None:
        refused: InvalidInput | None = None
        for manifest in self._manifests:
            try:
                local = checked_local_features(query, camera, manifest)
                rows = checked_global_descriptors(query, manifest, set())
            except InvalidInput as error:
                refused = error
                continue
            with holds("features"):
                assert local.keypoints.shape == (len(local.descriptors), 2)
                assert local.keypoints.dtype == local.descriptors.dtype == np.float32
                assert np.isfinite(local.keypoints).all()
                _check_unit(local.descriptors)
                for row in rows.values():
                    assert row.shape == (GLOBAL_DIM,)
                    _check_unit(row[np.newaxis][:, : GLOBAL_DIM if row.any() else 0])
            return
        assert refused is not None
        raise refused


def _check_unit(rows: np.ndarray) -> None:
    assert rows.dtype == np.float32
    if rows.size:
        np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-5)


def _read(kind: int, data: bytes) -> RigJob:
    if kind == _JSON:
        return jobs.photo_job_of(LocalizeRequest.read_json(data))
    if kind == _PROTOBUF:
        return localize_job_of(pb2.LocalizeRequest.FromString(data), 2**20)
    if kind == _RIG_JSON:
        return jobs.rig_job_of(LocalizeRigRequest.read_json(data, _LIMITS))
    if kind == _RIG_PROTOBUF:
        return rig_job_of(pb2.LocalizeRigRequest.FromString(data), _LIMITS)
    return localize_job_of(_as_protobuf(_arrays(data)), 2**20)


def _arrays(data: bytes) -> pb2.Features:
    """Make features of bytes that are no numbers of the right count by themselves."""
    head, rest = [*data[:4], 0, 0, 0, 0][:4], data[4:]
    names = list(_DTYPES)
    keypoints, descriptors = names[head[0] % 4], names[head[1] % 4]
    kind = ("sift", "kapture:dense")[head[2] % 2]
    num_bytes = head[3] * (
        2 * np.dtype(_DTYPES[keypoints]).itemsize
        + LOCAL_DIM * np.dtype(_DTYPES[descriptors]).itemsize
    )
    filled = (rest or b"\1") * (num_bytes // max(len(rest), 1) + 1)
    split = head[3] * 2 * np.dtype(_DTYPES[keypoints]).itemsize
    features = _features(kind, keypoints, descriptors, np.empty(0))
    features.keypoints.shape[:] = [head[3], 2]
    features.keypoints.data = filled[:split]
    features.descriptors.shape[:] = [head[3], LOCAL_DIM]
    features.descriptors.data = filled[split:num_bytes]
    return features


def _features(
    kind: str,
    keypoints: str,
    descriptors: str,
    numbers: np.ndarray,
) -> pb2.Features:
    """Make features whose numbers are given: x and y of all keypoints, then descriptors."""
    count = len(numbers) // (2 + LOCAL_DIM)
    xy, rows = numbers[: 2 * count], numbers[2 * count : count * (2 + LOCAL_DIM)]
    return pb2.Features(
        kind=kind,
        keypoints=pb2.Array(
            dtype=keypoints, shape=[count, 2], data=xy.astype(_DTYPES[keypoints]).tobytes()
        ),
        descriptors=pb2.Array(
            dtype=descriptors,
            shape=[count, LOCAL_DIM],
            data=rows.astype(_DTYPES[descriptors]).tobytes(),
        ),
        global_descriptors={
            "densevlad": pb2.Array(
                dtype="float32",
                shape=[GLOBAL_DIM],
                data=np.arange(GLOBAL_DIM, dtype="<f4").tobytes(),
            )
        },
    )


def _as_protobuf(features: pb2.Features) -> pb2.LocalizeRequest:
    camera = pb2.Camera(model="PINHOLE", width=64, height=48, params=_CAMERA.params)
    return pb2.LocalizeRequest(map="room", features=features, camera=camera)


def _as_json(features: pb2.Features) -> dict[str, object]:
    def array(given: pb2.Array) -> dict[str, object]:
        return {
            "dtype": given.dtype,
            "shape": list(given.shape),
            "data": base64.b64encode(given.data).decode(),
        }

    return {
        "map": "room",
        "camera": "PINHOLE,64,48,50,50,32,24",
        "features": {
            "kind": features.kind,
            "keypoints": array(features.keypoints),
            "descriptors": array(features.descriptors),
            "global_descriptors": {
                name: array(row) for name, row in features.global_descriptors.items()
            },
        },
    }
