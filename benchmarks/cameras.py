"""Queries whose camera is not quite right: error, and error over stated deviation.

    python -m benchmarks.cameras exif given shutter zoom sequence exact
    python -m benchmarks.cameras held-out zoomed-maps --data ../shared/data

``exif``: queries of the sample with EXIF's focal length in whole millimetres (24.75 is true);
``given``: with the sample's camera changed; ``shutter``: taken while the camera moves, rows read
within 20 ms; ``zoom``: the middle quarter, with EXIF that tells the zoom beside the focal length
without it; ``sequence``: a camera that is a little off, photos alone and in a sequence; ``exact``:
right cameras of several sets. ``held-out``: maps of photos alone without every fifth photo, which
is asked without intrinsics, and with the map's camera. ``zoomed-maps``: maps of photos alone, every
tenth with digital zoom. Maps are those of ``make trust``; missing ones are built.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from PIL import ExifTags, Image
from scipy.special import chdtri

from benchmarks.trust.maps import SAMPLE, Places, make_missing
from mapping.frames.anchor import align_poses
from mapping.importers import read_model
from mapping.importers.dataset import write_imported
from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from samples.render import render_photo
from samples.scene import make_room
from visloc.archive import Map
from visloc.geometry import Camera, PixelOrigin, Pose, Similarity, rotation_angle
from visloc.in_process import LocalMap, open_map
from visloc.kapture import Dataset, FileRecord, read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.solving import SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.motion import position_covariance
from visloc.priors import NO_PRIORS
from visloc.sequences.filling import TimeUnit
from visloc.sequences.solver import MapSequenceSolver, SeenInstant
from visloc.types import Localized

QUERIES, ROWS_MS, BANDS = 10, 20.0, 24
EXACT = (SAMPLE, "castle", "kitti_curve", "virtual_gallery", "redkitchen")
HELD_OUT = (
    *("castle", "lund_door", SAMPLE, "redkitchen", "virtual_gallery", "gardenspoint"),
    "kitti_curve",
)
ZOOM = 1.6
# Of the spread of the photos, and degrees.
RIGHT_SHARE, RIGHT_DEG = 0.02, 2.0
Make = Callable[[NDArray[np.uint8], Camera], tuple[NDArray[np.uint8], Camera]]


class Row:
    """The answers to some queries, printed as a row of the table."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.asked = 0
        self.found: list[tuple[float, float, bool]] = []
        self.sources: Counter[str] = Counter()

    def ask(self, localizer: Localizer, path: Path, camera: Camera | None, truth: Pose) -> None:
        """Ask one query, and compare with the truth."""
        self.asked += 1
        answer = localizer.localize(read_photo_file(path), camera, LocalizeOptions())
        self.sources[str(answer.evidence.camera_source)] += 1
        if isinstance(answer, Localized):
            self.add(answer.cam_from_world, answer.covariance, truth)

    def add(self, found: Pose, covariance: NDArray[np.float64], truth: Pose) -> None:
        """Compare an answer's pose and covariance with the truth."""
        error = found.center - truth.center
        stated = position_covariance(found, covariance)
        inside = bool(error @ np.linalg.solve(stated, error) <= chdtri(3, 0.05))
        off = float(np.linalg.norm(error))
        self.found.append((off, off / float(np.sqrt(np.trace(stated))), inside))

    def print(self) -> None:
        """Print it."""
        off, ratio, inside = np.array(self.found, np.float64).reshape(-1, 3).T
        sources = ", ".join(self.sources)
        typer.echo(
            f"| {self.name} | {sources} | {len(off)} of {self.asked} | "
            f"{100 * np.median(off):.2f} | {100 * off.max(initial=0):.1f} | "
            f"{np.median(ratio):.1f} | {inside.mean():.0%} |"
            if len(off)
            else f"| {self.name} | {sources} | 0 of {self.asked} | | | | |"
        )


def _queries(places: Places) -> Iterator[tuple[Path, Camera, Pose]]:
    dataset = read_dataset(places.dataset(SAMPLE, "query"))
    taken = [record for record in dataset.images if record.sensor_id == "left"]
    for record in taken[:QUERIES]:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        yield dataset.path_of(record), camera, pose


def _with_exif(source: Image.Image, path: Path, **tags: float) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", "Phone"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    for name, value in tags.items():
        details[ExifTags.Base[name]] = value
    source.save(path, exif=exif, quality=97, subsampling=0)


def exif(places: Places, scratch: Path) -> Iterator[Row]:
    """EXIF's focal length in whole millimetres, and none."""
    localizer = open_map(SAMPLE, places.maps).localizer
    for millimetres in (None, 24, 25, 26):
        row = Row("no EXIF" if millimetres is None else f"EXIF {millimetres} mm")
        for source, _, truth in _queries(places):
            tags = {} if millimetres is None else {"FocalLengthIn35mmFilm": millimetres}
            _with_exif(Image.open(source), scratch / "photo.jpg", **tags)
            row.ask(localizer, scratch / "photo.jpg", None, truth)
        yield row


def zoom(places: Places, scratch: Path) -> Iterator[Row]:
    """Twofold digital zoom, which EXIF's focal length contains or not."""
    localizer = open_map(SAMPLE, places.maps).localizer
    for millimetres in (25, 50):
        row = Row(f"digital zoom of 2, EXIF {millimetres} mm")
        for source, camera, truth in _queries(places):
            w, h = camera.width, camera.height
            photo = Image.open(source)
            middle = photo.crop((w // 4, h // 4, 3 * w // 4, 3 * h // 4)).resize((w, h))
            tags = {"FocalLengthIn35mmFilm": millimetres, "DigitalZoomRatio": 2.0}
            _with_exif(middle, scratch / "photo.jpg", **tags)
            row.ask(localizer, scratch / "photo.jpg", None, truth)
        yield row


def _changed(camera: Camera, zoom: float = 1.0, shift: float = 0.0) -> Camera:
    fx, fy, cx, cy = camera.params
    return replace(camera, params=(zoom * fx, zoom * fy, cx + shift, cy + shift))


def _with_k1(camera: Camera, k1: float) -> Camera:
    params = (*camera.params, k1, 0.0, 0.0, 0.0)
    return Camera("OPENCV", camera.width, camera.height, params)


def _distorted(rgb: NDArray[np.uint8], camera: Camera, k1: float) -> NDArray[np.uint8]:
    """Return the pixels of a lens with a distortion."""
    fx, fy, cx, cy = camera.params
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], 1).reshape(-1, 1, 2)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rays = cv2.undistortPoints(pixels, matrix, np.array([k1, 0.0, 0.0, 0.0])).reshape(-1, 2)
    where = (rays * (fx, fy) + (cx - 0.5, cy - 0.5)).astype(np.float32)
    where = where.reshape(camera.height, camera.width, 2)
    found = cv2.remap(
        rgb, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(found, np.uint8)


def _sent(
    rgb: NDArray[np.uint8], camera: Camera, *, zoom: float = 1.0, shift: float = 0.0
) -> tuple[NDArray[np.uint8], Camera]:
    return rgb, _changed(camera, zoom, shift)


CHANGES: dict[str, Make] = {
    "right": _sent,
    **{
        f"focal length {100 * (zoom - 1):+.0f} %": partial(_sent, zoom=zoom)
        for zoom in (0.99, 1.01, 0.98, 1.02, 0.96, 1.04)
    },
    **{f"principal point {px} px": partial(_sent, shift=px) for px in (3, 6, 12)},
    "k1 -0.05 sent for rectified": lambda rgb, c: (rgb, _with_k1(c, -0.05)),
    "k1 -0.05 forgotten": lambda rgb, c: (_distorted(rgb, c, -0.05), c),
}


def given(places: Places, scratch: Path) -> Iterator[Row]:
    """Cameras that the caller sends, not quite those of the pixels."""
    localizer = open_map(SAMPLE, places.maps).localizer
    for name, make in CHANGES.items():
        row = Row(name)
        for source, camera, truth in _queries(places):
            rgb, sent = make(read_photo_file(source).rgb, camera)
            Image.fromarray(rgb).save(scratch / "photo.png")
            row.ask(localizer, scratch / "photo.png", sent, truth)
        yield row


def sequence(places: Places, _: Path) -> Iterator[Row]:
    """A focal length so little off that one photo hardly tells: photos alone, and as a sequence."""
    localizer = open_map(SAMPLE, places.maps).localizer
    for zoom_by in (1.0, 1.003, 1.005):
        name = f"focal length {100 * (zoom_by - 1):+.1f} %"
        solver = MapSequenceSolver(
            localizer.geometry,
            metric=True,
            options=LocalizeOptions(),
            time_unit=TimeUnit.S,
            max_gap_s=0.0,
        )
        alone, answers = Row(f"{name}, alone"), []
        together = Row(f"{name}, in a sequence")
        for second, (source, camera, truth) in enumerate(_queries(places)):
            sent = _changed(camera, zoom_by)
            alone.ask(localizer, source, sent, truth)
            look = localizer.look(read_photo_file(source), sent, LocalizeOptions())
            seen = SeenInstant(second, (SeenImage.alone(look),), None, NO_PRIORS)
            answers += solver.add(seen)
        for answer, query in zip(answers + solver.finish(), _queries(places), strict=True):
            together.asked += 1
            if answer.pose is not None:
                together.add(answer.pose.rig_from_world, answer.pose.covariance, query[2])
        yield from (alone, together)


# Degrees per second to the right, metres per second to the right and ahead.
MOTIONS = {
    "still": (0, 0, 0),
    "walking aside, 1.4 m/s": (0, 1.4, 0),
    "turning, 30 degrees/s": (30, 0, 0),
    "turning, 90 degrees/s": (90, 0, 0),
    "ahead, 5 m/s": (0, 0, 5),
}


def shutter(places: Places, scratch: Path) -> Iterator[Row]:
    """Rows that are read while the camera moves."""
    localizer, room = open_map(SAMPLE, places.maps).localizer, make_room(0)
    for name, (turn, aside, ahead) in MOTIONS.items():
        row = Row(f"20 ms, {name}")
        for _, camera, truth in _queries(places):
            rgb, height = np.zeros((camera.height, camera.width, 3), np.uint8), camera.height
            for band in range(BANDS):
                seconds = ((band + 0.5) / BANDS - 0.5) * ROWS_MS / 1000
                angle = np.radians(turn * seconds)
                cos, sin = np.cos(angle), np.sin(angle)
                turned = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]) @ truth.rotation
                center = truth.center + seconds * truth.rotation.T @ (aside, 0.0, ahead)
                rows = slice(band * height // BANDS, (band + 1) * height // BANDS)
                rgb[rows] = render_photo(room, camera, Pose(turned, -turned @ center))[rows]
            Image.fromarray(rgb).save(scratch / "photo.png")
            row.ask(localizer, scratch / "photo.png", camera, truth)
        yield row


def exact(places: Places, _: Path) -> Iterator[Row]:
    """Right cameras."""
    for name in EXACT:
        localizer, row = open_map(name, places.maps).localizer, Row(name)
        dataset = read_dataset(places.dataset(name, "query"))
        if name == "virtual_gallery":
            dataset = dataset.with_pixels_from(PixelOrigin.CENTER)
        for record in dataset.images:
            camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
            if pose is not None:
                row.ask(localizer, dataset.path_of(record), camera, pose)
        yield row


TABLES: dict[str, Callable[[Places, Path], Iterator[Row]]] = {
    "exif": exif,
    "given": given,
    "shutter": shutter,
    "zoom": zoom,
    "sequence": sequence,
    "exact": exact,
}


def _photos_alone(name: str, places: Places) -> tuple[list[Path], dict[str, Pose]]:
    """Return the photos of a set, and the poses known of them by file name."""
    if name == "lund_door":
        model = read_model("colmap", places.data / "import_samples" / "lund_door")
        assert model.photos is not None
        poses = {Path(i.name).name: p for i in model.images if (p := i.cam_from_world) is not None}
        return [model.photos / image.name for image in model.images], poses
    dataset = read_dataset(places.dataset(name, "mapping"))
    records: Sequence[FileRecord] = dataset.images
    return [dataset.path_of(r) for r in records], _poses(dataset)


def _poses(dataset: Dataset) -> dict[str, Pose]:
    """Return the poses of a dataset's photos by the ends of their paths."""
    found = {}
    for record in dataset.images:
        pose = dataset.pose(record)
        if pose is not None:
            found[record.path.replace("/", "_")] = pose
    return found


def _map_of_photos(name: str, folder: Path, maps: Path) -> LocalMap:
    """Build a map of photos alone."""
    dataset = folder.parent / "dataset"
    write_imported(read_model("images", folder), dataset)
    sfm = SfmSettings(poses="estimate", refine=("intrinsics",))
    settings = BuildSettings(dataset, name, maps_dir=maps, method="sfm", sfm=sfm, workers=2)
    build_map(replace(settings, accept=True), lambda *_: None)
    return open_map(name, maps)


def _known_poses(opened: Map, truth: dict[str, Pose]) -> tuple[dict[str, Pose], Similarity, float]:
    """Return a map's poses by name, the similarity to the truth, and the spread of the photos."""
    in_map = {
        Path(image.name).name: Pose.from_quaternion(row[:4], row[4:])
        for image, row in zip(opened.images, opened.image_poses, strict=True)
    }
    both = [each for each in in_map if each in truth]
    to_truth = align_poses([in_map[each] for each in both], [truth[each] for each in both])
    centers = np.array([truth[each].center for each in both])
    spread = float(np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max())
    return in_map, to_truth, spread


def held_out(places: Places, scratch: Path) -> Iterator[str]:
    """Build maps without every fifth photo, and ask for that."""
    yield "| photos | placed | without intrinsics | with the map's camera |\n|---|---|---|---|"
    for name in HELD_OUT:
        photos, truth = _photos_alone(name, places)
        names = [str(path).rsplit("records_data/", 1)[-1].replace("/", "_") for path in photos]
        if name == "lund_door":
            names = [path.name for path in photos]
        folder = scratch / name / "photos"
        folder.mkdir(parents=True)
        for number, (path, new) in enumerate(zip(photos, names, strict=True)):
            if number % 5:
                shutil.copy(path, folder / new)
        opened = _map_of_photos(name, folder, scratch / name / "maps")
        in_map, to_truth, spread = _known_poses(opened.archive, truth)
        camera = next(iter(opened.archive.cameras.values()))
        localizer, told = opened.localizer, []
        for sent in (None, camera):
            counts: Counter[str] = Counter()
            for path, new in list(zip(photos, names, strict=True))[::5]:
                if new in truth:
                    counts[_rightness(localizer, path, sent, truth[new], to_truth, spread)] += 1
            told.append(", ".join(f"{count} {what}" for what, count in counts.items()))
        yield f"| {name} | {len(in_map)} of {len(list(folder.iterdir()))} | {told[0]} | {told[1]} |"


def zoomed_maps(places: Places, scratch: Path) -> Iterator[str]:
    """Build maps of photos alone, of which every tenth has digital zoom."""
    yield "| EXIF contains the zoom | photos | placed | with zoom | wrong |\n|---|---|---|---|---|"
    dataset = read_dataset(places.dataset(SAMPLE, "mapping"))
    truth = _poses(dataset)
    for millimetres, count in ((25, 20), (25, 40), (40, 20), (40, 40)):
        name = f"zoomed-{millimetres}-{count}"
        folder = scratch / name / "photos"
        folder.mkdir(parents=True)
        zoomed = set()
        evenly = np.linspace(0, len(dataset.images) - 1, count).round().astype(int)
        taken = [dataset.images[row] for row in evenly]
        for number, record in enumerate(taken):
            photo: Image.Image = Image.open(dataset.path_of(record))
            new = record.path.replace("/", "_")
            tags: dict[str, float] = {"FocalLengthIn35mmFilm": 25}
            if number % 10 == 5:
                zoomed.add(new)
                w, h = photo.size
                inset = (w - w / ZOOM) / 2, (h - h / ZOOM) / 2
                photo = photo.resize((w, h), box=(*inset, w - inset[0], h - inset[1]))
                tags = {"FocalLengthIn35mmFilm": millimetres, "DigitalZoomRatio": ZOOM}
            _with_exif(photo, folder / new, **tags)
        in_map, to_truth, spread = _known_poses(
            _map_of_photos(name, folder, scratch).archive, truth
        )
        wrong = sum(
            not _is_right(to_truth.move(pose), truth[each], spread) for each, pose in in_map.items()
        )
        contains = "yes" if millimetres == 40 else "no"
        placed = sum(each in zoomed for each in in_map)
        yield f"| {contains} | {count} | {len(in_map)} | {placed} of {len(zoomed)} | {wrong} |"


def _is_right(found: Pose, truth: Pose, spread: float) -> bool:
    off = float(np.linalg.norm(found.center - truth.center)) / spread
    turned = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return bool(off <= RIGHT_SHARE and turned <= RIGHT_DEG)


def _rightness(
    localizer: Localizer,
    path: Path,
    sent: Camera | None,
    truth: Pose,
    to_truth: Similarity,
    spread: float,
) -> str:
    answer = localizer.localize(read_photo_file(path), sent, LocalizeOptions())
    if not isinstance(answer, Localized):
        return "refused"
    there = to_truth.move(answer.cam_from_world)
    off = float(np.linalg.norm(there.center - truth.center)) / spread
    return "right" if _is_right(there, truth, spread) else f"wrong by {off:.1%}"


MAPS: dict[str, Callable[[Places, Path], Iterator[str]]] = {
    "held-out": held_out,
    "zoomed-maps": zoomed_maps,
}


def main(
    tables: Annotated[list[str], typer.Argument(help=f"Of {', '.join([*TABLES, *MAPS])}.")],
    data: Annotated[Path, typer.Option(help="The shared data sets.")] = Path("../shared/data"),
    maps: Annotated[Path, typer.Option(help="A store of maps.")] = Path(".trust/maps"),
) -> None:
    """Ask, and print tables in Markdown."""
    places = Places(data, maps)
    needed = set(EXACT) if "exact" in tables else {SAMPLE}
    make_missing(places, needed, lambda line: typer.echo(line, err=True))
    with TemporaryDirectory() as scratch:
        for table in tables:
            if table in MAPS:
                for line in MAPS[table](places, Path(scratch)):
                    typer.echo(line)
                continue
            typer.echo(
                "\n| queries | camera | answered | median error, cm | largest | error / stated "
                "deviation | truths inside 95 % |\n|---|---|---|---|---|---|---|"
            )
            for row in TABLES[table](places, Path(scratch)):
                row.print()


if __name__ == "__main__":
    typer.run(main)
