"""Adds ``GET`` and ``POST /geopose`` to the service: the OSCP GeoPose protocol."""
