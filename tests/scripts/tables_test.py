"""Object tables of a program that only answers: tables_test.py RELEASE_CHECK."""
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


def run(*words):
    return subprocess.run([sys.executable, sys.argv[1], *words], capture_output=True, text=True, encoding="utf-8")


def lines_of(*words):
    done = run(*words)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def check_objects(folder):
    for room in ("living", "class", "room"):
        (folder / room / "checkpoints").mkdir(parents=True)
        (folder / room / "note").write_text("")
    (folder / "bin").mkdir()
    (folder / "bin" / "semfield").write_text(PROGRAM)
    (folder / "bin" / "semfield").chmod(0o755)
    words = ("object_tables", folder, "--build", folder, "--out", folder / "out")
    lines = lines_of(*words, "--cpu")
    assert lines[-1] == ("object_tables: exact_pq=0.700 degraded_pq=0.400 assignment_pq=0.600 peer_pq=n/a replica_pq=n/a "
                         "seconds_gpu=n/a peer_seconds=n/a cpu_pq=0.700 cpu_seconds=7.000 miou_change=0.000 "
                         "psnr_change=0.000 count_error=0.100"), lines[-1]
    # Three seeds a hundredth apart: 4.303 * 0.01 / sqrt(3).
    assert any(line.startswith("| living/exact | 0.900 ± 0.025 (3) |") for line in lines), lines
    (folder / "class" / "note").write_text("LEARNS")
    assert "miou_change=n/a psnr_change=n/a" in lines_of(*words)[-1], "a run that was changed was not noticed"
    assert run(*words, "--only", "attic").returncode == 2

    # The file says where its figures come from, and keeps those of the same commit and device alone.
    kept = folder / "objects.json"
    lines_of(*words, "--cpu", "--only", "living", "--json", kept)
    lines_of(*words, "--cpu", "--only", "room", "--seeds", "2", "--json", kept)
    written = json.loads(kept.read_text())
    assert sorted(written["rows"]) == [f"{room}/{case}" for room in ("living", "room")
                                       for case in ("assignment", "degraded", "exact")], written
    assert (written["n"], written["device"]) == (2, "CPU") and all(written[key] for key in ("date", "commit", "command")), written
    kept.write_text(json.dumps({**written, "commit": "another"}))
    lines_of(*words, "--cpu", "--only", "room", "--json", kept)
    assert all(name.startswith("room/") for name in json.loads(kept.read_text())["rows"])


with tempfile.TemporaryDirectory() as name:
    check_objects(pathlib.Path(name))
