"""A ROS 2 node that asks the service about photos and broadcasts map -> odom (REP 105).

NOT RUN: written where no ROS could be had. Conversions are those of ``clients.frames``, which are
tested.

    python examples/ros2_node.py --ros-args -p server:=grpc://127.0.0.1:50051 -p map:=floor
"""

from __future__ import annotations

import numpy as np
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, CompressedImage
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

from clients import Axes, Client, blended, session_from_map
from visloc.errors import VislocError
from visloc.geometry import Pose
from visloc_extensions.ros.cameras import camera_from_info


class Localizer(Node):
    """Asks about a photo each second; between answers, odometry carries the robot."""

    def __init__(self) -> None:
        super().__init__("visloc")
        self._map = self.declare_parameter("map", "floor").value
        self._client = Client(self.declare_parameter("server", "grpc://127.0.0.1:50051").value)
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._broadcaster = TransformBroadcaster(self)
        self._camera = None
        self._photo: CompressedImage | None = None
        self._map_from_odom: np.ndarray | None = None
        self._variance = np.inf
        self.create_subscription(CameraInfo, "camera_info", self._on_info, 1)
        self.create_subscription(CompressedImage, "image/compressed", self._on_photo, 1)
        self.create_timer(1.0, self._ask)
        self.create_timer(0.05, self._broadcast)

    def _on_info(self, info: CameraInfo) -> None:
        self._camera = camera_from_info(info, "camera_info")

    def _on_photo(self, photo: CompressedImage) -> None:
        self._photo = photo

    def _ask(self) -> None:
        photo, self._photo = self._photo, None
        if photo is None:
            return
        stamp = Time.from_msg(photo.header.stamp)
        try:
            known = self._buffer.lookup_transform("odom", photo.header.frame_id, stamp).transform
            answer = self._client.localize(bytes(photo.data), self._map, self._camera)
        except (TransformException, VislocError) as error:
            self.get_logger().warning(str(error))
            return
        if not answer.localized:
            self.get_logger().info(f"not localized: {answer.refusal.reason}")
            return
        q, t = known.rotation, known.translation
        pose = Pose.from_quaternion((q.w, q.x, q.y, q.z), (t.x, t.y, t.z))
        odom_from_camera = np.eye(4)
        odom_from_camera[:3, :3], odom_from_camera[:3, 3] = pose.rotation, pose.translation
        odom_from_map = session_from_map(odom_from_camera, answer.pose, Axes.OPENCV)
        self._take(np.linalg.inv(odom_from_map), max(answer.pose.position_std) ** 2)

    def _take(self, map_from_odom: np.ndarray, variance: float) -> None:
        if self._map_from_odom is None:
            self._map_from_odom, self._variance = map_from_odom, variance
            return
        share = self._variance / (self._variance + variance)
        self._map_from_odom = blended(self._map_from_odom, map_from_odom, share)
        self._variance = (1 - share) * self._variance + 0.01**2  # odometry drifts

    def _broadcast(self) -> None:
        if self._map_from_odom is None:
            return
        message = TransformStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id, message.child_frame_id = "map", "odom"
        pose = Pose(self._map_from_odom[:3, :3], self._map_from_odom[:3, 3])
        moved = message.transform
        moved.translation.x, moved.translation.y, moved.translation.z = map(float, pose.translation)
        w, x, y, z = map(float, pose.rotation_wxyz)
        moved.rotation.w, moved.rotation.x, moved.rotation.y, moved.rotation.z = w, x, y, z
        self._broadcaster.sendTransform(message)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Localizer())
