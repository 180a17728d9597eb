"""The worked examples, with few steps, as a reader would start them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest

import semfield as sf

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
if not EXAMPLES.is_dir():
    pytest.skip(f"there is no {EXAMPLES}: the examples are not tested", allow_module_level=True)


def play(folder: Path, *words: Any, steps: int) -> str:
    """Runs a command in `folder`; what it prints."""
    done = subprocess.run([sys.executable, *map(str, words)], cwd=folder, capture_output=True, text=True, timeout=300, check=False,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "MPLBACKEND": "agg",
                               "SEMFIELD_EXAMPLE_STEPS": str(steps)})
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_try_a_loss(tmp_path: Path) -> None:
    said = play(tmp_path, EXAMPLES / "try_a_loss.py", steps=120)
    scores = [float(part.split()[-1]) for part in said.split("half of the labels wrong: ")[1].split(",")]
    assert len(scores) == 2 and 0 < min(scores) and max(scores) < 1, said


def test_ask_by_words(tmp_path: Path) -> None:
    said = play(tmp_path, EXAMPLES / "ask_by_words.py", steps=200)
    share, of_maps = (float(part.split(" ")[-1]) for part in said.strip().splitlines()[-1].split(";"))
    assert 0.3 < share < 1 and 0.3 < of_maps <= 1, said


def test_train_and_label(tmp_path: Path) -> None:
    said = play(tmp_path, EXAMPLES / "train_and_label.py", "out", steps=300)
    share = float(said.split("in the other 22, ")[1].split(" %")[0])
    assert share > 75
    stored = np.load(tmp_path / "out" / "labels.npz")
    assert stored["labels"].shape == (24, 30, 40) and set(np.unique(stored["labels"])) == set(range(5))
    assert list(stored["names"][:2]) == ["0000", "0001"] and stored["entropy"].min() >= 0
    assert sf.load(tmp_path / "out" / "run").step == 300
    assert len(list((tmp_path / "out" / "pictures").glob("*_label.png"))) == 24


def cells(notebook: Path) -> List[Dict[str, Any]]:
    return [c for c in json.loads(notebook.read_text())["cells"] if c["cell_type"] == "code"]


def test_the_notebook(tmp_path: Path) -> None:
    missing = [m for m in ("nbconvert", "ipykernel")
               if subprocess.run([sys.executable, "-c", f"import {m}"], capture_output=True, check=False).returncode != 0]
    if missing:
        pytest.skip(f"{' and '.join(missing)} are not installed (packages python3-nbconvert and python3-ipykernel): "
                    "the notebook is not executed")
    play(tmp_path, "-m", "nbconvert", "--to", "notebook", "--execute", "--ExecutePreprocessor.timeout=200", "--ExecutePreprocessor.kernel_name=python3",
         "--output-dir", tmp_path, "--output", "done", EXAMPLES / "try_an_encoder.ipynb", steps=20)
    done = cells(tmp_path / "done.ipynb")
    said = "\n".join("".join(o.get("text", "")) + "".join(o.get("data", {}).get("text/plain", "")) for c in done for o in c["outputs"])
    assert all(c["execution_count"] for c in done)
    assert "its gradients are right" in said and "'triangle'" in said
    table = [line.split() for line in said.splitlines() if line.split() and line.split()[0] in ("triangle", "frequency", "identity")]
    scores = {row[0]: float(row[1]) for row in table if len(row) == 4}
    assert set(scores) == {"triangle", "frequency", "identity"} and all(5 < psnr < 40 for psnr in scores.values())


def test_the_notebook_is_stored_without_results() -> None:
    assert all(c["outputs"] == [] and c["execution_count"] is None for c in cells(EXAMPLES / "try_an_encoder.ipynb"))
