"""The page in Chromium, against the service with the sample's map (scenarios: web/e2e/)."""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np
import pytest

from mapping.frames.georeference import given_place, publish_anchored
from mapping.maps.editing import content_of
from mapping.own_test.publishing import publish_edited
from tests.serving import ENVIRONMENT, serving
from visloc.archive import MapStore
from visloc.archive.schema import PIECES, Doubt
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.options import Solver

ROOT = Path(__file__).resolve().parents[2]
BUILT = ROOT / "service" / "page" / "built"
LONGEST_S = 90


class Query(Protocol):
    path: Path
    image: bytes
    camera: Camera
    cam_from_world: Pose


def chromium() -> str | None:
    """The browser's command."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return os.environ.get("VISLOC_CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


def grouped(count: int) -> str:
    """As the page and the report write a count."""
    return f"{count:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def missing() -> str:
    """What these tests need and is not here; empty when all is."""
    if chromium() is None:
        return "needs Chromium: its command in VISLOC_CHROMIUM, or `chromium` on PATH"
    if shutil.which("node") is None:
        return "needs Node.js: `node` on PATH"
    if not (ROOT / "web" / "node_modules" / "playwright-core").is_dir():
        return "needs web/node_modules, which `make page` makes"
    if not (BUILT / "page" / "index.html").is_file():
        return "needs the built page, which `make page` makes"
    return ""


pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@dataclass(frozen=True)
class Browser:
    """``web/e2e/driver.mjs`` with one Chromium, and the service that its pages are of."""

    driver: subprocess.Popen[str]
    url: str

    def see(self, scenario: str, **given: object) -> dict[str, Any]:
        """Run a scenario and return what it saw."""
        assert self.driver.stdin is not None
        assert self.driver.stdout is not None
        guard = threading.Timer(LONGEST_S, self.driver.kill)
        guard.start()
        try:
            call = {"scenario": scenario, "url": self.url, **given}
            self.driver.stdin.write(json.dumps(call) + "\n")
            self.driver.stdin.flush()
            line = self.driver.stdout.readline()
        finally:
            guard.cancel()
        assert line, f"the browser's driver ended in {scenario}"
        answer = json.loads(line)
        assert "failed" not in answer, answer["failed"]
        return dict(answer["seen"])


@pytest.fixture(scope="module")
def browser(
    built_maps: Path, queries: list[Query], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Browser]:
    """The map ``room`` is served; the camera sees two queries, a second each, over and over."""
    folder = tmp_path_factory.mktemp("page")
    video = folder / "walk.mjpeg"
    video.write_bytes(b"".join(query.image * 30 for query in filmed(queries)))
    command = ["node", str(ROOT / "web" / "e2e" / "driver.mjs"), str(chromium()), str(video)]
    pipe = subprocess.PIPE
    with (
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as driver,
        serving(built_maps, folder / "log") as url,
    ):
        yield Browser(driver, url)
        driver.communicate(timeout=LONGEST_S)  # closes its input, which ends it


def filmed(queries: list[Query]) -> list[Query]:
    """Those of the first camera."""
    return [query for query in queries if query.camera == queries[0].camera]


def camera_text(camera: Camera) -> str:
    return ",".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))


def pose_of(answer: dict[str, Any]) -> Pose:
    pose = answer["pose"]["cam_from_world"]
    return Pose.from_quaternion(pose["rotation_wxyz"], pose["translation"])


def assert_is_at(answer: dict[str, Any], truth: Pose) -> None:
    position_m, orientation_deg = pose_error(pose_of(answer), truth)
    assert position_m < 0.02
    assert orientation_deg < 0.5


def assert_is_quiet(seen: dict[str, Any]) -> None:
    """No error, nothing against the policy, nothing asked of anyone else."""
    assert seen["console"] == []
    assert seen["violations"] == []
    assert seen["dialogs"] == []
    assert {
        urlsplit(request["url"].removeprefix("blob:")).netloc for request in seen["requests"]
    } == {
        urlsplit(seen["requests"][0]["url"]).netloc  # the page itself
    }


# Bundle


@pytest.mark.parametrize("part", ["page", "report"])
def test_the_bundle_is_under_a_megabyte_compressed(part: str) -> None:
    files = [path for path in (BUILT / part).rglob("*") if path.is_file()]
    if part == "page":  # without what only /docs and /redoc load
        index = (BUILT / part / "index.html").read_text()
        files = [path for path in files if path.name == "index.html" or path.name in index]
        assert len(files) > 3
    assert 0 < sum(len(gzip.compress(path.read_bytes())) for path in files) < 1_000_000


# Map


def test_the_landmarks_of_a_chosen_map_come(browser: Browser) -> None:
    seen = browser.see("map")

    assert_is_quiet(seen)
    assert seen["map"]["id"] == "room"
    assert seen["statistics"]["pointsLoaded"] == seen["map"]["landmarks"] > 1000
    assert seen["statistics"]["pointsDrawn"] > 0
    for fact in (grouped(seen["map"]["landmarks"]), seen["map"]["version"], "sift"):
        assert fact in seen["panel"]


# References of the API


def test_swagger_ui_and_redoc_show_the_routes_and_ask_nobody_else(browser: Browser) -> None:
    seen = browser.see("reference")

    assert seen["docs"]["answer"].split()[0] == "200"
    for page in (seen["docs"], seen["redoc"]):
        assert_is_quiet(page)
        assert "/localize/sequence" in page["text"]


# Photo


@pytest.fixture(scope="module")
def photos(browser: Browser, queries: list[Query]) -> dict[str, Any]:
    """Three photos, each given in another way."""
    first, second = filmed(queries)
    given = ((first, "first.jpg", "dropped"), (second, "second.jpg", "chosen"))
    return browser.see(
        "photos",
        camera=camera_text(first.camera),
        photos=[
            {"path": str(query.path), "name": name, "way": way}
            for query, name, way in (*given, (first, PASTED, "pasted"))
        ],
    )


# A file that is there for a shell, curl and Python only where each of them is told so.
PASTED = """it's "here", $HOME; `id`.jpg"""


def test_photos_appear_where_they_were_taken(photos: dict[str, Any], queries: list[Query]) -> None:
    first, second = filmed(queries)

    assert_is_quiet(photos)
    for result, query in zip(photos["results"], (first, second, first), strict=True):
        assert result["problem"] is None
        assert result["answer"]["camera"]["source"] == "given"
        assert_is_at(result["answer"], query.cam_from_world)
    assert str(photos["results"][-1]["answer"]["inliers"]) in photos["shown"]
    assert photos["marked"] > 200  # pixels in the colour of inliers


def test_the_view_flies_behind_the_photo(photos: dict[str, Any], queries: list[Query]) -> None:
    first, second = filmed(queries)

    for result, query in zip(photos["results"], (first, second, first), strict=True):
        view, truth = result["view"], query.cam_from_world
        position, target = np.array(view["position"]), np.array(view["target"])
        ahead = truth.rotation[2]  # of the photo's camera, in the world
        assert np.linalg.norm(position - truth.center) < 2
        assert ahead @ (target - position) > 0.9 * np.linalg.norm(target - position)


def test_the_options_are_those_of_the_service(photos: dict[str, Any]) -> None:
    assert photos["solvers"] == ["(pycolmap)", *Solver]
    assert '"solver":"poselib"' in photos["copied"]["curl"]


def test_the_copied_lines_ask_the_same(
    photos: dict[str, Any], query: Query, tmp_path: Path
) -> None:
    copied, pasted = photos["copied"], photos["results"][-1]["answer"]
    (tmp_path / PASTED).write_bytes(query.image)

    def run(*command: str) -> str:
        done = subprocess.run(
            *(command,), cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert json.loads(copied["JSON"])["pose"] == pasted["pose"]
    position = [
        float(number)
        for number in re.findall(
            r"-?[\d.]+(?:e-?\d+)?", run(sys.executable, "-c", copied["Python"])
        )
    ]
    assert position == pytest.approx(pasted["pose"]["position"], abs=1e-6)
    if shutil.which("curl") is None:
        pytest.skip("needs curl on PATH for the line of curl; the lines of Python were run")
    assert json.loads(run("bash", "-c", copied["curl"]))["pose"] == pasted["pose"]


def test_a_photo_of_another_place_is_refused_in_words_with_what_to_try(
    browser: Browser, query: Query, photos_of_another_room: list[Path]
) -> None:
    photo = {"path": str(photos_of_another_room[0]), "name": "elsewhere.jpg", "way": "dropped"}
    seen = browser.see("refusal", photo=photo, camera=camera_text(query.camera))

    assert_is_quiet(seen)
    assert seen["problem"] is None
    assert seen["answer"]["pose"] is None
    assert seen["answer"]["refusal"]["reason"] == "too_few_inliers"
    for words in ("I do not know", "Gate", seen["answer"]["refusal"]["message"], "What to try"):
        assert words in seen["shown"]
    assert "elsewhere.jpg" in seen["announced"]
    # The view stays. Drawing computes it anew from angles, which may change the last bit.
    assert seen["view"].keys() == seen["before"].keys()
    for name, before in seen["before"].items():
        assert seen["view"][name] == pytest.approx(before, abs=1e-9)


@pytest.mark.slow
def test_a_phone_asks_several_maps_and_fetches_matches_only_when_asked(
    browser: Browser, built_maps: Path, queries: list[Query], tmp_path: Path
) -> None:
    store = MapStore(shutil.copytree(built_maps, tmp_path / "maps"))
    opened, first = store.open("room"), filmed(queries)[0]
    content = content_of(opened)
    folder = publish_edited(store, content, "room-2")
    settings = {**content.settings, PIECES: [f"room-2@{folder.name}"]}
    doubt = Doubt(kind="order", message="the path of a film jumps")
    publish_edited(
        store, replace(content, settings=settings), "room", carried=(doubt,), accept=True
    )
    camera = next(id_ for id_, camera in opened.cameras.items() if camera == first.camera)
    photo = {"path": str(first.path), "name": "photo.jpg", "way": "chosen"}

    with serving(store.root, tmp_path / "log") as url:
        seen = browser.see("phone", url=url, camera=camera, photo=photo)

    assert_is_quiet(seen)
    for words in ("What speaks against this map: the path of a film jumps.", "Own test", "room-2"):
        assert words in seen["about"]
    assert "cameras included" in seen["about"]
    assert seen["chosen"]
    assert seen["inBoth"]["answer"]["refusal"]["reason"] == "ambiguous"
    answer = seen["inOne"]["answer"]
    assert_is_at(answer, first.cam_from_world)
    assert answer["camera"]["source"] == "given"
    assert answer["debug"] is None
    assert seen["inBoth"]["answer"]["debug"] is None
    assert "Show the matches" in seen["shown"]
    assert seen["green"] == (answer["pose"]["probability"] >= 0.9)
    assert seen["matches"] > 100
    assert seen["again"] == 0
    assert seen["width"] == 390


def test_names_are_text_whatever_they_hold(browser: Browser, query: Query) -> None:
    names = ["<img src=x onerror=alert(1)>.jpg", "\"'>\n<script>alert(2)</script>.jpg"]
    markup = "<img src=x onerror=alert(3)>"
    seen = browser.see(
        "hostile",
        names=names,
        markup=markup,
        photo={"path": str(query.path), "way": "dropped"},
        camera=camera_text(query.camera),
    )

    assert_is_quiet(seen)
    assert seen["injected"] == 0
    assert markup in seen["maps"]
    for name, shown in zip(names, seen["shown"], strict=True):
        assert name.split("\n")[-1] in shown
        assert markup in shown


# Link


@pytest.fixture(scope="module")
def on_earth(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The map ``room`` with a place on Earth, its x axis pointing north, is served."""
    folder = tmp_path_factory.mktemp("on_earth")
    maps = Path(shutil.copytree(built_maps, folder / "maps"))
    room = MapStore(maps).open("room")
    place = given_place(
        room, (45.2178, 5.8083, 310.0), 90.0, accuracy=0.1, gravity=(0.0, 0.0, -1.0)
    )
    publish_anchored(room, place, maps, force=False)
    with serving(maps, folder / "log") as url:
        yield url


def test_a_pose_is_shared_by_a_link_and_says_where_on_earth_it_is(
    browser: Browser, on_earth: str, queries: list[Query]
) -> None:
    first, second = filmed(queries)
    seen = browser.see(
        "link",
        url=on_earth,
        camera=camera_text(first.camera),
        photo={"path": str(first.path), "name": "first.jpg", "way": "dropped"},
        other={"path": str(second.path), "name": "second.jpg", "way": "dropped"},
    )

    assert_is_quiet(seen)
    answer, opened = seen["answer"], seen["opened"]
    at = answer["geopose"]["position"]
    assert abs(at["lat"] - 45.2178) < 1e-4
    ahead = first.cam_from_world.rotation[2]  # of the camera, in the world
    heading = np.degrees(np.arctan2(-ahead[1], ahead[0])) % 360  # x is north, y west
    for text in (seen["shown"], opened["shown"]):
        assert f"{at['lat']:.7f}, {at['lon']:.7f}" in text
        found = re.search(r"Heading\s+(\d+)°", text)
        assert found is not None
        assert abs((int(found[1]) - heading + 180) % 360 - 180) < 1.5
    # The link shows the same pose from the same side, in this version of the map.
    assert opened["address"] == seen["link"]
    assert opened["map"]["version"] == answer["map"]["version"]
    assert f"{answer['pose']['position'][0]:.3f}" in opened["shown"]
    assert "the camera of the link" in opened["described"]
    for name, there in seen["view"].items():
        assert opened["view"][name] == pytest.approx(there, abs=1e-4)
    assert "first.jpg" not in seen["link"]
    assert seen["left"] == f"{on_earth}/#map=room"


# Key


def test_a_key_is_asked_for_and_sent_once_it_is_given(browser: Browser) -> None:
    key = "vk_0123456789.secret"
    seen = browser.see("key", key=key)

    assert "API key" in seen["asked"]
    assert seen["before"]
    assert not any("authorization" in request for request in seen["before"])
    asked = [request for request in seen["requests"] if "/maps" in request["url"]]
    assert asked
    assert {request["authorization"] for request in asked} == {f"Bearer {key}"}
    assert key not in seen["kept"]  # it was not asked to remember it
    assert key not in seen["address"]
    assert seen["violations"] == seen["dialogs"] == []


# Live


def test_a_walk_is_followed_frame_by_frame(browser: Browser, queries: list[Query]) -> None:
    walk = filmed(queries)
    seen = browser.see("live", answers=4, camera=camera_text(walk[0].camera))

    assert_is_quiet(seen)
    truths = np.array([query.cam_from_world.center for query in walk])
    for answer in seen["found"]:
        assert answer["status"] == "localized"
        away_m = np.linalg.norm(truths - pose_of(answer).center, axis=1)
        assert away_m.min() < 0.02
    running, stopped = seen["running"], seen["stopped"]
    assert running["answers"] >= running["localized"] >= 4
    assert running["maxInFlight"] == 1
    assert running["errors"] == 0
    assert running["trailLength"] >= 1
    assert running["rate"] > 0
    assert not stopped["running"]
    assert "Localized" in seen["shown"]


# For everyone


def test_axe_finds_nothing_serious_in_light_dark_and_on_a_phone(
    browser: Browser, query: Query
) -> None:
    seen = browser.see(
        "accessibility",
        camera=camera_text(query.camera),
        photo={"path": str(query.path), "name": "photo.jpg", "way": "chosen"},
    )

    assert seen["faults"] == []
    for page_width, window_width in seen["widths"].values():
        assert page_width <= window_width


# Report
