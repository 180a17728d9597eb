"""The pages about Python: the reference is what the docstrings say. (The guide's code is run by docs_commands_of_docs/guide/python.md.)"""

from __future__ import annotations

import difflib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
GUIDE = REPOSITORY / "docs" / "guide" / "python.md"
if not GUIDE.is_file():
    pytest.skip(f"there is no {GUIDE}: the pages are not tested", allow_module_level=True)


def test_the_reference_is_fresh(tmp_path: Path) -> None:
    page = REPOSITORY / "docs" / "reference" / "python.md"
    done = subprocess.run([sys.executable, REPOSITORY / "python" / "docs" / "reference.py", tmp_path / "python.md"], capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}, check=False)
    assert done.returncode == 0, done.stderr
    stale = list(difflib.unified_diff(page.read_text().splitlines(), (tmp_path / "python.md").read_text().splitlines(), "stored", "fresh", lineterm=""))
    assert not stale, "write it again: python3 python/docs/reference.py docs/reference/python.md\n" + "\n".join(stale[:40])


def test_names_of_the_guide_are_there() -> None:
    """Every name `sf.NAME` and `run.NAME` of the guide is there."""
    import semfield as sf

    text = GUIDE.read_text()
    assert all(hasattr(sf, name) for name in re.findall(r"\bsf\.(\w+)", text))
    attributes = set(vars(sf.Run)) | {"labels", "name", "bounds", "near_m", "far_m", "metric", "device", "left_out", "has_semantics"}
    assert set(re.findall(r"\brun\.(\w+)", text)) <= attributes
