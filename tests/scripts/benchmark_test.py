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
elif words[0] == "tune":
    assert words[1].endswith("_on_device.yaml") and words[words.index("--length") + 1] == "5s", words
    open(words[words.index("--write") + 1], "w").write("include: lego.yaml")
    print("{}")
else:
    seconds = float(words[1].rsplit("_", 1)[1])
    seconds += 2 * ("_tuned_" in words[1])
    print(json.dumps({"psnr": 20 + seconds, "absrel": 0.05, "miou_present": None, "frames": 3, "per_frame": [{"psnr": 21}, {"psnr": 24}]}))
"""


def run(*words):
    environment = {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run([sys.executable, sys.argv[1], *words], capture_output=True, text=True, encoding="utf-8", env=environment)


def write_program(path, text):
    with open(path, "w") as file:
        file.write(text)
    os.chmod(path, os.stat(path).st_mode | stat.S_IXUSR)


with tempfile.TemporaryDirectory() as folder:
    program = os.path.join(folder, "semfield")
    write_program(program, PROGRAM)
    os.makedirs(os.path.join(folder, "scenes", "lego"))
    scenes, figures = (os.path.join(folder, name) for name in ("scenes", "figures.json"))
    common = [scenes, "--program", program, "--json", figures]

    done = run(*common, "--scenes", "lego,studio", "--times", "5")
    assert done.returncode == 0, done.stderr
    assert "studio: left out" in done.stderr, done.stderr
    last = done.stdout.splitlines()[-1]
    assert last.startswith("benchmark: lego_15s=n/a lego_60s=n/a ") and " studio_10s=n/a " in last, last

    # A second call adds to the figures of the first, and replaces one of the same scene, time and device.
    done = run(*common, "--scenes", "lego", "--times", "5,60")
    assert done.returncode == 0, done.stderr
    with open(figures) as file:
        rows = json.load(file)
    assert sorted(row["seconds"] for row in rows) == [5, 60], rows
    assert " lego_60s=80.00" in done.stdout, done.stdout
    assert (rows[-1]["preset"], rows[-1]["steps"], rows[-1]["psnr_of_views"], rows[-1]["device"]) == ("object", 7, 22.5, "a CPU, 2 threads"), rows

    # Tuned for its shortest time, each time is measured again.
    done = run(*common, "--scenes", "lego", "--times", "5,60", "--tune", "2m")
    assert done.returncode == 0, done.stderr
    with open(figures) as file:
        rows = json.load(file)
    assert [(row["preset"], row["seconds"]) for row in rows] == [("object", 5), ("object", 60), ("tuned", 5), ("tuned", 60)], rows
    assert "lego_60s=80.00" in done.stdout and "tuned_gain_cpu=2.00 tuned_worst_cpu=2.00" in done.stdout, done.stdout
    assert "tuned_gain_gpu=n/a" in done.stdout, done.stdout

    # Figures of other frames or pixels are no measure of these.
    for what in ('"frames": 3', '"pixels": 900'):
        other = what.replace("3", "4").replace("900", "400")
        write_program(program, PROGRAM.replace('"frames": 3', '"frames": 3, "pixels": 900'))
        assert run(*common, "--scenes", "lego", "--times", "5").returncode == 0
        write_program(program, PROGRAM.replace('"frames": 3', '"frames": 3, "pixels": 900').replace(what, other))
        done = run(*common, "--scenes", "lego", "--times", "60")
        assert done.returncode == 1 and "figures of other frames or pixels do not compare" in done.stderr, (what, done)
    write_program(program, PROGRAM)

    done = run(*common, "--scenes", "legos")
    assert done.returncode == 2, done.stderr
