from __future__ import annotations

import resource
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
from service.descriptors import fit_connections
from service.telemetry.logs import configure_logging
from service.settings import ServiceSettings, SettingsError
settings = ServiceSettings(max_connections=1000)
configure_logging(settings)
try:
    print(fit_connections(settings).max_connections, *resource.getrlimit(resource.RLIMIT_NOFILE))
except SettingsError as error:
    sys.exit(str(error))
"""


_, HARD = resource.getrlimit(resource.RLIMIT_NOFILE)


def under(limits: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", f'{limits} && exec "$@"', "-", sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.skipif(0 <= HARD < 4000, reason="needs a hard limit of 4000 open files")
def test_the_soft_limit_of_files_is_raised_to_what_the_connections_need() -> None:
    done = under("ulimit -Sn 1024 && ulimit -Hn 4000")

    connections, soft, hard = map(int, done.stdout.split())
    assert (connections, hard) == (1000, 4000)
    assert 2 * connections < soft < hard
    (line,) = done.stderr.splitlines()
    assert f"raised from 1024 to {soft}" in line


@pytest.mark.parametrize("limits", ["ulimit -n 1024", "ulimit -Sn 512 && ulimit -Hn 1024"])
def test_where_the_hard_limit_is_too_low_there_are_fewer_connections(limits: str) -> None:
    done = under(limits)

    connections, soft, hard = map(int, done.stdout.split())
    assert soft == hard == 1024
    assert 300 < connections < 1024 / 2
    assert done.stderr.count(f"max_connections is {connections} instead of 1000") == 1


@pytest.mark.parametrize("files", [200, 250])
def test_a_limit_that_leaves_too_few_connections_ends_the_start(files: int) -> None:
    done = under(f"ulimit -n {files}")

    assert done.returncode == 1
    assert f"{files} open files are allowed" in done.stderr
    assert "Traceback" not in done.stderr
