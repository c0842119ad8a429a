"""From what maps say of themselves to the words of the API."""

from __future__ import annotations

from dataclasses import asdict
from itertools import islice
from typing import Any

import visloc.archive
from service.values import ServedMap
from visloc.archive import MapOutline, SetOutline
from visloc.archive.photos import MappingPhotos
from visloc_api.words.answers import MapRef
from visloc_api.words.maps import MAX_LISTED, MapInfo
from visloc_api.words.scenes import MapCamera, MapImage, MapImages

# Answers state it where they state an accuracy (``visloc.geopose``).
_NOT_SAID = {"geodetic": {"error"}}


def map_info(served: ServedMap, *, in_list: bool = False) -> MapInfo:
    """Describe a map or a set of maps; in lists without its tiles."""
    outline = served.outline
    manifest, world = outline.manifest, outline.manifest.world
    place = visloc.archive.circle_of(world)
    facts = (
        _set_facts(outline, in_list=in_list)
        if isinstance(outline, SetOutline)
        else _map_facts(outline)
    )
    return MapInfo.model_validate(
        {
            "id": manifest.id,
            "version": manifest.version,
            "created": manifest.created,
            "metric": world.metric,
            "images": manifest.counts.images,
            "landmarks": manifest.counts.landmarks,
            "extent": world.extent.model_dump(),
            "size_bytes": outline.size_bytes,
            "down": None if outline.gravity is None else outline.gravity.tolist(),
            "anchor": None if world.anchor is None else world.anchor.model_dump(exclude=_NOT_SAID),
            "place": None if place is None else asdict(place),
            "current": served.current,
            "versions": [{"version": name, "current": used} for name, used in served.versions],
            "content_hash": manifest.content_hash,
            **facts,
        }
    )


def _set_facts(outline: SetOutline, *, in_list: bool) -> dict[str, Any]:
    manifest = outline.manifest
    tiles = [] if in_list else [tile.model_dump() for tile in manifest.tiles]
    return {
        "kind": "set",
        "method": None,
        "local_features": manifest.local_features.name,
        "global_features": [],
        "observations": None,
        "rigs": [],
        "fusion": None,
        "num_tiles": len(manifest.tiles),
        "tiles": tiles,
    }


def _map_facts(outline: MapOutline) -> dict[str, Any]:
    manifest = outline.manifest
    return {
        "kind": "map",
        "method": manifest.method.name,
        "local_features": manifest.local_features.fingerprint.name,
        "global_features": [record.fingerprint.name for record in manifest.global_features],
        "observations": manifest.counts.observations,
        "rigs": [{"id": id_, "sensors": tuple(sensors)} for id_, sensors in outline.rigs.items()],
        "fusion": manifest.retrieval.fusion.value,
        "fusion_weights": manifest.retrieval.weights or {},
        "own_test": manifest.parts.own_test,
        "doubts": manifest.parts.doubts[:MAX_LISTED],
        "pieces": manifest.pieces[:MAX_LISTED],
        "cameras": dict(islice(sorted(outline.cameras.items()), MAX_LISTED)),
        "num_cameras": len(outline.cameras),
    }


def map_images(outline: MapOutline, photos: MappingPhotos, first: int, count: int) -> MapImages:
    """Describe mapping photos of a map, ``count`` from ``first`` on."""
    shown = slice(first, first + count)
    images = [
        MapImage(
            name=image.name,
            camera=image.camera,
            position=position.tolist(),
            orientation=orientation.tolist(),
        )
        for image, position, orientation in zip(
            photos.images[shown],
            photos.positions[shown],
            photos.orientations[shown],
            strict=True,
        )
    ]
    cameras = {id_: outline.cameras[id_] for id_ in sorted({image.camera for image in images})}
    return MapImages(
        map=MapRef(id=outline.manifest.id, version=outline.manifest.version),
        total=len(photos.images),
        first=first,
        cameras={id_: MapCamera.model_validate(camera) for id_, camera in cameras.items()},
        images=images,
    )
