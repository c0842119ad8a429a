"""Which files one accepted photo runs through, in all processes of a warm service.

    python -m tools.way_of_a_photo MAPS_DIR MAP PHOTO

Starts the service with a hook that notes when each function last began, asks twice, and lists the
files of functions that began with the second question.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import typer

from benchmarks.reliability.service_process import ServiceProcess
from clients import Client

ROOT = Path(__file__).resolve().parents[1]
# Python imports it first in every process. The file is written when its process is told to end,
# and every second, as workers may be killed.
_HOOK = """
import atexit, json, os, sys, threading, time
root, folder = os.environ["WAY_ROOT"] + "/", os.environ["WAY_FOLDER"]
began = {}
def note(frame, event, _):
    code = frame.f_code
    if event == "call" and code.co_filename.startswith(root) and "/.venv/" not in code.co_filename:
        began[code.co_filename[len(root):], code.co_qualname, code.co_firstlineno] = time.time()
def write():
    path = os.path.join(folder, f"{os.getpid()}.json")
    with open(path + ".new", "w") as file:
        json.dump([[*key, at] for key, at in list(began.items())], file)
    os.replace(path + ".new", path)
def follow():
    sys.setprofile(note)
    threading.setprofile(note)
    def loop():
        while True:
            time.sleep(0.5)
            write()
    threading.Thread(target=loop, daemon=True).start()
follow()
os.register_at_fork(after_in_child=follow)
"""


def main(maps_dir: Path, map_ref: str, photo: Path) -> None:
    """List the files, with how many functions and lines each has on the way."""
    with tempfile.TemporaryDirectory() as scratch:
        hook, notes = Path(scratch, "hook"), Path(scratch, "notes")
        hook.mkdir()
        notes.mkdir()
        (hook / "sitecustomize.py").write_text(_HOOK, "utf-8")
        path = os.pathsep.join([str(hook), os.environ.get("PYTHONPATH", "")])
        os.environ.update(PYTHONPATH=path, WAY_ROOT=str(ROOT), WAY_FOLDER=str(notes))
        service = ServiceProcess(maps_dir, Path(scratch, "service.log"))
        service.start()
        try:
            service.wait_until_ready()
            with Client(service.url) as client:
                client.localize(photo, map_ref)
                time.sleep(1.0)
                since = time.time()
                answer = client.localize(photo, map_ref)
                until = time.time()
            time.sleep(1.5)
        finally:
            service.stop()
        ran: dict[str, set[str]] = defaultdict(set)
        for file in notes.glob("*.json"):
            for name, function, line, at in json.loads(file.read_text("utf-8")):
                if since <= at <= until:
                    ran[name].add(f"{function}:{line}")
    if not answer.localized:
        sys.exit(f"the photo was refused: {answer.refusal}")
    for name in sorted(ran):
        lines = len((ROOT / name).read_text("utf-8").splitlines())
        typer.echo(f"{len(ran[name]):4d} functions, file of {lines:4d} lines: {name}")
    typer.echo(f"{len(ran)} files, {sum(map(len, ran.values()))} functions")


if __name__ == "__main__":
    typer.run(main)
