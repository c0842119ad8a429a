"""The peer, kapture-localization, on our features of the same photos."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

from benchmarks.speed.dataset import Bench, read_errors
from benchmarks.speed.steps import say
from visloc.errors import Conflict
from visloc.options import Inference

# As builds of ours have it.
_MAX_KEYPOINTS = 5000


def why_no_peer(runner: Path, *, has_depth: bool) -> str | None:
    """Tell why the peer cannot run here; None when it can."""
    if not runner.is_file():
        return f"there is no {runner.name} of the peer"
    if not has_depth and shutil.which("colmap") is None:
        return "without depth maps the peer's map needs the program colmap, which is not installed"
    return None


def export_for_peer(bench: Bench) -> None:
    """Write our features of all photos, by plain torch, unless an earlier run did."""
    try:
        _export(bench)
    except Conflict as conflict:
        say(f"features for the peer are made again: {conflict}")
        shutil.rmtree(bench.work / "features")
        _export(bench)


def _export(bench: Bench) -> None:
    # Only this step needs the extension.
    from visloc_extensions.research.export_features import export_features

    for side in ("mapping", "query"):

        def progress(_stage: str, done: int, total: int, side: str = side) -> None:
            if done in (1, total) or done % 20 == 0:
                say(f"features of {side} for the peer: {done} of {total}")

        export_features(
            bench.dataset / side,
            bench.work / "features" / side,
            local_features=bench.features,
            weights_dir=bench.weights_dir,
            inference=Inference.TORCH,
            max_keypoints=_MAX_KEYPOINTS,
            global_from=None,
            progress=progress,
        )


def run_peer(runner: Path, bench: Bench) -> dict[str, Any]:
    """Run it once, from the map to the poses; what it reports, and the error of each query."""
    features, out = bench.work / "features", bench.work / "peer"
    command = [str(runner), str(features / "mapping"), str(features / "query"), str(out)]
    command += ["--queries", str(bench.num_queries)]
    command += [] if bench.has_depth else ["--sfm"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return {"result": json.loads(done.stdout), "errors": read_errors(out / "errors.csv")}
