"""A core that has no extension for sets of maps."""

from __future__ import annotations

import pytest

from visloc.archive import kinds
from visloc.errors import Conflict


def test_set_is_refused_with_what_is_missing_without_its_extension(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kinds, "extensions", lambda _group: {})
    with pytest.raises(Conflict) as caught:
        kinds.kind_of_sets("site@v1")
    assert caught.value.code == "set.extension"
    assert caught.value.got == "site@v1"
    assert "visloc_extensions.sets" in str(caught.value.expected)
