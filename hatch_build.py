"""Compiles what is written in C, where there is a C compiler, while the package is installed.

Without a compiler, or on another kind of machine, the package lacks only that library:
``visloc.matching`` then computes with torch, and says so in its log.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("visloc/matching/native")
OPTIONS = ("-std=gnu11", "-O2", "-fPIC", "-shared")


class CompilingBuildHook(BuildHookInterface[Any]):
    """Adds the library to a wheel, which then is for this kind of machine only."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002  hatch's
        if self.target_name != "wheel" or (sys.platform, platform.machine()) != ("linux", "x86_64"):
            return
        compiler = shlex.split(os.environ.get("CC", "cc"))
        source = Path(self.root) / FOLDER / "nearest.c"
        library, made = source.with_suffix(".so"), source.with_suffix(f".{os.getpid()}.so")
        command = [*compiler, *OPTIONS, str(source), "-o", str(made)]
        if shutil.which(compiler[0]) is None:
            self._leave_out(library, f"there is no C compiler ({compiler[0]})")
            return
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            self._leave_out(library, f"{shlex.join(command)}:\n{done.stderr}")
            return
        made.replace(library)  # at once: what runs from these sources may load it just now
        build_data["pure_python"] = False
        machine = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{machine}"

    def _leave_out(self, library: Path, why: str) -> None:
        library.unlink(missing_ok=True)  # it may be of an older source
        self.app.display_warning(f"visloc.matching is not compiled, and will be slower: {why}")
