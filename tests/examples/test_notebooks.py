"""The notebooks of docs/ run from their first cell to the last, on the sample."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks need the extras notebook and dev")
for package in ("nbclient", "ipykernel", "pandas", "plotly", "matplotlib"):
    pytest.importorskip(package, reason="notebooks need the extras notebook and dev")

NOTEBOOKS = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
PNG, PLOTLY, HTML = "image/png", "application/vnd.plotly.v1+json", "text/html"


def outputs(cells: list[Any]) -> list[dict[str, Any]]:
    """What each cell of code shows, by media type."""
    return [
        {kind: data for output in cell["outputs"] for kind, data in output.get("data", {}).items()}
        for cell in cells
        if cell["cell_type"] == "code"
    ]


def run(name: str, sample: Path, maps: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    from nbclient import NotebookClient

    monkeypatch.setenv("VISLOC_NOTEBOOK_DATA", str(sample))
    monkeypatch.setenv("VISLOC_NOTEBOOK_MAPS", str(maps))
    monkeypatch.setenv("PYTHONPATH", ":".join(sys.path))
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    return list(notebook["cells"])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Jupyter's own libraries
def test_localize_in_your_own_map(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = run("your_own_map.ipynb", sample, tmp_path, monkeypatch)

    shown = outputs(cells)
    assert sum(PNG in each for each in shown) == 4
    (view,) = [each[PLOTLY] for each in shown if PLOTLY in each]
    assert [trace["name"] for trace in view["data"]] == [
        *("landmarks", "mapping photos", "localized", "true poses")
    ]
    table, recall = [each[HTML] for each in shown if HTML in each and PLOTLY not in each]
    assert table.count("<td>localized</td>") == 3
    assert "max_position_error_m" in recall


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Jupyter's own libraries
def test_compare_features_and_fusions(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = run("features_and_fusions.ipynb", sample, tmp_path, monkeypatch)

    shown = outputs(cells)
    assert sum(PNG in each for each in shown) == 3
    features, fusions = [each[HTML] for each in shown if HTML in each]
    assert all(name in features for name in ("xfeat", "sift"))
    assert all(name in fusions for name in ("gharm", "mean", "power", "round_robin"))


def test_notebooks_are_kept_without_outputs() -> None:
    found = sorted(NOTEBOOKS.glob("*.ipynb"))
    assert [path.name for path in found] == ["features_and_fusions.ipynb", "your_own_map.ipynb"]
    for path in found:
        for cell in nbformat.read(path, as_version=4)["cells"]:
            assert cell.get("outputs", []) == []
            assert cell.get("execution_count") is None
