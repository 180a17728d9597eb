"""scripts/benchmark with a program that returns figures at once: benchmark_test.py SCRIPT."""
import json
import os
import stat
import subprocess
import sys
import tempfile

PROGRAM = """#!/usr/bin/env python3
import json, os, sys
words = sys.argv[1:]
if words[0] == "train":
    run = words[words.index("--out") + 1]
    os.makedirs(run)
    open(os.path.join(run, "environment.json"), "w").write(json.dumps({"cpu": "a CPU", "threads": 2}))
    assert open(words[1]).read() if words[1].endswith("lego.yaml") else True
    print(json.dumps({"steps": 7}))
else:
    seconds = float(words[1].rsplit("_", 1)[1])
    print(json.dumps({"psnr": 20 + seconds, "absrel": 0.05, "miou_present": None, "frames": 3, "per_frame": [{"psnr": 21}, {"psnr": 24}]}))
"""


def run(*words):
    return subprocess.run([sys.executable, sys.argv[1], *words], capture_output=True, text=True, encoding="utf-8")


with tempfile.TemporaryDirectory() as folder:
    program = os.path.join(folder, "semfield")
    with open(program, "w") as file:
        file.write(PROGRAM)
    os.chmod(program, os.stat(program).st_mode | stat.S_IXUSR)
    os.makedirs(os.path.join(folder, "scenes", "lego"))
    scenes, figures, page = (os.path.join(folder, name) for name in ("scenes", "figures.json", "page.md"))
    common = [scenes, "--program", program, "--json", figures, "--page", page]

    done = run(*common, "--scenes", "lego,studio", "--times", "5")
    assert done.returncode == 0, done.stderr
    assert "studio: left out" in done.stderr, done.stderr
    last = done.stdout.splitlines()[-1]
    assert last.startswith("benchmark: lego_5s=25.00 lego_60s=n/a ") and " studio=n/a " in last, last

    # A second call adds to the figures of the first, and replaces one of the same scene, time and device.
    done = run(*common, "--scenes", "lego", "--times", "5,60")
    assert done.returncode == 0, done.stderr
    with open(figures) as file:
        rows = json.load(file)
    assert sorted(row["seconds"] for row in rows) == [5, 60], rows
    assert "lego_5s=25.00 lego_60s=80.00" in done.stdout, done.stdout
    with open(page) as file:
        text = file.read()
    assert "| lego | `object` | 60 s | 7 | 80.00 | 22.50 | – | 0.050 | – | 3 | a CPU, 2 threads |" in text, text
    assert "36.4" in text, "published figures"

    done = run(*common, "--scenes", "legos")
    assert done.returncode == 2 and "unknown scene 'legos'" in done.stderr, done.stderr
