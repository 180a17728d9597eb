"""Every study in a smoke mode of a few seconds: studies_test.py FOLDER_OF_STUDIES STUDY."""
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile

STUDIES, NAME = pathlib.Path(sys.argv[1]), sys.argv[2]
SMALL = ["--set", "scene.frames=10", "--set", "scene.test_frames=2", "--set", "scene.width_px=40", "--set",
         "scene.height_px=30"]


def run(*words, code=0):
    done = subprocess.run([sys.executable, STUDIES / f"{NAME}.py", *map(str, words)], capture_output=True, text=True,
                          check=False, cwd=STUDIES.parent)
    assert done.returncode == code, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def quadrature(folder):
    out = run("--rays", 256, "--out", folder)
    assert "order_ok=80/80" in out, "every order of a smooth medium is the predicted one"
    for row in ("| midpoint | 2.00 (2.00) |", "| 1.2e-04 | 4.6e-07 |"):  # of docs/reference/quadrature.md
        assert row in out, row
    assert (folder / "tables.md").read_text() in out


def leave_out(folder):
    # Statistical pairs need seeds and minutes, and one pair lags by nature.
    pairs = run("--help").replace("\n", " ").split("with commas:")[1].split("--rounds")[0].replace(" ", "").split(",")
    slow = {"absent_classes", "empty_space_threshold", "table_size", "view_branch", "empty_space_lagging"}
    shipped = STUDIES.parent / "docs/reference/leave_out.json"
    data = shutil.copy(shipped, folder)
    named = {row["name"] for row in json.loads(shipped.read_text())["rows"]}
    assert set(pairs) <= named, set(pairs) - named
    out = run("--rounds", 2, "--most-steps", 40, "--set", "train.rays=96", *SMALL, "--data", data, "--only",
              ",".join(p for p in pairs if p not in slow))
    assert "leave_out: pairs=15 hold=all" in out, out
    assert out.count("nothing was left out") == 1, "in the room as it is learned alone\n" + out
    assert {row["name"] for row in json.loads(pathlib.Path(data).read_text())["rows"]} == named


def labelling(folder):
    out = run("--questions", "surface", "--seeds", 1, "--clicks", 3, "--geometry", 1, "--device", "cpu", *SMALL)
    assert "mIoU after 3" in out and "answer_p50_ms=" in out, out


def things(folder):
    out = run("configs/quickstart.yaml", "--ignore", "wall,floor,ceiling", "--things", 3, "--pixels", 20, "--geometry", 1,
              *SMALL, "--set", "scene.instances=pieces", "--set", "runtime.device=cpu", "--set", "train.steps=300")
    assert "things: things=3 iou1=" in out, out


with tempfile.TemporaryDirectory() as name:
    {"quadrature": quadrature, "leave_out": leave_out, "labelling": labelling, "things": things}[NAME](pathlib.Path(name))
