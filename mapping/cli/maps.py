"""Commands about a map: its place on Earth, upgrades, other formats, contents and checks."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import ERR, print_georeference, print_map, say, say_notes, summary_of
from mapping.cli.progress import StageProgress
from mapping.cluster.storage import is_map_folder, map_folder
from mapping.frames.georeference import (
    Georeference,
    correspondences_from_fixes,
    georeference,
    given_place,
    publish_anchored,
    read_correspondences,
)
from mapping.frames.kept_fixes import contradiction_of_fixes
from mapping.frames.known_length import known_length
from mapping.maps.export import EXPORTERS, Queries, export_map
from mapping.maps.packing import write_packed
from mapping.maps.sizing import publish_sized
from mapping.maps.upgrading import lacking, upgrade_map
from mapping.options import AcceptOption, Gravity, MapArgument, MapsDirOption, WeightsDirOption
from mapping.progress import one_step
from mapping.stages.imported_points import read_imported_points
from visloc.archive import Anchor, Map, SetManifest, open_map, verify_map
from visloc.archive.checks import read_any_manifest
from visloc.archive.kinds import kind_of_sets
from visloc.errors import refuse
from visloc.features import make_global_descriptor, make_local_features
from visloc.features.local.readymade import is_ready_made
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer


@dataclass(frozen=True, slots=True)
class AnchorSettings:
    """The options of ``mapping anchor``."""

    map_ref: MapArgument
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            help="kapture folder with GNSS fixes (records_gnss.txt) of the map's photos.",
        ),
    ] = None
    correspondences: Annotated[
        Path | None,
        typer.Option(
            help="Or a CSV file of points (x,y,z,latitude,longitude,altitude) or of photos "
            "(image,latitude,longitude,altitude). Its first line names the columns."
        ),
    ] = None
    latitude: Annotated[
        float | None,
        typer.Option(
            help="Or the place itself: latitude of the world's (0, 0, 0), degrees (WGS84).",
            min=-90,
            max=90,
        ),
    ] = None
    longitude: Annotated[
        float | None, typer.Option(help="With --latitude: degrees.", min=-180, max=180)
    ] = None
    altitude: Annotated[
        float | None,
        typer.Option(help="With --latitude: metres above the ellipsoid, not above sea level."),
    ] = None
    yaw: Annotated[
        float | None,
        typer.Option(
            help="With --latitude: direction of the world's x axis on the ground, degrees. 0: "
            "east, 90: north."
        ),
    ] = None
    accuracy: Annotated[
        float | None,
        typer.Option(
            help="With --latitude: RMS error of the place, metres. Default: unknown, and /geopose "
            "says so.",
            min=0,
        ),
    ] = None
    scale: Annotated[
        float | None,
        typer.Option(help="With --latitude, for a map that is not metric: metres per unit."),
    ] = None
    gravity: Annotated[
        Gravity,
        typer.Option(
            metavar="X,Y,Z",
            help="With --latitude, for a map without known gravity: vector that points down in "
            "its frame.",
        ),
    ] = None

    def located(self, opened: Map) -> Georeference:
        """Return where the map lies on Earth."""
        place = (self.latitude, self.longitude, self.altitude, self.yaw)
        has_place = any(value is not None for value in place)
        details = any(one is not None for one in (self.accuracy, self.scale, self.gravity))
        ways = (self.dataset is not None, self.correspondences is not None, has_place)
        if sum(ways) != 1 or (has_place and None in place) or (details and not has_place):
            raise refuse("anchor.source")
        if self.dataset is not None:
            fixes = correspondences_from_fixes(opened, read_dataset(self.dataset))
            return georeference(opened, fixes)
        if self.correspondences is not None:
            return georeference(opened, read_correspondences(opened, self.correspondences))
        latitude, longitude, altitude, yaw = (value for value in place if value is not None)
        return given_place(
            opened,
            (latitude, longitude, altitude),
            yaw,
            accuracy=self.accuracy,
            scale=self.scale,
            gravity=self.gravity,
        )


def anchor(
    settings: AnchorSettings,
    maps_dir: MapsDirOption = Path("maps"),
    force: Annotated[
        bool, typer.Option("--force", help="Publish a new version of a map that is anchored.")
    ] = False,
) -> None:
    """Tie a map to the Earth, so that answers have GeoPoses; publish it as a new version.

    Poses of photos and landmarks in the map's frame do not change.
    """
    opened = open_map(map_folder(settings.map_ref, maps_dir))
    found = settings.located(opened)
    print_georeference(found)
    _say_contradiction(opened, found.anchor)
    folder = publish_anchored(opened, found, maps_dir, force=force)
    say(f"map {open_map(folder).ref}")


def edit(
    map_ref: MapArgument,
    scale: Annotated[
        tuple[str, str, str],
        typer.Option(
            metavar="PHOTO PHOTO LENGTH",
            help="Distance between where two photos of the map were taken, such as a.jpg b.jpg "
            "3.2m. GET /maps/MAP/images, and mapping export, name its photos.",
        ),
    ],
    maps_dir: MapsDirOption = Path("maps"),
    force: Annotated[
        bool, typer.Option("--force", help="Measure a map anew that is in metres already.")
    ] = False,
    accept: AcceptOption = False,
) -> None:
    """Give a map its size by a known length; publish it in metres, as a new version.

    Poses and landmarks are scaled about the world's (0, 0, 0); directions stay.
    """
    opened, length = open_map(map_folder(map_ref, maps_dir)), known_length(scale)
    with StageProgress(ERR, if_stopped="nothing was published") as progress:
        sized = publish_sized(
            opened, length, maps_dir, force=force, accept=accept, progress=progress
        )
    print_map(sized)
    require_acceptance(sized, accept=accept, pictures=maps_dir / ".work" / ".doubts")


def upgrade(map_ref: MapArgument, maps_dir: MapsDirOption = Path("maps")) -> None:
    """Add to a map of an older format what needs no photos; publish it as a new version.

    The map is tested with what it stores of its own photos, so that answers state their whole
    uncertainty. A map of very many photos gets an index.
    """
    opened = open_map(map_folder(map_ref, maps_dir))
    with _step("upgrade"):
        folder = upgrade_map(opened, maps_dir)
    upgraded = open_map(folder)
    added = ["own test"] * (opened.manifest.parts.own_test is None)
    added += ["index"] * (upgraded.has_index and not opened.has_index)
    say(f"map {upgraded.ref}: {' and '.join(added)} added")
    say_notes(lacking(upgraded))


def export(
    map_ref: MapArgument,
    output: Annotated[
        Path, typer.Option("--output", help="File or folder to write; it must not exist.")
    ],
    format_name: Annotated[
        str, typer.Option("--format", help=f"One of {', '.join(EXPORTERS)}.")
    ] = "colmap",
    queries: Annotated[
        Path | None,
        typer.Option(
            metavar="DATASET",
            help="For colmap: photos to match with the map and to add to database.db, for COLMAP's "
            "image_registrator.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
    weights_dir: WeightsDirOption = None,
) -> None:
    """Write a map for other tools: a COLMAP model, a kapture dataset, or a PLY point cloud."""
    opened = open_map(map_folder(map_ref, maps_dir))
    added = None
    if queries is not None:
        extractor = make_local_features(
            opened.manifest.local_features.fingerprint.name, weights_dir
        )
        localizer = Localizer(
            opened, extractor, partial(make_global_descriptor, weights_dir=weights_dir)
        )
        added = Queries(read_dataset(queries), localizer)
    with _step("export"):
        notes = export_map(opened, output, format_name, added)
    say(f"{format_name}: {output}")
    say_notes(notes)


def pack(
    map_ref: MapArgument,
    output: Annotated[Path, typer.Option("--output", help="File to write, such as room.zip.")],
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Pack a map into one file, for localize maps push. Every byte is checked first."""
    folder = map_folder(map_ref, maps_dir)
    with _step("pack"):
        manifest = write_packed(folder, output)
    size = output.stat().st_size / 2**20
    say(f"{manifest.id}@{manifest.version}: {output}, {size:.1f} MiB")


def inspect(
    map_ref: MapArgument,
    maps_dir: MapsDirOption = Path("maps"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Show the contents of a map or a set."""
    folder = map_folder(map_ref, maps_dir)
    if isinstance(read_any_manifest(folder), SetManifest):
        summary, show = kind_of_sets(map_ref).shown(folder)
    else:
        opened = open_map(folder)
        summary, show = summary_of(opened), partial(print_map, opened)
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2) + "\n")
    else:
        show()


def verify(
    map_ref: MapArgument,
    maps_dir: MapsDirOption = Path("maps"),
    weights_dir: WeightsDirOption = None,
) -> None:
    """Check every byte of a map (checksums, ranges), and its features against the installed ones.

    For a set, only its own files are checked; verify its tiles one by one.
    """
    folder = map_folder(map_ref, maps_dir)
    if isinstance(read_any_manifest(folder), SetManifest):
        kind_of_sets(map_ref).check(folder, None if is_map_folder(map_ref) else maps_dir)
        return
    with _step("verify", if_stopped="nothing was changed"):
        opened = verify_map(folder)
        read_imported_points(opened)  # raises when they are damaged
    say(f"{opened.ref}: {len(opened.manifest.files)} files, every byte as published")
    name = opened.manifest.local_features.fingerprint.name
    extractor = None if is_ready_made(name) else make_local_features(name, weights_dir)
    make_descriptor = partial(make_global_descriptor, weights_dir=weights_dir)
    Localizer(opened, extractor, make_descriptor)  # raises when they differ
    names = (name, *(record.fingerprint.name for record in opened.manifest.global_features))
    say(f"{', '.join(names)}: the same features as here")
    if opened.manifest.world.anchor is not None:
        _say_contradiction(opened, opened.manifest.world.anchor)


def _say_contradiction(opened: Map, anchor: Anchor) -> None:
    contradiction = contradiction_of_fixes(opened, anchor)
    if contradiction is not None:
        say_notes([contradiction])


@contextmanager
def _step(stage: str, if_stopped: str = "nothing was written") -> Iterator[None]:
    with StageProgress(ERR, if_stopped=if_stopped) as progress, one_step(progress, stage):
        yield
