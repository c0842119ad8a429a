"""What a byte can cost: ``python -m visloc_extensions.oscp.tests.costs``."""

from __future__ import annotations

import sys

from tests.fuzz.costs import SETTINGS, Parser, json_parser, main
from visloc_extensions.oscp.words import GeoPoseRequest


def parser() -> Parser:
    """Return what reads strangers' bytes."""
    return json_parser(
        lambda data: GeoPoseRequest.read_json(data).to_job(
            max_image_bytes=SETTINGS.max_image_bytes, max_images=SETTINGS.max_rig_images
        ),
        b'"sensorReadings":',
        SETTINGS.max_batch_bytes,
    )


if __name__ == "__main__":
    sys.exit(main({"GeoPose (OSCP)": parser}))
