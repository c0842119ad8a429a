from __future__ import annotations

from tests.clients.test_client_real_service import doors  # noqa: F401
from tests.test_tutorials import demo  # noqa: F401
