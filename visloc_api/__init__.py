"""The wire: protobuf messages and gRPC stubs generated from ``proto/`` (``make proto``)."""
