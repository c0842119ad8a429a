"""The main job on a synthetic room: sample, build, serve, localize, picture. ``make demo``.

It runs the commands that a user would type, and prints each before it runs. What it leaves is in
``.demo/``.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import matplotlib as mpl
import numpy as np

from visloc.archive import MapStore
from visloc.geometry import Pose
from visloc.kapture import read_dataset

mpl.use("Agg")
from matplotlib import pyplot as plt

ROOT = Path(".demo")
DATASET, MAPS = ROOT / "dataset", ROOT / "maps"
REPORT, POSES, PICTURE = ROOT / "report.json", ROOT / "poses.txt", ROOT / "picture.png"
SERVICE_LOG = ROOT / "service.log"
# Photos of one moment under short names, for the commands of docs/first-steps.md and docs/api.md.
PHOTOS = {"left": ROOT / "photo.jpg", "right": ROOT / "right.jpg"}
COMMANDS = Path(sys.executable).parent
READY_WITHIN_S = 60
# The sample's poses are exact: this is what the system promises on it.
MAX_MEDIAN_POSITION_M, MAX_MEDIAN_ORIENTATION_DEG = 0.01, 0.1


def main() -> int:
    """Run the demo; 0 when every query was localized as well as promised."""
    shutil.rmtree(ROOT, ignore_errors=True)
    ROOT.mkdir()
    run("mapping", "sample", DATASET)
    for camera, path in PHOTOS.items():
        shutil.copy(DATASET / "query/sensors/records_data/query" / camera / "0001.jpg", path)
    run(
        *("mapping", "build", DATASET / "mapping", "--map", "sample", "--maps-dir", MAPS),
        "--keep-colours",
    )
    http_port, grpc_port = free_port(), free_port()
    server = f"http://127.0.0.1:{http_port}"
    with served(http_port, grpc_port):
        run(
            *("localize", "benchmark", DATASET / "query", "--map", "sample", "--server", server),
            *("--report", REPORT, "--poses", POSES),
        )
    draw()
    by_hand()
    report = json.loads(REPORT.read_text())
    good = (
        report["localized"] == report["queries"]
        and report["median_position_error_m"] < MAX_MEDIAN_POSITION_M
        and report["median_orientation_error_deg"] < MAX_MEDIAN_ORIENTATION_DEG
    )
    if not good:
        say("the demo is not as good as promised; see the table above")
    return 0 if good else 1


def say(text: str) -> None:
    """Print one line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def run(command: str, *arguments: object) -> None:
    """Show and run one command; its failure ends the demo."""
    words = [str(argument) for argument in arguments]
    say(f"\n$ {command} {' '.join(words)}")
    subprocess.run([COMMANDS / command, *words], check=True)


@contextmanager
def served(http_port: int, grpc_port: int) -> Iterator[None]:
    """Run the service until the block ends."""
    words = [
        *("--maps-dir", str(MAPS), "--http-port", str(http_port), "--grpc-port", str(grpc_port)),
    ]
    say(f"\n$ visloc-service {' '.join(words)} 2> {SERVICE_LOG} &")
    with SERVICE_LOG.open("wb") as log:
        service = subprocess.Popen([COMMANDS / "visloc-service", *words], stderr=log)
    try:
        wait_until_ready(service, f"http://127.0.0.1:{http_port}/readyz")
        yield
    finally:
        service.terminate()
        service.wait()


def wait_until_ready(service: subprocess.Popen[bytes], url: str) -> None:
    """Return when the service answers that it is ready."""
    deadline = time.monotonic() + READY_WITHIN_S
    while time.monotonic() < deadline and service.poll() is None:
        try:
            if httpx.get(url, timeout=5).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise SystemExit(f"the service did not become ready; see {SERVICE_LOG}")


def free_port() -> int:
    """Return a port of this machine that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def draw() -> None:
    """Leave a picture: the map from above, its cameras, the queries and where they were found."""
    opened = MapStore(MAPS).open("sample")
    landmarks = opened.landmarks + np.array(opened.manifest.world.origin)
    mapping = [Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses]
    query = read_dataset(DATASET / "query")
    truth = {record.path: query.pose(record) for record in query.images}
    found = {}
    for line in POSES.read_text().splitlines():
        name, *numbers = line.split()
        found[name] = Pose.from_quaternion(
            [float(n) for n in numbers[:4]], [float(n) for n in numbers[4:]]
        )

    figure, axes = plt.subplots(figsize=(10, 8), layout="constrained")
    some = np.random.default_rng(0).permutation(len(landmarks))[:40_000]
    axes.scatter(*landmarks[some, :2].T, s=1.0, c="#8492a6", linewidths=0, label="landmarks")
    draw_cameras(axes, mapping, "#3b6ea5", "mapping photos")
    draw_cameras(axes, list(found.values()), "#d1495b", "queries, where they were found")
    exact = np.array([pose.center for pose in truth.values() if pose is not None])
    axes.scatter(
        *exact[:, :2].T, s=60, facecolors="none", edgecolors="#2a9134", label="queries, true places"
    )
    axes.set(
        title=f"{len(found)} of {len(truth)} queries localized in map {opened.ref}",
        xlabel="x (m)",
        ylabel="y (m)",
        aspect="equal",
    )
    axes.legend(loc="upper right", markerscale=2)
    figure.savefig(PICTURE, dpi=120)
    say(f"\npicture: {PICTURE}")


def draw_cameras(axes: plt.Axes, poses: list[Pose], colour: str, label: str) -> None:
    """Draw camera centres with an arrow along the optical axis, seen from above."""
    centers = np.array([pose.center for pose in poses])
    forward = np.array([pose.rotation[2] for pose in poses])
    axes.quiver(
        *centers[:, :2].T, *forward[:, :2].T, color=colour, scale=30, width=0.003, label=label
    )


def by_hand() -> None:
    """Print what to type next."""
    query = read_dataset(DATASET / "query")
    camera = query.sensors[query.images[0].sensor_id].camera
    assert camera is not None
    params = [f"{value:g}" for value in camera.params]
    words = [camera.model, camera.width, camera.height, *params]
    say(
        "\nTry it by hand:\n"
        f"  {COMMANDS}/visloc-service --maps-dir {MAPS} &\n"
        "and open http://127.0.0.1:8000/ in a browser, or\n"
        f"  {COMMANDS}/localize image {PHOTOS['left']} --map sample \\\n"
        f"      --camera {','.join(map(str, words))}"
    )


if __name__ == "__main__":
    sys.exit(main())
