"""``localize bag``: the photos of a ROS bag, and their poses as a new bag."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from clients.cli.display import print_line
from clients.cli.options import Connection, MapRef, QueryOptions, spread
from clients.cli.progress import run_with_progress
from clients.client import AsyncClient
from clients.evaluation.results import check_can_be_written
from clients.evaluation.run import ask_patiently, raise_unless_of_one
from visloc.errors import VislocError, refuse
from visloc.geometry import Pose, propagated
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.poses import PoseEstimate
from visloc_extensions.ros.pictures import Picture
from visloc_extensions.ros.reading import Bag, open_bag
from visloc_extensions.ros.writing import PoseStamped, write_poses

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
    photo that is not localized has no message, nor one for whose time tf does not tell how the
    frame lies to the camera. Needs no ROS.

    Exits with 0 when at least one photo was localized, 3 when none was, 1 on an error.
    """
    if output.exists():
        raise refuse("bag.exists", field=str(output))
    check_can_be_written([output])
    poses: list[PoseStamped] = []
    failed: list[VislocError] = []
    with open_bag(path) as opened:
        topics = _chosen(opened, topic)
        if frame is None and len(topics) > 1:
            raise refuse("bag.cameras", field="--frame", got=", ".join(topics))
        with connection.client() as client:
            info = client.map(map_ref)

        async def work(advance: Callable[[], None]) -> None:
            async with connection.async_client() as client:
                for picture in opened.pictures(topics):
                    device_from_cam = _device_from_cam(opened, picture, frame)
                    if device_from_cam is not None:
                        ask = partial(_ask, client, opened, picture, info.ref, query.options)
                        try:
                            found = await ask_patiently(ask)
                        except VislocError as error:
                            raise_unless_of_one(error)
                            failed.append(error)
                        else:
                            if found is not None:
                                poses.append(stamped(picture.time_ns, found, device_from_cam))
                    advance()

        asked = opened.count(topics)
        run_with_progress(_err, work, "photos", asked, "nothing was written")
    write_poses(output, "/visloc/pose", world, poses, ros1=output.suffix == ".bag")
    counts = f"{len(poses)} of {asked} photos localized"
    _err.print(f"{counts}; poses: {output}", highlight=False, soft_wrap=True)
    if failed:
        told = f"{len(failed)} photos, the first: [{failed[0].code}] {failed[0]}"
        print_line(_err, "no answer", told, "yellow")
    for note in opened.notes():
        print_line(_err, "note", note, "yellow")
    if not info.metric:
        print_line(_err, "unit", "of the map, which is not known to be a metre", "yellow")
    if not poses:
        raise typer.Exit(3)


def _chosen(opened: Bag, topics: list[str] | None) -> tuple[str, ...]:
    opened.check_has_photos()
    unknown = [each for each in topics or () if each not in opened.photos]
    if unknown:
        got = f"{unknown[0]}: {opened.left_out.get(unknown[0], 'no such topic')}"
        raise refuse("bag.topic", field="--topic", expected=opened.photos, got=got)
    return tuple(topics) if topics else opened.photos


def _device_from_cam(opened: Bag, picture: Picture, frame: str | None) -> Pose | None:
    """Return how a camera lies to the frame that is asked for; None if that is not known then."""
    if frame is None:
        return Pose.identity()
    if not opened.transforms.connects(frame, picture.frame):
        raise refuse("bag.frame", field="--frame", expected=picture.frame, got=frame)
    return opened.transforms.pose(frame, picture.frame, picture.time_ns)


async def _ask(
    client: AsyncClient, opened: Bag, picture: Picture, map_ref: str, options: LocalizeOptions
) -> PoseEstimate | None:
    camera = opened.cameras[picture.topic]
    answer = await client.localize(picture.file(), map_ref, camera, options)
    return answer.pose


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
