"""Maps at URLs that fsspec knows, such as ``s3://``, with copies on the reading machine."""
