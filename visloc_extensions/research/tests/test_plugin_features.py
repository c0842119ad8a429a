from __future__ import annotations

from pathlib import Path

from mapping.sample import write_sample
from tests.examples.test_plugin import python


def test_features_of_a_plugin_are_exported(installed: Path, tmp_path: Path) -> None:
    sample, maps_dir, exported = (tmp_path / name for name in ("sample", "maps", "exported"))
    write_sample(sample, images=2, size=(320, 240))
    local = "--local-features example-orb"
    build = f"build {sample}/mapping --map room --maps-dir {maps_dir} {local}"
    export = f"export-features {sample}/query --output {exported} --map room --maps-dir {maps_dir}"
    for command in (f"{build} --global-features example-thumbnail", f"{export} {local}"):
        done = python(installed, "-m", "mapping.cli.main", *command.split())
        assert done.returncode == 0, done.stderr
    kinds = exported / "reconstruction"
    assert list((kinds / "descriptors" / "example-orb").rglob("*.desc"))
    assert list((kinds / "global_features" / "example-thumbnail").rglob("*.gfeat"))
