"""scripts/object_tables with a program that only answers: object_tables_test.py SCRIPT."""
import json
import pathlib
import subprocess
import sys
import tempfile

PROGRAM = """#!/usr/bin/env python3
import json, pathlib, sys
room, words = pathlib.Path(sys.argv[2]).name, " ".join(sys.argv)
pq = {"living": 0.9, "class": 0.6, "room": 0.6}[room] - (0.3 if "split" in words else 0.1 if "assignment" in words else 0)
pq += 0.01 * (int(words.split("objects.seed=")[1].split()[0]) - 2)
if room == "class" and "LEARNS" in pathlib.Path(sys.argv[2], "note").read_text():
    pathlib.Path(sys.argv[2], "checkpoints", "new").write_text(words)
print(json.dumps({"score": {"pq": pq, "sq": 1, "rq": pq, "mcov": 0.5, "count_error": 0.1}, "seconds": {"all": 7}}))
"""

with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    for room in ("living", "class", "room"):
        (folder / room / "checkpoints").mkdir(parents=True)
        (folder / room / "note").write_text("")
    (folder / "program").write_text(PROGRAM)
    (folder / "program").chmod(0o755)

    def run(*words):
        line = [sys.executable, sys.argv[1], folder, "--semfield", folder / "program", "--out", folder / "out", *words]
        return subprocess.run(line, capture_output=True, text=True, encoding="utf-8")

    done = run("--cpu")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == ("objects: exact_pq=0.700 degraded_pq=0.400 assignment_pq=0.600 peer_pq=n/a replica_pq=n/a seconds_gpu=n/a "
                         "peer_seconds=n/a cpu_pq=0.700 cpu_seconds=7.000 miou_change=0.000 psnr_change=0.0 count_error=0.100"), lines[-1]
    # Three seeds a hundredth apart: 4.303 * 0.01 / sqrt(3).
    assert any(line.startswith("| living | exact | 0.900 ± 0.025 |") for line in lines), lines
    (folder / "class" / "note").write_text("LEARNS")
    assert "miou_change=n/a psnr_change=n/a" in run().stdout, "a run that was changed was not noticed"
    assert run("--only", "attic").returncode != 0

    # The file says where its figures come from, and keeps those of the same commit and device alone.
    kept = folder / "objects.json"
    assert run("--cpu", "--only", "living", "--json", kept).returncode == 0
    assert run("--cpu", "--only", "room", "--seeds", "2", "--json", kept).returncode == 0
    written = json.loads(kept.read_text())
    assert sorted(written["rows"]) == [f"{room}/{case}" for room in ("living", "room") for case in ("assignment", "degraded", "exact")], written
    assert written["n"] == 2 and written["command"] == "scripts/object_tables RUNS --cpu" and written["device"] == "CPU" and written["date"] and written["commit"], written
    kept.write_text(json.dumps({**written, "commit": "another"}))
    assert run("--cpu", "--only", "room", "--json", kept).returncode == 0
    assert all(name.startswith("room/") for name in json.loads(kept.read_text())["rows"]), kept.read_text()
