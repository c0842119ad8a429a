"""The tree of frames that a bag's ``/tf``, ``/tf_static`` and odometry describe (REP 105)."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

from visloc.geometry import Pose
from visloc.sequences.filling import interpolate_pose

# Between poses further apart nobody knows how the frame moved: tf2 keeps as much by default.
_LONGEST_GAP_NS = 10_000_000_000


@dataclass(slots=True)
class _Edge:
    """A frame's pose in its parent: ``parent_from_child`` by time; one without a time is static."""

    parent: str
    times: list[int] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)


class Transforms:
    """Poses of frames in their parents over time. Frames have no leading slash."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._sorted = True

    def add(self, parent: str, child: str, time_ns: int | None, pose: Pose) -> None:
        """Add ``parent_from_child``; a transform without a time holds always."""
        edge = self._edges.setdefault(child, _Edge(parent))
        if edge.parent != parent or (not edge.times and edge.poses):
            return  # a frame has one parent, and what is static does not begin to move
        if time_ns is None:
            edge.times.clear()
            edge.poses[:] = [pose]
            return
        self._sorted = self._sorted and (not edge.times or time_ns > edge.times[-1])
        edge.times.append(time_ns)
        edge.poses.append(pose)

    def knows(self, child: str) -> bool:
        """Tell whether the frame has a parent."""
        return child in self._edges

    def connects(self, a: str, b: str) -> bool:
        """Tell whether two frames are of one tree."""
        return self.root_of(a) == self.root_of(b)

    def root_of(self, frame: str) -> str:
        """Return the outermost frame above a frame, which is the frame itself if it has none."""
        path = self._path(frame)
        return path[-1]

    def moves(self, frame: str) -> bool:
        """Tell whether any transform between a frame and its root changes over time."""
        return any(self._edges[each].times for each in self._path(frame)[:-1])

    def pose(self, target: str, frame: str, time_ns: int) -> Pose | None:
        """Return ``target_from_frame`` at a time, interpolated.

        None where the frames are not connected, or nothing is known within 10 s of each other
        around the time.
        """
        ups, target_ups = self._path(frame), self._path(target)
        common = next((each for each in ups if each in target_ups), None)
        if common is None:
            return None
        above = self._above(ups[: ups.index(common)], time_ns)
        beside = self._above(target_ups[: target_ups.index(common)], time_ns)
        return None if above is None or beside is None else beside.inverse() @ above

    def _above(self, path: list[str], time_ns: int) -> Pose | None:
        total = Pose.identity()
        for each in path:
            step = self._at(self._edges[each], time_ns)
            if step is None:
                return None
            total = step @ total
        return total

    def _path(self, frame: str) -> list[str]:
        path = [frame]
        while (edge := self._edges.get(path[-1])) is not None and edge.parent not in path:
            path.append(edge.parent)
        return path

    def _at(self, edge: _Edge, time_ns: int) -> Pose | None:
        if not edge.times:
            return edge.poses[0]
        if not self._sorted:
            self._sort()
        after = bisect_left(edge.times, time_ns)
        if after < len(edge.times) and edge.times[after] == time_ns:
            return edge.poses[after]
        if after in (0, len(edge.times)):
            return None
        first, second = edge.times[after - 1], edge.times[after]
        if second - first > _LONGEST_GAP_NS:
            return None
        share = (time_ns - first) / (second - first)
        before, behind = edge.poses[after - 1].inverse(), edge.poses[after].inverse()
        return interpolate_pose(before, behind, share).inverse()

    def _sort(self) -> None:
        for edge in self._edges.values():
            order = sorted(range(len(edge.times)), key=edge.times.__getitem__)
            if edge.times:
                edge.times = [edge.times[i] for i in order]
                edge.poses = [edge.poses[i] for i in order]
        self._sorted = True
