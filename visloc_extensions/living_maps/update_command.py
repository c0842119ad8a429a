"""The command ``mapping update``."""

from __future__ import annotations

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import ERR, say, say_notes
from mapping.cli.progress import StageProgress
from visloc.archive import open_map
from visloc_extensions.living_maps.updating.job import Updated, update_map
from visloc_extensions.living_maps.updating.settings import UpdateSettings


def update(settings: UpdateSettings) -> None:
    """Add a new capture to a map without rebuilding it.

    A new version is published; the old one stays. A capture of another place is refused. An update
    that was killed resumes with the same command.
    """
    with StageProgress(ERR) as progress:
        updated = update_map(settings, progress)
    print_update(updated)
    require_acceptance(
        open_map(updated.folder),
        accept=settings.accept,
        pictures=settings.maps_dir / ".work" / ".doubts",
    )


def print_update(updated: Updated) -> None:
    """Print how well a capture fits the map that it joined."""
    opened, record = open_map(updated.folder), updated.record
    unit = "m" if opened.manifest.world.metric else "units"
    say(
        f"capture {record.capture}: {record.photos} photos, {record.observations} observations, "
        f"{record.landmarks} new landmarks ({record.method})"
    )
    absent = ", ".join(f"{count} {reason}" for reason, count in record.not_localized.items())
    say(
        f"localized {record.localized} of {record.tried} photos that were tried"
        + (f" (not: {absent})" if absent else "")
    )
    if record.poses == "localize":
        say(f"median residual of the localized photos: {record.pixels:.2f} px")
    else:
        say(
            f"{record.tied} photos tied, median residual {record.pixels:.2f} px, "
            f"{record.position:.4g} {unit}, {record.orientation_deg:.3g} degrees; "
            f"scale {record.scale:.6g}"
        )
    counts = opened.manifest.counts
    say(
        f"map {opened.ref}: {counts.images} photos, {counts.landmarks} landmarks, "
        f"{counts.observations} observations"
    )
    say_notes(updated.notes)
