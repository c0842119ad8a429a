from __future__ import annotations

from tests.clients.conftest import (  # noqa: F401
    _servers,
    grpc_url,
    http_url,
    make_dataset,
    service,
    url,
)
from tests.clients.test_client_real_service import doors  # noqa: F401
from tests.examples.test_plugin import installed  # noqa: F401
from tests.mapping.conftest import (  # noqa: F401
    build_walk,
    localization_errors,
    rewrite,
    sfm_walk,
    walk,
    walk_copy,
)
from tests.test_tutorials import demo  # noqa: F401
