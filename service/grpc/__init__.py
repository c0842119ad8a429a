"""The gRPC API: servicers and what all methods share."""
