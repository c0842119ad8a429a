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


@pytest.mark.parametrize(
    "text",
    [
        "q/a.jpg db/2.jpg\nq/a.jpg db/1.jpg\nq/b.jpg db/1.jpg\nq/x.jpg db/1.jpg\n",
        "# query_image, map_image, score\nq/a.jpg, db/2.jpg, 0.2\nq/b.jpg, db/1.jpg, 1\n"
        "q/a.jpg, db/1.jpg, 0.9\n",
        "a.jpg db/2.jpg 0.9\na.jpg db/1.jpg 0.8\na.jpg db/2.jpg 0.7\nb.jpg db/1.jpg 0.1\n",
    ],
    ids=["hloc", "kapture", "base names"],
)
def test_the_photos_of_a_file_are_sent_in_its_order(
    url: str,
    make_dataset: Callable[..., Path],
    tmp_path: Path,
    service: Any,
    text: str,
) -> None:
    dataset = make_dataset({"q/a.jpg": HERE, "q/b.jpg": HERE, "q/c.jpg": HERE})
    pairs, output = tmp_path / "pairs.txt", tmp_path / "out"
    pairs.write_text(text)
    asked = ["--map", "room", "--server", url, "--option", "seed=3", "--pairs", pairs]

    assert run("batch", dataset, *asked, "--output", output) == 0

    sent = [each["options"] for each in service.seen]
    assert sent == [
        {"seed": 3, "photos": ["db/2.jpg", "db/1.jpg"]},
        {"seed": 3, "photos": ["db/1.jpg"]},
    ]
    lines = [json.loads(line) for line in (output / "results.jsonl").read_text().splitlines()]
    assert [line["status"] for line in lines] == ["localized", "localized", "error"]
    assert lines[2]["error"]["code"] == "pairs.no_photo"
    assert json.loads((output / "run.json").read_bytes())["pairs"] == str(pairs)
    # Other pairs are another run, whatever their file is called.
    pairs.write_text(text.replace("2.jpg", "3.jpg"))
    assert run("batch", dataset, *asked, "--output", output) == 1


def test_pairs_of_other_photos_are_refused(
    http_url: str,
    make_dataset: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("other.jpg db/1.jpg\n")
    asked = ["--map", "room", "--server", http_url, "--pairs", pairs, "--output", tmp_path / "o"]
    assert run("batch", make_dataset({"a.jpg": HERE}), *asked) == 1
    assert "pairs.no_query" in capsys.readouterr().err


def test_a_photo_with_pairs_that_cannot_be_asked_for_fails_alone(
    http_url: str, make_dataset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = make_dataset({"a.jpg": HERE, "b.jpg": HERE})
    pairs, output = tmp_path / "pairs.txt", tmp_path / "out"
    too_many = "".join(f"a.jpg db/{number}.jpg\n" for number in range(1001))
    pairs.write_text(f"{too_many}b.jpg db/1.jpg\n")
    asked = ["--map", "room", "--server", http_url, "--pairs", pairs, "--output", output]

    assert run("batch", dataset, *asked) == 0

    lines = [json.loads(line) for line in (output / "results.jsonl").read_text().splitlines()]
    assert [line["status"] for line in lines] == ["error", "localized"]
    assert lines[0]["error"]["code"] == "options.photos"
