"""The words of the API: what requests and answers look like, for the service and its clients.

The messages of ``proto/visloc_api/v1/localization.proto`` have the same fields. gRPC requests are
checked and its answers made by these models, so that both APIs say the same.
"""
