"""The generated files agree with the settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tools.settings_documents import DOCUMENTS


@pytest.mark.parametrize(
    ("path", "text"), [pytest.param(*item, id=item[0].name) for item in DOCUMENTS.items()]
)
def test_the_committed_file_is_up_to_date(path: Path, text: Callable[[], str]) -> None:
    assert path.read_text() == text(), "run `make docs`"
