"""Both doors on real sockets, and a map that is tied to the Earth."""

from tests.service.conftest import anchored_maps, serve  # noqa: F401
