"""Coverage-guided fuzzing: ``python -m tests.fuzz images --runs 100000``.

Every input runs in a process of its own kind, with limits on memory and time. Figures are
appended to a log in JSON lines; an input that shows a fault is kept beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.child import MAX_RSS_MIB, MAX_SECONDS, TARGETS, make_target

_DONE = re.compile(r"^#(\d+)\s+DONE\s+cov: (\d+) ft: (\d+) corp: (\d+)", re.MULTILINE)
_PEAK_RSS = re.compile(r"stat::peak_rss_mb:\s+(\d+)")

# One thread, so that memory is that of the input, and no words of OpenCV on each broken photo.
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1", "OPENCV_LOG_LEVEL": "OFF"}


def main() -> int:
    """Fuzz the named targets one after another and say what came of it."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help=f"default: all of {', '.join(TARGETS)}")
    parser.add_argument("--runs", type=int, default=100_000, help="inputs for each target")
    parser.add_argument("--seed", type=int, default=1, help="of libFuzzer")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "visloc-fuzz")
    given = parser.parse_args()
    unknown = sorted(set(given.targets) - set(TARGETS))
    if unknown:
        parser.error(f"no such target: {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    given.folder.mkdir(parents=True, exist_ok=True)
    found = [fuzz(name, given.runs, given.seed, given.folder) for name in given.targets or TARGETS]
    return 1 if any(found) else 0


def fuzz(name: str, runs: int, seed: int, folder: Path) -> bool:
    """Run one target and log it; tell whether it found a fault.

    What earlier runs found interesting is kept in ``folder`` and taken up again.
    """
    corpus = folder / name
    findings = folder / f"{name}-findings"
    corpus.mkdir(exist_ok=True)
    findings.mkdir(exist_ok=True)
    memory_disk = Path("/dev/shm")
    scratch = Path(
        tempfile.mkdtemp(prefix="visloc-fuzz-", dir=memory_disk if memory_disk.is_dir() else None)
    )
    try:
        (scratch / "seeds").mkdir()
        for number, content in enumerate(make_target(name, scratch / "seeds").seeds()):
            (corpus / f"seed{number:03}").write_bytes(content)
        (scratch / "work").mkdir()
        figures = scratch / "figures.json"
        start = time.monotonic()
        with (folder / f"{name}.txt").open("w", encoding="utf-8") as output:
            status = subprocess.run(
                [
                    *(sys.executable, "-m", "tests.fuzz.child", name, scratch / "work", figures),
                    *(corpus, f"-artifact_prefix={findings}/", f"-runs={runs}", f"-seed={seed}"),
                    *(f"-timeout={MAX_SECONDS}", f"-rss_limit_mb={MAX_RSS_MIB}"),
                    *("-max_len=65536", "-keep_seed=1", "-print_final_stats=1"),
                ],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ | _ENVIRONMENT,
                check=False,
            ).returncode
        seconds = time.monotonic() - start
        text = (folder / f"{name}.txt").read_text(encoding="utf-8", errors="replace")
        done, peak = _DONE.search(text), _PEAK_RSS.search(text)
        entry = {
            "target": name,
            "status": status,
            "runs": int(done[1]) if done else None,
            "seconds": round(seconds),
            "coverage": int(done[2]) if done else None,
            "features": int(done[3]) if done else None,
            "corpus": int(done[4]) if done else None,
            "peak_rss_mib": int(peak[1]) if peak else None,
            "watched": json.loads(figures.read_text()) if figures.exists() else None,
        }
    finally:
        shutil.rmtree(scratch)
    with (folder / "log.jsonl").open("a", encoding="utf-8") as log:
        log.write(json.dumps(entry) + "\n")
    sys.stdout.write(json.dumps(entry) + "\n")
    return status != 0


if __name__ == "__main__":
    sys.exit(main())
