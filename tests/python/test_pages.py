"""The pages about Python: code blocks of the guide run, and the reference is what the docstrings say."""

from __future__ import annotations

import difflib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List

import pytest

from conftest import box_arrays

REPOSITORY = Path(__file__).resolve().parents[2]
GUIDE = REPOSITORY / "docs" / "guide" / "python.md"
if not GUIDE.is_file():
    pytest.skip(f"there is no {GUIDE}: the pages are not tested", allow_module_level=True)

BLOCK = re.compile(r"(?:^<!-- python: (?P<mark>.*?) -->\n)?^```python\n(?P<text>.*?)^```$", re.M | re.S)
SMALL = {"scene.frames": 12, "scene.test_frames": 2, "scene.width_px": 40, "scene.height_px": 30, "train.steps": 30, "train.rays": 64,
         "passes.0.position.log2_entries": 10, "passes.0.sampler.max_samples": 8}


def blocks() -> List[str]:
    """Code of the guide, made short as the comments before it say: `A => B`, or `not run, why`."""
    found = []
    for block in BLOCK.finditer(GUIDE.read_text()):
        mark, text = block["mark"] or "", block["text"]
        if mark.startswith("not run, "):
            continue
        if mark:
            before, after = mark.split(" => ")
            assert before in text, f"{before} is not in the block behind it"
            text = text.replace(before, after)
        found.append(text)
    return found


def test_the_guides_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    arrays = box_arrays()
    small = {k: v for k, v in SMALL.items() if not k.startswith("passes")}
    known: Dict[str, Any] = {"SMALL": small, "images": arrays["images"], "poses": arrays["poses"], "truth": arrays["labels"],
                             "__name__": "guide"}
    assert len(blocks()) >= 10
    for text in blocks():
        exec(compile(text, str(GUIDE), "exec"), known)
    said = capsys.readouterr().out
    assert "Run('quickstart', step=0" in said and "unknown section 'tarin'" in said and "lamp of the desk" in said
    assert (tmp_path / "runs" / "clicks" / "clicks.jsonl").read_text().count("\n") == 3


def test_the_reference_is_fresh(tmp_path: Path) -> None:
    page = REPOSITORY / "docs" / "reference" / "python.md"
    done = subprocess.run([sys.executable, REPOSITORY / "python" / "docs" / "reference.py", tmp_path / "python.md"], capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}, check=False)
    assert done.returncode == 0, done.stderr
    stale = list(difflib.unified_diff(page.read_text().splitlines(), (tmp_path / "python.md").read_text().splitlines(), "stored", "fresh", lineterm=""))
    assert not stale, "write it anew: python3 python/docs/reference.py docs/reference/python.md\n" + "\n".join(stale[:40])


def test_names_of_the_guide_are_there() -> None:
    """Every name `sf.NAME` and `run.NAME` of the guide is there."""
    import semfield as sf

    text = GUIDE.read_text()
    assert all(hasattr(sf, name) for name in re.findall(r"\bsf\.(\w+)", text))
    attributes = set(vars(sf.Run)) | {"labels", "name", "bounds", "near_m", "far_m", "metric", "device", "left_out", "has_semantics"}
    assert set(re.findall(r"\brun\.(\w+)", text)) <= attributes
