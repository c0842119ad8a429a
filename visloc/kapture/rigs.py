"""Unrolling nested rigs."""

from __future__ import annotations

from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter

from visloc.geometry import Pose
from visloc.kapture.table import Table

MAX_RIG_DEPTH = 10  # as kapture's own tools


def unroll_rigs(
    members: Mapping[str, Mapping[str, Pose | None]], table: Table
) -> dict[str, dict[str, Pose | None]]:
    """Replace rigs among the members of rigs by their sensors.

    Args:
        members: rig id -> id of a sensor or of another rig -> ``member_from_rig``, None if
            unknown. The keys are the rigs.

    Returns:
        rig id -> sensor id -> ``sensor_from_rig``, None if unknown, in the order given.
    """
    subrigs = {rig_id: [m for m in rig if m in members] for rig_id, rig in members.items()}
    try:
        innermost_first = list(TopologicalSorter(subrigs).static_order())
    except CycleError as error:
        raise table.error("kapture.rig_cycle", got=" -> ".join(error.args[1])) from None

    depth: dict[str, int] = {}
    unrolled: dict[str, dict[str, Pose | None]] = {}
    for rig_id in innermost_first:
        depth[rig_id] = 1 + max((depth[subrig] for subrig in subrigs[rig_id]), default=0)
        if depth[rig_id] > MAX_RIG_DEPTH:
            raise table.error(
                "kapture.rig_depth", expected=f"at most {MAX_RIG_DEPTH} levels", got=rig_id
            )
        sensors: dict[str, Pose | None] = {}
        for member_id, member_from_rig in members[rig_id].items():
            inner = unrolled.get(member_id, {member_id: Pose.identity()})
            for sensor_id, sensor_from_member in inner.items():
                if sensor_id in sensors:
                    raise table.error(
                        "kapture.duplicate",
                        "the rig has a sensor twice, once through another rig",
                        expected="every sensor once in a rig",
                        got=f"{sensor_id!r} in {rig_id!r}",
                    )
                sensors[sensor_id] = (
                    None
                    if sensor_from_member is None or member_from_rig is None
                    else sensor_from_member @ member_from_rig
                )
        unrolled[rig_id] = sensors
    return {rig_id: unrolled[rig_id] for rig_id in members}
