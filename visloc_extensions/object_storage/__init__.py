"""Maps at a URL that fsspec knows, such as ``s3://``, with copies on the machine that reads them."""
