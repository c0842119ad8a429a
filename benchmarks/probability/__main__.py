"""Learn the probability that a pose is right, and measure how well it holds.

    python -m benchmarks.probability teach MAPS_DIR MAP PHOTOS --foreign DIR [--room SEED]
    python -m benchmarks.probability fit [--output visloc/localization/acceptance/probability.json]

``teach`` asks one map about its own photos (``teachers.py``) and keeps the evidence in
``.training/poses/MAP.npz``; PHOTOS is the folder that holds the mapping photos, ``--foreign`` a
folder of folders of photos of other places, and ``--room`` says that the map is of the sample room
with that seed. ``fit`` learns from all that was kept. Its table is of maps that taught nothing:
each is judged by a model of all others.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.probability.learning import Lessons, judged_by_others, learn, table_of
from benchmarks.probability.teachers import Taught, Teacher
from visloc.archive import MapStore
from visloc.features import make_local_features
from visloc.localization.acceptance.probability import MODEL_FILE

app = typer.Typer(add_completion=False, no_args_is_help=True)
_KEPT = Path(".training/poses")
_NUM_PHOTOS, _NUM_FAR, _NUM_ELSEWHERE, _NUM_PAINTED = 30, 10, 12, 8


@app.command()
def teach(
    maps_dir: Path,
    map_ref: str,
    photos: Path,
    foreign: Annotated[Path, typer.Option(help="folder of folders of JPEGs")],
    room: Annotated[int | None, typer.Option(help="seed of the sample room")] = None,
    kept: Path = _KEPT,
) -> None:
    """Ask one map about its own photos."""
    opened = MapStore(maps_dir).open(map_ref)
    extractor = make_local_features(opened.manifest.local_features.fingerprint.name)
    teacher = Teacher(opened, photos, extractor, sorted(foreign.glob("*/*.jpg")))
    taught: list[Taught] = [
        *teacher.held_out(_NUM_PHOTOS),
        *teacher.from_afar(_NUM_FAR),
        *(teacher.from_elsewhere(_NUM_ELSEWHERE) if room is None else ()),
        *(() if room is None else teacher.painted(room, _NUM_PAINTED)),
    ]
    kept.mkdir(parents=True, exist_ok=True)
    np.savez(
        kept / f"{opened.manifest.id}.npz",
        kind=np.array([each.kind for each in taught]),
        right=np.array([each.right for each in taught]),
        believed=np.array([each.believed for each in taught]),
        features=np.array([each.features for each in taught]),
    )
    right = sum(each.right for each in taught)
    typer.echo(f"{opened.manifest.id}: {right} right and {len(taught) - right} wrong poses")


@app.command()
def fit(kept: Path = _KEPT, output: Path = MODEL_FILE) -> None:
    """Learn from all maps, and judge each map by all others."""
    lessons = Lessons.read(kept)
    typer.echo(table_of(lessons, judged_by_others(lessons)))
    model = learn(lessons)
    output.write_text(json.dumps(model.as_json(), indent=1) + "\n", encoding="utf-8")
    typer.echo(f"{len(lessons.right)} poses of {len(set(lessons.map_ids))} maps: {output}")


if __name__ == "__main__":
    app()
