"""Check that a map was built with the installed features."""

from __future__ import annotations

from visloc.archive import FingerprintRecord
from visloc.errors import refuse
from visloc.types import Fingerprint


def check_fingerprint(built_with: FingerprintRecord, at_hand: Fingerprint, ref: str) -> None:
    """Refuse a map that was built with other features than the installed ones."""
    there, here = _flat(built_with), _flat(FingerprintRecord.of(at_hand))
    differing = [name for name in {**there, **here} if there.get(name) != here.get(name)]
    if not differing:
        return
    raise refuse(
        "map.features",
        f"map {ref} was built with a different {built_with.name}; use the visloc "
        "version and weights that built it, or rebuild the map",
        field="weights_dir" if "weights_sha256" in differing else "map",
        expected=", ".join(f"{name} {there.get(name)}" for name in differing),
        got=", ".join(f"{name} {here.get(name)}" for name in differing),
    )


def _flat(record: FingerprintRecord) -> dict[str, int | float | str | None]:
    return {
        "name": record.name,
        "revision": record.revision,
        "weights_sha256": record.weights_sha256,
        **record.parameters,
    }
