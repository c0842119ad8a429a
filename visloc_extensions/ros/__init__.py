"""ROS 1 and ROS 2 bags, read and written without ROS, by ``rosbags``.

``mapping import rosbag`` and ``localize bag``. Pictures, cameras and transforms come in our
conventions: pixels count from the corner, a camera's frame is its optical frame (REP 103),
``a_from_b`` as everywhere.
"""
