"""Records of sensors that nothing here uses: kept as they are written, so that none are lost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from visloc.kapture.table import Table

# Rows of fields, in the order of the file: timestamp, device_id and what the sensor measured.
OtherRecords = tuple[tuple[str, ...], ...]

_KEY = ("timestamp", "device_id")
# Columns by file, for the header that people read. Of pressure, kapture names none.
OTHER_FILES: Mapping[str, tuple[str, ...]] = {
    "records_wifi.txt": (
        *(*_KEY, "BSSID", "frequency", "RSSI", "SSID", "scan_time_start", "scan_time_end"),
    ),
    "records_bluetooth.txt": (*_KEY, "address", "RSSI", "name"),
    "records_pressure.txt": (*_KEY, "[values]+"),
    "records_accelerometer.txt": (*_KEY, "x_accel", "y_accel", "z_accel"),
    "records_gyroscope.txt": (*_KEY, "x_speed", "y_speed", "z_speed"),
    "records_magnetic.txt": (*_KEY, "x_strength", "y_strength", "z_strength"),
}


def read_other_records(root: Path) -> dict[str, OtherRecords]:
    """Read the records of other sensors by file name; several rows may have one key.

    What they measured is not parsed: names of networks are free texts, and may have commas.
    """
    found = {}
    for name in OTHER_FILES:
        table = Table(root, f"sensors/{name}", None)
        if not table.exists():
            continue
        rows = []
        for fields in table:
            if len(fields) <= len(_KEY):
                expected = f"{', '.join(_KEY)} and values"
                raise table.error("kapture.column_count", expected=expected, got=len(fields))
            table.timestamp(fields[0])
            rows.append(tuple(fields))
        if rows:
            found[name] = tuple(rows)
    return found
