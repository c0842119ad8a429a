"""ROS 1 and ROS 2 bags, read and written without ROS, by ``rosbags``.

Pictures, cameras and transforms come in our conventions: pixels count from the corner, a camera's
frame is its optical frame (REP 103), ``a_from_b`` as everywhere.
"""

from visloc.rosbag.cameras import camera_from_info
from visloc.rosbag.pictures import Picture, depth_in_metres, is_depth
from visloc.rosbag.reading import Bag, open_bag
from visloc.rosbag.transforms import Transforms
from visloc.rosbag.writing import PoseStamped, write_poses

__all__ = [
    "Bag",
    "Picture",
    "PoseStamped",
    "Transforms",
    "camera_from_info",
    "depth_in_metres",
    "is_depth",
    "open_bag",
    "write_poses",
]
