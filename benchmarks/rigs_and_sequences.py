"""Rigs and sequences under harm: one camera spoiled, every second instant lost, motion with drift.

    python benchmarks/rigs_and_sequences.py MAP QUERY --time-unit ms

MAP is a folder of a map, id or id@version in --maps-dir; QUERY a kapture dataset with one rig and
true poses. Queries run in this process, with the default options. Prints tables in Markdown.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.archive import MapStore
from visloc.evaluation import percentile, pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.solving import Look, SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import ImageLimits, read_photo
from visloc.priors import NO_PRIORS
from visloc.sequences.filling import Odometry, TimeUnit, TracedPose, fill_rig, interpolate_pose
from visloc.sequences.solver import SeenInstant, SequenceSolver
from visloc.types import InstantAnswer, PoseSource

Pixels = NDArray[np.uint8]
BLUR_SIGMA_PX = 12.0
NOISE = ((0.0, 0.0), (0.01, 0.1), (0.03, 0.3), (0.10, 1.0))


@dataclass(frozen=True)
class Photo:
    """One photo of a rig, encoded, with its camera."""

    sensor: str
    image: bytes
    camera: Camera


@dataclass(frozen=True)
class Moment:
    """All photos of a rig at one instant, and where it was."""

    timestamp: int
    photos: tuple[Photo, ...]
    rig_from_world: Pose


def read_moments(query: Path) -> tuple[dict[str, Pose], list[Moment]]:
    """Read the only rig of a dataset and its instants in order of time."""
    dataset = read_dataset(query)
    (members,) = dataset.rigs.values()
    cameras = {record.sensor_id for record in dataset.images}
    rig = {
        sensor: cam_from_rig
        for sensor, cam_from_rig in members.items()
        if sensor in cameras and cam_from_rig is not None
    }
    by_time: dict[int, list[Photo]] = {}
    truth: dict[int, Pose] = {}
    for record in dataset.images:
        photo, pose = (
            _photo(dataset, record.sensor_id, dataset.path_of(record)),
            dataset.pose(record),
        )
        assert pose is not None
        by_time.setdefault(record.timestamp, []).append(photo)
        truth[record.timestamp] = rig[record.sensor_id].inverse() @ pose
    return rig, [Moment(t, tuple(by_time[t]), truth[t]) for t in sorted(by_time)]


def _photo(dataset: Dataset, sensor: str, path: Path) -> Photo:
    camera = dataset.sensors[sensor].camera
    assert camera is not None
    return Photo(sensor, path.read_bytes(), camera)


def blackened(photo: Photo) -> Photo:
    """Nothing is left."""
    return _with_pixels(photo, np.zeros((photo.camera.height, photo.camera.width, 3), np.uint8))


def blurred(photo: Photo) -> Photo:
    """A Gaussian blur of ``BLUR_SIGMA_PX``."""
    soft = cv2.GaussianBlur(_pixels(photo), (0, 0), BLUR_SIGMA_PX)
    return _with_pixels(photo, np.asarray(soft, dtype=np.uint8))


def cropped(photo: Photo) -> Photo:
    """The middle quarter of the picture, half its width and height."""
    camera = photo.camera
    left, top = camera.width // 4, camera.height // 4
    width, height = camera.width // 2, camera.height // 2
    fx, fy, cx, cy = camera.params  # PINHOLE
    smaller = Camera(camera.model, width, height, (fx, fy, cx - left, cy - top))
    rgb = _pixels(photo)[top : top + height, left : left + width]
    return replace(_with_pixels(photo, rgb), camera=smaller)


def _pixels(photo: Photo) -> Pixels:
    found = cv2.imdecode(np.frombuffer(photo.image, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return np.asarray(found, dtype=np.uint8)


def _with_pixels(photo: Photo, pixels: Pixels) -> Photo:
    return replace(photo, image=cv2.imencode(".png", pixels)[1].tobytes())


HARMS: dict[str, Callable[[Photo], Photo]] = {
    "blacked out": blackened,
    f"blurred (sigma {BLUR_SIGMA_PX:g} px)": blurred,
    "cropped to 25 %": cropped,
}


class Bench:
    """Asks one map; every photo is looked at once."""

    def __init__(self, localizer: Localizer, rig: dict[str, Pose], unit: TimeUnit) -> None:
        self.rig = rig
        self._localizer, self._unit = localizer, unit
        self._looks: dict[Photo, Look] = {}

    def single(self, photo: Photo) -> TracedPose | None:
        """Localize one photo on its own."""
        seen = SeenImage(photo.sensor, Pose.identity(), self._look(photo))
        answer = self._localizer.solve([seen], LocalizeOptions()).answer
        if answer.pose is None:
            return None
        pose = answer.pose
        return TracedPose(
            pose.rig_from_world, pose.covariance, pose.source, pose.uncertainty, answer.num_inliers
        )

    def instant(self, photos: Sequence[Photo]) -> InstantAnswer:
        """Localize the photos of one instant together."""
        return self._localizer.solve(self._seen(photos), LocalizeOptions()).answer

    def sequence(
        self, moments: Sequence[Moment], odometry: Sequence[Odometry | None], max_gap_s: float
    ) -> list[InstantAnswer]:
        """Localize instants as a sequence."""
        solver = SequenceSolver(
            self._localizer.geometry,
            metric=self._localizer.map.manifest.world.metric,
            options=LocalizeOptions(),
            time_unit=self._unit,
            max_gap_s=max_gap_s,
        )
        answers = []
        for moment, motion in zip(moments, odometry, strict=True):
            seen = SeenInstant(moment.timestamp, self._seen(moment.photos), motion, NO_PRIORS)
            answers += solver.add(seen)
        return answers + solver.finish()

    def _seen(self, photos: Sequence[Photo]) -> tuple[SeenImage, ...]:
        return tuple(
            SeenImage(photo.sensor, self.rig[photo.sensor], self._look(photo)) for photo in photos
        )

    def _look(self, photo: Photo) -> Look:
        if photo not in self._looks:
            pixels = read_photo(photo.image, ImageLimits())
            self._looks[photo] = self._localizer.look(pixels, photo.camera, LocalizeOptions())
        return self._looks[photo]


def noisy_odometry(
    moments: Sequence[Moment], share: float, degrees: float, seed: int
) -> list[Odometry]:
    """The true motion between instants, with noise on each step, as a tracker would add it up.

    ``degrees`` is the standard deviation about each axis, ``share`` that along each axis as a share
    of the distance.
    """
    random = np.random.default_rng(seed)
    poses = [Pose.identity()]
    for before, after in itertools.pairwise(moments):
        motion = after.rig_from_world @ before.rig_from_world.inverse()
        distance = float(np.linalg.norm(motion.translation))
        turn = Rotation.from_rotvec(np.radians(degrees) * random.normal(size=3))
        noisy = Pose(
            turn.as_matrix() @ motion.rotation,
            motion.translation + share * distance * random.normal(size=3),
        )
        poses.append(noisy @ poses[-1])
    return [Odometry(pose, None) for pose in poses]


def _errors(
    answers: Sequence[InstantAnswer], moments: Sequence[Moment]
) -> list[tuple[float, float]]:
    return [
        pose_error(answer.pose.rig_from_world, moment.rig_from_world)
        for answer, moment in zip(answers, moments, strict=True)
        if answer.pose is not None
    ]


def _summary(errors: Sequence[tuple[float, float]]) -> str:
    if not errors:
        return "- | - | -"
    metres, degrees = zip(*errors, strict=True)
    return (
        f"{100 * percentile(metres, 50):.2f} cm, {percentile(degrees, 50):.3f}° | "
        f"{100 * percentile(metres, 90):.2f} cm, {percentile(degrees, 90):.3f}° | "
        f"{100 * max(metres):.2f} cm, {max(degrees):.3f}°"
    )


def _one_camera_harmed(bench: Bench, moments: Sequence[Moment], harmed: str) -> None:
    typer.echo(f"All photos of one camera ({harmed}) harmed; errors of all photos' poses\n")
    typer.echo("| harm | mode | photos with a pose | median | 90 % | worst |")
    typer.echo("|---|---|---|---|---|---|")
    for name, harm in {"none": lambda photo: photo, **HARMS}.items():
        errors: dict[str, list[tuple[float, float]]] = {"single": [], "rig": [], "gp3p": []}
        for moment in moments:
            photos = [harm(p) if p.sensor == harmed else p for p in moment.photos]
            singles = {photo.sensor: bench.single(photo) for photo in photos}
            together = bench.instant(photos).pose
            traced = {"single": singles, "rig": fill_rig(singles, bench.rig)}
            by_mode = {
                mode: {sensor: found.pose for sensor, found in poses.items() if found is not None}
                for mode, poses in traced.items()
            }
            by_mode["gp3p"] = (
                {}
                if together is None
                else {sensor: bench.rig[sensor] @ together.rig_from_world for sensor in singles}
            )
            for mode, cams_from_world in by_mode.items():
                errors[mode] += [
                    pose_error(pose, bench.rig[sensor] @ moment.rig_from_world)
                    for sensor, pose in cams_from_world.items()
                ]
        num_photos = sum(len(moment.photos) for moment in moments)
        for mode, found_errors in errors.items():
            typer.echo(
                f"| {name} | {mode} | {len(found_errors)} of {num_photos} | "
                f"{_summary(found_errors)} |"
            )
    typer.echo()


def _every_second_lost(
    bench: Bench, moments: Sequence[Moment], max_gap_s: float, seeds: int
) -> None:
    lost = [
        replace(moment, photos=tuple(blackened(photo) for photo in moment.photos))
        if i % 2
        else moment
        for i, moment in enumerate(moments)
    ]
    odd = slice(1, None, 2)
    truth = [moment.rig_from_world for moment in moments]
    ideal = [
        pose_error(interpolate_pose(truth[i - 1], truth[i + 1], _share(moments, i)), truth[i])
        for i in range(1, len(moments) - 1, 2)
    ]
    typer.echo(f"Every second of {len(moments)} instants blacked out; errors of those\n")
    typer.echo("| how | filled | median | 90 % | worst |")
    typer.echo("|---|---|---|---|---|")
    typer.echo(f"| interpolation of the true poses | {len(ideal)} | {_summary(ideal)} |")
    answers = bench.sequence(lost, [None] * len(lost), max_gap_s)
    _print_filled("interpolated", answers[odd], moments[odd])
    for share, degrees in NOISE:
        filled, errors, measured = [], [], []
        for seed in range(seeds):
            odometry = noisy_odometry(moments, share, degrees, seed)
            answers = bench.sequence(lost, odometry, max_gap_s)
            filled += answers[odd]
            errors += _errors(answers[odd], moments[odd])
            measured += _errors(answers[::2], moments[::2])
        name = f"motion, {share:.0%} and {degrees:g}° of noise per instant"
        _print_line(name, filled, errors)
        typer.echo(f"| ... the measured instants of it | {len(measured)} | {_summary(measured)} |")
    typer.echo()


def _share(moments: Sequence[Moment], i: int) -> float:
    before, here, after = (moments[j].timestamp for j in (i - 1, i, i + 1))
    return (here - before) / (after - before)


def _print_filled(name: str, answers: Sequence[InstantAnswer], moments: Sequence[Moment]) -> None:
    _print_line(name, answers, _errors(answers, moments))


def _print_line(
    name: str, answers: Sequence[InstantAnswer], errors: Sequence[tuple[float, float]]
) -> None:
    sources = [answer.pose.source for answer in answers if answer.pose is not None]
    counts = ", ".join(
        f"{sources.count(source)} {source}" for source in PoseSource if source in sources
    )
    typer.echo(f"| {name} | {counts or 'none'} of {len(answers)} | {_summary(errors)} |")


def main(
    map_ref: Annotated[str, typer.Argument(metavar="MAP", help="id, or id@version.")],
    query: Annotated[Path, typer.Argument(help="A kapture dataset.")],
    time_unit: TimeUnit,
    maps_dir: Path = Path("maps"),
    weights_dir: Path | None = None,
    harmed: Annotated[str | None, typer.Option(help="The camera to harm; else the first.")] = None,
    max_gap: float = 1.0,
    seeds: Annotated[int, typer.Option(help="Runs of each noise.")] = 1,
) -> None:
    """Harm, localize, print."""
    opened = MapStore(maps_dir).open(map_ref)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    rig, moments = read_moments(query)
    bench = Bench(localizer, rig, time_unit)
    _one_camera_harmed(bench, moments, harmed or next(iter(rig)))
    _every_second_lost(bench, moments, max_gap, seeds)


if __name__ == "__main__":
    typer.run(main)
