"""Fixtures of the map's own test."""

from tests.mapping.own_test.conftest import looking, make_map, room  # noqa: F401
