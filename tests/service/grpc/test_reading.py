from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.grpc.reading import num_values
from visloc_api.v1 import localization_pb2 as pb2

RIG = pb2.LocalizeRigRequest.DESCRIPTOR
ENOUGH = 1000
# The fields of a rig by number, as the first byte of their encoding has it.
IMAGE, CALIBRATION, MAPS = (
    bytes([pb2.LocalizeRigRequest.DESCRIPTOR.fields_by_name[name].number << 3 | 2])
    for name in ("images", "calibration", "maps")
)


def test_fields_are_counted_also_within_messages() -> None:
    message = pb2.LocalizeRigRequest(map="room", maps=["a", "b"])
    message.images.add(sensor="left", image=b"photo")
    message.images.add()
    camera = message.calibration.sensors["left"].camera  # an entry has a key and a value
    camera.width = 640
    camera.params.extend([1.0, 2.0, 3.0])  # packed: one field, with three numbers

    # map, 2 maps, 2 images with 2 fields in one; calibration, entry, key, value, camera, 2; 3.
    assert num_values(message.SerializeToString(), RIG, ENOUGH) == 1 + 2 + 4 + 7 + 3


@pytest.mark.parametrize("unit", [IMAGE + b"\0", MAPS + b"\0", b"\xf8\x7f\0", b"\x0d1234"])
def test_counting_stops_when_there_are_enough(unit: bytes) -> None:
    assert num_values(unit * 100_000, RIG, ENOUGH) == ENOUGH
    assert num_values(CALIBRATION + b"\xff\xff\x03" + unit * 100_000, RIG, ENOUGH) >= 1


def test_numbers_of_a_byte_each_are_counted() -> None:
    message = pb2.LocalizeRequest()
    message.features.keypoints.shape.extend([0] * 5000)
    assert num_values(message.SerializeToString(), message.DESCRIPTOR, ENOUGH) > 5000


def test_bytes_are_not_looked_into() -> None:
    message = pb2.LocalizeRequest(image=MAPS + b"\0" * 1000)
    assert num_values(message.SerializeToString(), message.DESCRIPTOR, ENOUGH) == 1


@given(st.binary(max_size=200))
def test_whatever_comes_is_counted(data: bytes) -> None:
    assert 0 <= num_values(data, RIG, ENOUGH) <= len(data)


def test_a_type_may_be_within_itself() -> None:
    from google.protobuf.struct_pb2 import Value

    value = Value()
    for _ in range(50):
        value.list_value.values.add()
        value = value.list_value.values[0]
    outer = Value()
    outer.list_value.values.add().list_value.values.add().number_value = 1.0
    assert num_values(outer.SerializeToString(), Value.DESCRIPTOR, ENOUGH) == 5
