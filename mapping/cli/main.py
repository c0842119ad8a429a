"""The ``mapping`` command."""

from __future__ import annotations

import json
import signal
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from mapping.build.build import METHODS, BuildSettings, build_map, write_pairs_of
from mapping.cli.display import (
    peak_memory_bytes,
    print_costs,
    print_georeference,
    print_import,
    print_map,
    print_rig,
    summary_of,
)
from mapping.cli.merge import merge
from mapping.cli.options import (
    CLUSTER_PANEL,
    GLOBAL_DEFAULT,
    RGBD_PANEL,
    SFM_PANEL,
    BuildLocalFeaturesOption,
    CovisibleInOption,
    DatasetArgument,
    DepthScaleOption,
    DepthSensorOption,
    FarOption,
    FeaturesDirOption,
    FusionOption,
    FusionWeightsOption,
    GlobalFeaturesOption,
    InferenceOption,
    LocalFeaturesOption,
    MapArgument,
    MapsDirOption,
    MaxAngleOption,
    MaxDistanceOption,
    MaxKeypointsOption,
    MetricOption,
    NearOption,
    PairsOption,
    PixelOriginOption,
    TopKOption,
    WeightsDirOption,
    WorkersOption,
    is_map_folder,
    map_folder,
)
from mapping.cli.progress import StageProgress, one_step
from mapping.cli.prune import prune
from mapping.cli.report import report
from mapping.cli.sets import print_set, set_maps, set_summary, split, verify_tiles
from mapping.cli.update import update
from mapping.cluster.executors import EXECUTORS
from mapping.cluster.stage_timings import Costs
from mapping.cluster.storage import open_store, place_of
from mapping.cluster.workers import DEFAULT_WORKERS
from mapping.frames.georeference import (
    correspondences_from_fixes,
    georeference,
    given_place,
    publish_anchored,
    read_correspondences,
)
from mapping.frames.rig_calibration import calibrate_rig, refuse_known_rigs, write_calibration
from mapping.importers import IMPORTERS, ImportSummary, import_dataset, imported
from mapping.maps.export import EXPORTERS, export_map
from mapping.maps.export_features import export_features
from mapping.maps.packing import write_packed
from mapping.methods.imported_points import read_imported_points
from mapping.methods.pairing import PairSettings
from mapping.methods.rgbd import DepthSettings
from mapping.methods.sfm import SfmSettings
from mapping.methods.triangulation import MAPPER_CONFIGS, REFINABLE
from mapping.sample import write_sample
from visloc.archive import SetManifest, open_map, open_set, verify_map, verify_set
from visloc.archive.checks import read_any_manifest
from visloc.errors import VislocError, refuse
from visloc.features import (
    DEFAULT_LOCAL_FEATURES,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.readymade import is_ready_made
from visloc.geometry import PixelOrigin
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.retrieval.fusion import LateFusion
from visloc.types import Fusion, Inference

app = typer.Typer(
    name="mapping",
    help="Build, inspect and check maps for the localization service.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
_out = Console()
_err = Console(stderr=True)
_DEPTH_DEFAULTS, _SFM_DEFAULTS, _PAIR_DEFAULTS = DepthSettings(), SfmSettings(), PairSettings()


@app.command()
def build(
    dataset: Annotated[
        str, typer.Argument(help="kapture folder (holds sensors/), or the URL of one.")
    ],
    map_id: Annotated[str, typer.Option("--map", help="Id of the map.")],
    maps_dir: Annotated[
        str,
        typer.Option(
            "--maps-dir", envvar="VISLOC_MAPS_DIR", help="Folder of maps, or the URL of one."
        ),
    ] = "maps",
    method: Annotated[
        str,
        typer.Option(
            help="Where landmarks come from. rgbd: depth maps. sfm: matches, triangulated. "
            "model: points that the dataset brings along."
        ),
    ] = METHODS[0],
    local_features: BuildLocalFeaturesOption = DEFAULT_LOCAL_FEATURES,
    global_features: GlobalFeaturesOption = GLOBAL_DEFAULT,
    fusion: FusionOption = Fusion.GHARM,
    fusion_weights: FusionWeightsOption = None,
    features_dir: FeaturesDirOption = None,
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER,
    weights_dir: WeightsDirOption = None,
    inference: InferenceOption = Inference.AUTO,
    max_keypoints: MaxKeypointsOption = 5000,
    metric: MetricOption = None,
    gravity: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="What points down in the map's world, at any length, such as 0,0,-1 where z is "
            "up. A map anchored to GNSS knows it.",
        ),
    ] = None,
    keep_photos: Annotated[
        bool,
        typer.Option(
            "--keep-photos",
            help="Keep a small picture of each photo in the map (at most 640 pixels), for "
            "localize --debug. Left out, nobody can see the photos in the map.",
        ),
    ] = False,
    keep_colours: Annotated[
        bool,
        typer.Option(
            "--keep-colours",
            help="Keep the colours of the landmarks in the map, as the photos have them, for the "
            "page and the report. A coloured cloud shows what the place looks like. Those that a "
            "model brings along are kept anyway.",
        ),
    ] = False,
    workers: WorkersOption = DEFAULT_WORKERS,
    executor: Annotated[
        str,
        typer.Option(
            help="Where they are. local: processes of this machine. ray: a Ray cluster.",
            rich_help_panel=CLUSTER_PANEL,
        ),
    ] = EXECUTORS[0],
    ray_address: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Of the cluster: HOST:PORT, ray://HOST:PORT, auto for the one of RAY_ADDRESS or "
            "of this machine, or local for one of this machine that ends with the build.",
            rich_help_panel=CLUSTER_PANEL,
        ),
    ] = "auto",
    work_dir: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER|URL",
            help="Where finished work is kept until the map is published, the same for all "
            "machines, in .work/MAP of it; left out: --maps-dir.",
            rich_help_panel=CLUSTER_PANEL,
        ),
    ] = None,
    cache_dir: Annotated[
        Path,
        typer.Option(
            envvar="VISLOC_CACHE_DIR",
            help="With a URL of maps: folder of the copy that stays here.",
            rich_help_panel=CLUSTER_PANEL,
        ),
    ] = Path("maps-cache"),
    force: Annotated[
        bool, typer.Option("--force", help="Publish a new version of a map that exists.")
    ] = False,
    voxel_size: Annotated[
        float,
        typer.Option(
            help="Points of one such cell become one landmark, metres.", rich_help_panel=RGBD_PANEL
        ),
    ] = _DEPTH_DEFAULTS.voxel_size,
    depth_sensor: DepthSensorOption = None,
    depth_scale: DepthScaleOption = _DEPTH_DEFAULTS.depth_scale,
    pairs: PairsOption = _SFM_DEFAULTS.pairs[0],
    top_k: TopKOption = _PAIR_DEFAULTS.top_k,
    max_distance: MaxDistanceOption = _PAIR_DEFAULTS.max_distance,
    max_angle: MaxAngleOption = _PAIR_DEFAULTS.max_angle_deg,
    near: NearOption = _PAIR_DEFAULTS.near,
    far: FarOption = _PAIR_DEFAULTS.far,
    covisible_in: CovisibleInOption = None,
    pairs_file: Annotated[
        Path | None,
        typer.Option(
            help="Pairs to match instead of --pairs, such as pairs.txt of a map.",
            rich_help_panel=SFM_PANEL,
        ),
    ] = None,
    mapper: Annotated[
        str,
        typer.Option(
            help=f"Thresholds of the paper: {' or '.join(MAPPER_CONFIGS)} (relaxed).",
            rich_help_panel=SFM_PANEL,
        ),
    ] = _SFM_DEFAULTS.mapper,
    refine: Annotated[
        str,
        typer.Option(
            help="What bundle adjustment may change after triangulation: comma-separated, of "
            f"{', '.join(REFINABLE)}.",
            rich_help_panel=SFM_PANEL,
        ),
    ] = "",
    poses: Annotated[
        str,
        typer.Option(
            help="given: the dataset's. estimate: find them too; poses or GNSS of some photos "
            "then say where the map lies.",
            rich_help_panel=SFM_PANEL,
        ),
    ] = "given",
) -> None:
    """Turn a dataset into a map.

    Killed at any moment, the same command resumes; the map in use stays until the new one is
    complete.
    """
    if poses not in ("given", "estimate"):
        raise refuse(
            "build.poses",
            "the value is unknown",
            field="--poses",
            expected="given or estimate",
            got=poses,
        )
    maps = place_of(maps_dir, "--maps-dir")
    settings = BuildSettings(
        dataset=place_of(dataset, "dataset"),
        map_id=map_id,
        maps_dir=maps,
        method=method,
        local_features=local_features,
        global_features=_names(global_features),
        fusion=LateFusion(
            fusion, None if fusion_weights is None else _parse_weights(fusion_weights)
        ),
        features_dir=features_dir,
        pixel_origin=pixel_origin,
        weights_dir=weights_dir,
        inference=inference,
        max_keypoints=max_keypoints,
        metric=metric,
        depth=DepthSettings(voxel_size=voxel_size, depth_scale=depth_scale),
        depth_sensor=depth_sensor,
        sfm=SfmSettings(
            pairs=_names(pairs),
            pairing=PairSettings(
                top_k=top_k, max_distance=max_distance, max_angle_deg=max_angle, near=near, far=far
            ),
            pairs_file=pairs_file,
            covisible_in=None
            if covisible_in is None
            else open_map(_map_folder(covisible_in, maps, cache_dir)),
            mapper=mapper,
            refine=_names(refine),
            estimate_poses=poses == "estimate",
        ),
        gravity=None if gravity is None else _parse_vector("--gravity", gravity),
        keep_photos=keep_photos,
        keep_colours=keep_colours,
        workers=workers,
        executor=executor,
        ray_address=ray_address,
        work_dir=None if work_dir is None else place_of(work_dir, "--work-dir"),
        cache_dir=cache_dir,
        force=force,
    )
    _build(settings)


@app.command()
def pairs(
    dataset: DatasetArgument,
    output: Annotated[Path, typer.Option("--output", help="The pairs file to write.")],
    pairs: PairsOption = "distance",
    top_k: TopKOption = _PAIR_DEFAULTS.top_k,
    max_distance: MaxDistanceOption = _PAIR_DEFAULTS.max_distance,
    max_angle: MaxAngleOption = _PAIR_DEFAULTS.max_angle_deg,
    near: NearOption = _PAIR_DEFAULTS.near,
    far: FarOption = _PAIR_DEFAULTS.far,
    covisible_in: CovisibleInOption = None,
    global_features: Annotated[
        str, typer.Option(help="retrieval: comma-separated, kapture:TYPE of the dataset.")
    ] = "",
    features_dir: FeaturesDirOption = None,
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Pair the photos of a dataset without building, for build --pairs-file or other tools.

    Pairs by global features that are made of the photos come with a build: pairs.txt of its map.
    """
    pairing = PairSettings(
        top_k=top_k, max_distance=max_distance, max_angle_deg=max_angle, near=near, far=far
    )
    known = None if covisible_in is None else open_map(map_folder(covisible_in, maps_dir))
    with StageProgress(_err, if_stopped="nothing was written") as progress:
        count, notes = write_pairs_of(
            dataset,
            output,
            SfmSettings(pairs=_names(pairs), pairing=pairing, covisible_in=known),
            _names(global_features),
            features_dir,
            pixel_origin,
            progress,
        )
    _out.print(f"{count} pairs: {output}", highlight=False, soft_wrap=True)
    for note in notes:
        _out.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
    _out.print(f"peak memory {peak_memory_bytes() / 2**30:.2f} GiB")


@app.command("calibrate-rig")
def calibrate_rig_command(
    dataset: DatasetArgument,
    rig: Annotated[str, typer.Option("--rig", metavar="ID", help="Id of the rig.")] = "rig",
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="SENSOR",
            help="The camera that is the frame of the rig; left out: the one that shares most "
            "instants with the others.",
        ),
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(help="Comma-separated cameras on the rig; left out: all of the dataset."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", help="The file to write; left out: the dataset's rigs.txt."),
    ] = None,
) -> None:
    """Estimate where cameras sit on a rig, from the poses of photos with equal timestamps.

    The file is kapture's rigs.txt; builds of the dataset then register the rig in their maps.
    """
    target = dataset / "sensors" / "rigs.txt" if output is None else output
    refuse_known_rigs(target)
    calibration = calibrate_rig(
        read_dataset(dataset),
        rig=rig,
        reference=reference,
        cameras=None if cameras is None else _names(cameras),
    )
    write_calibration(calibration, target)
    print_rig(_out, calibration)
    _out.print(f"rig: {target}", highlight=False, soft_wrap=True)


def _map_folder(ref: str, maps_dir: Path, cache_dir: Path) -> Path:
    return Path(ref) if is_map_folder(ref) else open_store(maps_dir, cache_dir).folder(ref)


def _build(settings: BuildSettings) -> None:
    costs = Costs()
    with StageProgress(_err) as progress:
        folder = build_map(settings, progress, costs)
    print_map(_out, open_map(folder))
    print_costs(_out, costs.table())
    _out.print(f"peak memory {peak_memory_bytes() / 2**30:.2f} GiB")


@app.command("import")
def import_command(
    format_name: Annotated[
        str, typer.Argument(metavar="FORMAT", help=f"One of {', '.join(IMPORTERS)}.")
    ],
    path: Annotated[Path, typer.Argument(help="The file or folder that the format consists of.")],
    map_id: Annotated[
        str | None, typer.Option("--map", help="Make this map of it straight away.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", help="Or only make this dataset, for build.")
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option(help="Folder that names of photos are relative to, when not the usual one."),
    ] = None,
    metric: Annotated[
        bool | None,
        typer.Option(
            "--metric/--not-metric",
            help="Whether a unit of its world is a metre; left out: what the format says.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
    local_features: BuildLocalFeaturesOption = DEFAULT_LOCAL_FEATURES,
    global_features: GlobalFeaturesOption = GLOBAL_DEFAULT,
    weights_dir: WeightsDirOption = None,
    max_keypoints: MaxKeypointsOption = 5000,
    workers: WorkersOption = DEFAULT_WORKERS,
    force: Annotated[
        bool, typer.Option("--force", help="Publish a new version of a map that exists.")
    ] = False,
) -> None:
    """Bring a reconstruction or photos of another tool here, as a dataset or as a map.

    A map is made of the points that came along (build --method model), else of depth (rgbd), else
    by matching (sfm): with the poses that came along or, without, with estimated ones. For other
    choices make a dataset first, and build from it.
    """
    if (map_id is None) == (output is None):
        raise refuse("import.target", field="--map")
    if output is not None:
        with StageProgress(_err, if_stopped="nothing was written") as progress:
            summary = import_dataset(format_name, path, output, photos, progress)
        print_import(_out, summary)
        method, sfm = _method_for(summary)
        options = ["--method", method]
        if sfm.estimate_poses:
            options += ["--poses", "estimate", "--refine", ",".join(sfm.refine)]
        else:  # a dataset cannot say so itself
            known = summary.metric if metric is None else metric
            options.append("--metric" if known else "--not-metric")
        _out.print(f"dataset: {output}", soft_wrap=True)
        _out.print(f"next: mapping build {output} --map ID {' '.join(options)}", soft_wrap=True)
        return
    assert map_id is not None
    with ExitStack() as stack:
        with StageProgress(_err, if_stopped="nothing was written") as progress:
            dataset, summary = stack.enter_context(
                imported(format_name, path, maps_dir, map_id, photos, progress)
            )
        print_import(_out, summary)
        method, sfm = _method_for(summary)
        _build(
            BuildSettings(
                dataset=dataset,
                map_id=map_id,
                maps_dir=maps_dir,
                method=method,
                local_features=local_features,
                global_features=_names(global_features),
                weights_dir=weights_dir,
                max_keypoints=max_keypoints,
                metric=summary.metric if metric is None else metric,
                sfm=sfm,
                workers=workers,
                force=force,
            )
        )


@app.command()
def anchor(
    map_ref: MapArgument,
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            help="A kapture folder with GNSS fixes (records_gnss.txt) of the map's photos.",
        ),
    ] = None,
    correspondences: Annotated[
        Path | None,
        typer.Option(
            help="Or a CSV file of points, x,y,z,latitude,longitude,altitude, or of photos, "
            "image,latitude,longitude,altitude; the first line names the columns."
        ),
    ] = None,
    latitude: Annotated[
        float | None,
        typer.Option(help="Or say it: degrees (WGS84) of the world's (0, 0, 0).", min=-90, max=90),
    ] = None,
    longitude: Annotated[
        float | None, typer.Option(help="With --latitude: degrees.", min=-180, max=180)
    ] = None,
    altitude: Annotated[
        float | None,
        typer.Option(help="With --latitude: metres above the ellipsoid, not above the sea."),
    ] = None,
    yaw: Annotated[
        float | None,
        typer.Option(
            help="With --latitude: where the world's x axis points on the ground; 0 is east, 90 "
            "north, degrees."
        ),
    ] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            help="With --latitude: how far off the map may be by it, metres (rms); left out, "
            "/geopose says that it does not know.",
            min=0,
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(help="With --latitude, for a map that is not metric: metres per unit."),
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="With --latitude, for a map that does not know it: what points down in its world.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
    force: Annotated[
        bool, typer.Option("--force", help="Publish a new version of a map that is anchored.")
    ] = False,
) -> None:
    """Tie a map to the Earth, so that answers carry GeoPoses. A new version is published.

    Its photos and landmarks stay where they are in its world.
    """
    said = (latitude, longitude, altitude, yaw)
    ways = (dataset is not None, correspondences is not None, any(v is not None for v in said))
    details = any(one is not None for one in (accuracy, scale, gravity))
    if sum(ways) != 1 or (ways[2] and None in said) or (details and not ways[2]):
        raise refuse("anchor.source")
    opened = open_map(map_folder(map_ref, maps_dir))
    if dataset is not None:
        found = georeference(opened, correspondences_from_fixes(opened, read_dataset(dataset)))
    elif correspondences is not None:
        found = georeference(opened, read_correspondences(opened, correspondences))
    else:
        assert latitude is not None
        assert longitude is not None
        assert altitude is not None
        assert yaw is not None
        down = None if gravity is None else _parse_vector("--gravity", gravity)
        position = (latitude, longitude, altitude)
        found = given_place(opened, position, yaw, accuracy=accuracy, scale=scale, gravity=down)
    print_georeference(_out, found)
    folder = publish_anchored(opened, found, maps_dir, force=force)
    _out.print(f"map {open_map(folder).ref}", highlight=False, soft_wrap=True)


@app.command()
def export(
    map_ref: MapArgument,
    output: Annotated[Path, typer.Option("--output", help="What to make; it must not exist.")],
    format_name: Annotated[
        str, typer.Option("--format", help=f"One of {', '.join(EXPORTERS)}.")
    ] = "colmap",
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Write a map for other tools: a COLMAP model, a kapture dataset, or a PLY point cloud."""
    opened = open_map(map_folder(map_ref, maps_dir))
    with (
        StageProgress(_err, if_stopped="nothing was written") as progress,
        one_step(progress, "export"),
    ):
        notes = export_map(opened, output, format_name)
    _out.print(f"{format_name}: {output}", soft_wrap=True)
    for note in notes:
        _out.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)


@app.command()
def pack(
    map_ref: MapArgument,
    output: Annotated[Path, typer.Option("--output", help="The file to make, such as room.zip.")],
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Write a map into one file, for localize maps push; every byte is checked first."""
    folder = map_folder(map_ref, maps_dir)
    with (
        StageProgress(_err, if_stopped="nothing was written") as progress,
        one_step(progress, "pack"),
    ):
        manifest = write_packed(folder, output)
    size = output.stat().st_size / 2**20
    _out.print(
        f"{manifest.id}@{manifest.version}: {output}, {size:.1f} MiB",
        highlight=False,
        soft_wrap=True,
    )


def _method_for(summary: ImportSummary) -> tuple[str, SfmSettings]:
    """How a map is best made of what an import brought."""
    if summary.observations:
        return "model", _SFM_DEFAULTS
    if summary.depth_maps:
        return "rgbd", _SFM_DEFAULTS
    if summary.posed:
        return "sfm", _SFM_DEFAULTS
    # What EXIF says of a focal length is a start, not a calibration.
    return "sfm", SfmSettings(estimate_poses=True, refine=("intrinsics",))


@app.command()
def inspect(
    map_ref: MapArgument,
    maps_dir: MapsDirOption = Path("maps"),
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Show what a map or a set holds."""
    folder = map_folder(map_ref, maps_dir)
    if isinstance(read_any_manifest(folder), SetManifest):
        tiles = open_set(folder)
        summary, show = set_summary(tiles), partial(print_set, _out, tiles)
    else:
        opened = open_map(folder)
        summary, show = summary_of(opened), partial(print_map, _out, opened)
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2) + "\n")
    else:
        show()


@app.command()
def verify(
    map_ref: MapArgument,
    maps_dir: MapsDirOption = Path("maps"),
    weights_dir: WeightsDirOption = None,
) -> None:
    """Read every byte of a map: checksums and ranges; then compare its features with ours.

    Of a set, its own files; its tiles are maps of their own.
    """
    folder = map_folder(map_ref, maps_dir)
    if isinstance(read_any_manifest(folder), SetManifest):
        verify_tiles(_out, verify_set(folder), None if is_map_folder(map_ref) else maps_dir)
        return
    with (
        StageProgress(_err, if_stopped="nothing was changed") as progress,
        one_step(progress, "verify"),
    ):
        opened = verify_map(folder)
        read_imported_points(opened)  # raises when they are damaged
    num_files = len(opened.manifest.files)
    _out.print(f"{opened.ref}: {num_files} files, every byte as published", soft_wrap=True)
    name = opened.manifest.local_features.fingerprint.name
    extractor = None if is_ready_made(name) else make_local_features(name, weights_dir)
    make_descriptor = partial(make_global_descriptor, weights_dir=weights_dir)
    Localizer(opened, extractor, make_descriptor)  # raises when they differ
    names = (name, *(record.fingerprint.name for record in opened.manifest.global_features))
    _out.print(f"{', '.join(names)}: the same features as here", soft_wrap=True)


app.command()(report)
app.command()(prune)
app.command()(merge)
app.command("set")(set_maps)
app.command()(split)
app.command()(update)


@app.command("export-features")
def export_features_command(
    dataset: DatasetArgument,
    output: Annotated[Path, typer.Option("--output", help="Folder of the new kapture.")],
    local_features: LocalFeaturesOption = DEFAULT_LOCAL_FEATURES,
    weights_dir: WeightsDirOption = None,
    inference: InferenceOption = Inference.AUTO,
    max_keypoints: MaxKeypointsOption = 5000,
    map_ref: Annotated[
        str | None,
        typer.Option("--map", help="Export this map's global descriptors of the photos too."),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Write our features of a dataset in kapture's layout, for other tools."""
    opened = None if map_ref is None else open_map(map_folder(map_ref, maps_dir))
    with StageProgress(_err) as progress:
        absent = export_features(
            dataset,
            output,
            local_features=local_features,
            weights_dir=weights_dir,
            inference=inference,
            max_keypoints=max_keypoints,
            global_from=opened,
            progress=progress,
        )
    for name in absent:
        _err.print(f"absent, without features: {name}", markup=False, soft_wrap=True)
    _out.print(f"kapture with features: {output}", soft_wrap=True)


@app.command()
def sample(
    output: Annotated[Path, typer.Argument(help="Folder to make; holds mapping/ and query/.")],
    images: Annotated[int, typer.Option(help="Mapping photos.")] = 60,
    seed: Annotated[int, typer.Option(help="Another seed, other pictures in the room.")] = 0,
    size: Annotated[str, typer.Option(help="Size of a photo, WxH.")] = "640x480",
) -> None:
    """Make a small synthetic dataset with exact poses."""
    with StageProgress(_err, if_stopped="nothing was left behind") as progress:
        write_sample(
            output,
            images=images,
            seed=seed,
            size=_parse_size(size),
            progress=lambda done, total: progress("photos", done, total),
        )
    _out.print(f"sample dataset: {output}/mapping and {output}/query", soft_wrap=True)


def main() -> None:
    """Run the command; an error is one line, not a traceback."""
    # pycolmap would answer it with a stack trace.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        app()
    except VislocError as error:
        _fail(error.code, str(error))
    except OSError as error:  # a full disk, a folder without permission
        _fail("system", str(error))


def _fail(code: str, message: str) -> NoReturn:
    line = " ".join(message.splitlines())
    _err.print(f"error [{code}] {line}", markup=False, highlight=False, soft_wrap=True)
    sys.exit(1)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",")) if text.strip() else ()


def _parse_weights(text: str) -> dict[str, float]:
    items = [item.rpartition("=") for item in _names(text)]
    try:
        weights = {name.strip(): float(weight) for name, _, weight in items}
    except ValueError:
        weights = {}
    if not weights or len(weights) < len(items) or "" in weights:
        raise refuse(
            "build.fusion_weights",
            "these are not weights of global features",
            field="--fusion-weights",
            expected="NAME=WEIGHT,... such as densevlad=1,localvlad=2, each name once",
            got=text,
        )
    return weights


def _parse_vector(option: str, text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        raise refuse(
            f"build.{option[2:]}",
            "this is not a vector",
            field=option,
            expected="X,Y,Z such as 0,0,-1",
            got=text,
        ) from None
    return x, y, z


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise refuse("sample.size", field="--size", got=text)
    return int(width), int(height)


if __name__ == "__main__":
    main()
