from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clients.cli.main import main

HERE = json.dumps({"rotation_wxyz": [1.0, 0, 0, 0], "translation": [0.0, 0, 0]}).encode()


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def test_names_that_a_pairs_file_cannot_hold_are_refused_before_anything_is_asked(
    http_url: str, make_dataset: Callable[..., Path], tmp_path: Path, service: Any
) -> None:
    dataset = make_dataset({"q/a.jpg": HERE})
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a, b.jpg").write_bytes(next((dataset / "sensors").rglob("a.jpg")).read_bytes())
    asked = ["--map", "room", "--server", http_url, "--output", tmp_path / "pairs.txt"]
    assert run("retrieve", photos, *asked) == 1
    assert not service.seen


def test_what_was_retrieved_is_written_and_read_again(
    http_url: str, make_dataset: Callable[..., Path], tmp_path: Path, service: Any
) -> None:
    dataset = make_dataset({"q/a b.jpg": HERE, "q/b.jpg": b"refuse", "q/c.jpg": b"broken"})
    pairs = tmp_path / "pairs.txt"
    server = ["--map", "room", "--server", http_url]

    assert run("retrieve", dataset, *server, "--output", pairs) == 0

    first, *rows = pairs.read_text().splitlines()
    assert first == "# query_image, map_image, score"
    assert rows[0].startswith("q/a b.jpg, seq/1.jpg, 0.75")
    assert {row.split(", ")[0] for row in rows} == {"q/a b.jpg", "q/b.jpg"}
    service.seen.clear()
    assert run("batch", dataset, *server, "--pairs", pairs, "--output", tmp_path / "out") == 0
    assert all(each["options"]["photos"][0] == "seq/1.jpg" for each in service.seen)
