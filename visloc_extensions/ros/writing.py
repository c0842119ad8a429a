"""Poses as ``geometry_msgs/PoseWithCovarianceStamped`` in a bag of their own."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import Pose, center_covariance, propagated

_PER_SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class PoseStamped:
    """A pose to write.

    Attributes:
        time_ns: of the photo.
        covariance: (6, 6) of (w, dt), as answers state it.
    """

    time_ns: int
    device_from_world: Pose
    covariance: NDArray[np.float64]


def ros_covariance(device_from_world: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) that ``PoseWithCovariance`` states.

    x, y, z of the device in the world, then its rotation about the world's fixed axes. Ours is of
    (w, dt) with R <- Exp(w) R for device_from_world, so the device turns by -R^T w in the world.
    """
    of_center = center_covariance(device_from_world, covariance)
    jacobian = np.zeros((6, 6))
    jacobian[:3, 3:] = np.eye(3)
    jacobian[3:, :3] = -device_from_world.rotation.T
    return propagated(jacobian, of_center)


def write_poses(
    path: Path, topic: str, frame: str, poses: Iterable[PoseStamped], *, ros1: bool = False
) -> None:
    """Write poses into a new bag; nothing is left of it if this fails.

    Args:
        path: a file for ROS 1, a folder for ROS 2; it must not exist.
        frame: the frame that the poses are in, such as ``map``.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise refuse("bag.no_rosbags") from None
    if path.exists():
        raise refuse("bag.exists", field=str(path))
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    partial = path.with_name(f".{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    written = partial / path.name  # ROS 2 names the files in a bag after it
    try:
        opened: Any = rosbag1.Writer(written) if ros1 else rosbag2.Writer(written, version=8)
        with opened as writer:
            connection = writer.add_connection(topic, kind, typestore=store)
            for number, pose in enumerate(poses):
                message = _message(store, pose, frame, {"seq": number} if ros1 else {})
                encode = store.serialize_ros1 if ros1 else store.serialize_cdr
                writer.write(connection, pose.time_ns, encode(message, kind))
        written.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _message(store: Any, pose: PoseStamped, frame: str, numbered: dict[str, int]) -> Any:
    def new(name: str, **fields: Any) -> Any:
        return store.types[name](**fields)

    world_from_device = pose.device_from_world.inverse()
    w, qx, qy, qz = map(float, world_from_device.rotation_wxyz)
    x, y, z = map(float, world_from_device.translation)
    seconds, rest = divmod(pose.time_ns, _PER_SECOND)
    stamp = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    at = new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=w),
    )
    stated = ros_covariance(pose.device_from_world, pose.covariance).reshape(-1)
    return new(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **numbered),
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=stated),
    )
