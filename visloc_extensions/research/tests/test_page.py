from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs_check import ROOT
from tests.test_tutorials import run_page


@pytest.mark.slow
def test_the_commands_of_the_page_run(demo: Path, tmp_path: Path) -> None:
    run_page(ROOT / "visloc_extensions" / "research" / "README.md", 11, demo, tmp_path)
