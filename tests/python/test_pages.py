"""The guide of Python. (Its code is run by docs_commands_of_docs/guide/python.md.)"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
GUIDE = REPOSITORY / "docs" / "guide" / "python.md"
if not GUIDE.is_file():
    pytest.skip(f"there is no {GUIDE}: the pages are not tested", allow_module_level=True)


def test_names_of_the_guide_are_there() -> None:
    """Every name `sf.NAME` and `run.NAME` of the guide is there."""
    import semfield as sf

    text = GUIDE.read_text()
    assert all(hasattr(sf, name) for name in re.findall(r"\bsf\.(\w+)", text))
    attributes = set(vars(sf.Run)) | {"labels", "name", "bounds", "near_m", "far_m", "metric", "device", "left_out", "has_semantics"}
    assert set(re.findall(r"\brun\.(\w+)", text)) <= attributes
