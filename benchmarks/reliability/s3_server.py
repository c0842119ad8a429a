"""An S3 server with the maps of a folder: ``python -m benchmarks.reliability.s3_server``.

Its memory is all it has. So that it comes back with what it had, as a real one does, it is filled
before its port opens.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import boto3  # type: ignore[import-untyped]
from moto.server import ThreadedMotoServer

BUCKET = "maps"
ACCOUNT = {
    "AWS_ACCESS_KEY_ID": "AKIDEXAMPLE",
    "AWS_SECRET_ACCESS_KEY": "of-no-account",
    "AWS_DEFAULT_REGION": "us-east-1",
}


def main(folder: Path, port: int) -> None:
    """Serve the files of a folder until killed."""
    filling = ThreadedMotoServer("127.0.0.1", 0, verbose=False)  # both have the same memory
    filling.start()
    host, filling_port = filling.get_host_and_port()
    s3 = boto3.client(
        "s3",
        endpoint_url=f"http://{host}:{filling_port}",
        aws_access_key_id=ACCOUNT["AWS_ACCESS_KEY_ID"],
        aws_secret_access_key=ACCOUNT["AWS_SECRET_ACCESS_KEY"],
        region_name=ACCOUNT["AWS_DEFAULT_REGION"],
    )
    s3.create_bucket(Bucket=BUCKET)
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            s3.upload_file(str(path), BUCKET, str(name))
    ThreadedMotoServer("127.0.0.1", port, verbose=False).start()
    threading.Event().wait()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
