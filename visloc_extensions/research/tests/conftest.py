from __future__ import annotations

from tests.examples.test_plugin import installed  # noqa: F401
from tests.mapping.conftest import (  # noqa: F401  # noqa: F401
    build_walk,
    localization_errors,
    rewrite,
    sfm_walk,
    walk,
    walk_copy,
)
