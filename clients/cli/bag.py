"""``localize bag``: the photos of a ROS bag, and their poses as a new bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from clients.cli.options import Connection, MapRef, QueryOptions, spread
from clients.cli.progress import run_with_progress
from clients.client import AsyncClient
from visloc.errors import refuse
from visloc.geometry import Pose, propagated
from visloc.rosbag import Bag, Picture, PoseStamped, open_bag, write_poses
from visloc_api.words.poses import PoseEstimate

_err = Console(stderr=True)


@spread
def bag(
    *,
    path: Annotated[
        Path, typer.Argument(metavar="BAG", help="A .bag of ROS 1, or the folder of a ROS 2 bag.")
    ],
    map_ref: MapRef,
    output: Annotated[
        Path,
        typer.Option(help="The bag to write: of ROS 1 if it ends in .bag, else a folder, ROS 2."),
    ],
    topic: Annotated[
        list[str] | None,
        typer.Option(help="A topic of photos; may be repeated. Default: all of them."),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            help="The frame whose pose is written, such as base_link, by the bag's tf. Default: "
            "the camera's."
        ),
    ] = None,
    world: Annotated[
        str, typer.Option(help="The name of the map's frame in the messages' header.")
    ] = "map",
    query: QueryOptions,
    connection: Connection,
) -> None:
    """Localize the photos of a ROS bag and write their poses as a new bag.

    Writes PoseWithCovarianceStamped messages to /visloc/pose, with the stamps of the photos. A
    photo that is not localized has no message. Needs no ROS.

    Exits with 0 when at least one photo was localized, 3 when none was, 1 on an error.
    """
    if output.exists():
        raise refuse("bag.exists", field=str(output))
    poses: list[PoseStamped] = []
    asked = 0
    with open_bag(path) as opened:
        topics = _chosen(opened, topic)

        async def work(advance: Callable[[], None]) -> None:
            nonlocal asked
            async with connection.async_client() as client:
                for picture in opened.pictures(topics):
                    asked += 1
                    found = await _pose(client, opened, picture, map_ref, query, frame)
                    poses.extend(() if found is None else (found,))
                    advance()

        run_with_progress(_err, work, "photos", opened.count(topics), "nothing was written")
    write_poses(output, "/visloc/pose", world, poses, ros1=output.suffix == ".bag")
    _err.print(f"{len(poses)} of {asked} photos localized; poses: {output}", highlight=False)
    if not poses:
        raise typer.Exit(3)


def _chosen(opened: Bag, topics: list[str] | None) -> tuple[str, ...]:
    if not opened.photos:
        raise refuse("bag.no_photos", field=str(opened.path))
    unknown = [each for each in topics or () if each not in opened.photos]
    if unknown:
        raise refuse("bag.topic", field="--topic", expected=opened.photos, got=unknown[0])
    return tuple(topics) if topics else opened.photos


async def _pose(
    client: AsyncClient,
    opened: Bag,
    picture: Picture,
    map_ref: str,
    query: QueryOptions,
    frame: str | None,
) -> PoseStamped | None:
    camera = opened.cameras[picture.topic]
    answer = await client.localize(picture.file(), map_ref, camera, query.options)
    if not answer.localized or answer.pose is None:
        return None
    device_from_cam = Pose.identity()
    if frame is not None:
        known = opened.transforms.pose(frame, picture.frame, picture.time_ns)
        if known is None:
            raise refuse("bag.frame", field="--frame", expected=picture.frame, got=frame)
        device_from_cam = known
    return stamped(picture.time_ns, answer.pose, device_from_cam)


def stamped(time_ns: int, pose: PoseEstimate, device_from_cam: Pose) -> PoseStamped:
    """Return the pose of a device that a camera is fixed to, with its covariance.

    R <- Exp(w) R and t <- t + dt of cam_from_world turn, for the device, into the same with w and
    dt rotated by ``device_from_cam``.
    """
    jacobian = np.asarray(np.kron(np.eye(2), device_from_cam.rotation), np.float64)
    covariance = np.asarray(pose.covariance, np.float64).reshape(6, 6)
    return PoseStamped(
        time_ns, device_from_cam @ pose.cam_from_world, propagated(jacobian, covariance)
    )
