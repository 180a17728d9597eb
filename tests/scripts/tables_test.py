"""Label tables of a small results.csv, object tables of a program that only answers: tables_test.py RELEASE_CHECK."""
import json
import pathlib
import subprocess
import sys
import tempfile

HEAD = "experiment,scene,variant,seed,metric,value\n"
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


def rows(metric, variant, scene, *networks):
    """A row per seed for the branch, the paper's networks and the grid alone."""
    return "".join(f"labels_{name},{scene},{variant},{seed},{metric},{value}\n"
                   for name, seeds in zip(("fast", "paper", "today"), networks) for seed, value in enumerate(seeds, 1))


def check_labels(folder):
    def tables(text, *words):
        (folder / "results.csv").write_text(HEAD + text, encoding="utf-8")
        return lines_of("label_tables", folder, *words)

    base = rows("miou_present", "click", "walk", (0.6, 0.8), (0.5, 0.6), (0.3, 0.5))
    base += rows("miou_present", "all", "walk", (0.9,)) + rows("miou_present", "all", "other", (), (0.1,))  # none has both
    for metric, branch, grid in (("psnr", 30, 29), ("train_s", 12, 10), ("steps", 100, 100)):
        base += rows(metric, "click", "walk", (branch,), (), (grid,))
    last = ("labels: click=0.700/0.550 p01=n/a/n/a p10=n/a/n/a noise90=n/a/n/a two=n/a/n/a f10=n/a/n/a sr16=n/a/n/a "
            "all=n/a/n/a psnr=30.00/29.00 step=1.20")
    lines = tables(base)
    assert lines[-1] == last, lines[-1]
    # t(0.975, 1) = 12.706 times the standard error, half of the distance of two seeds.
    assert "| click | 0.700 ± 1.271 | 0.550 ± 0.635 | 0.400 ± 1.271 | 2 |" in lines, lines
    assert "| all | n/a | n/a | n/a | 0 |" in lines and "ECE: no cell that all three have" in lines, lines

    # Three seeds, t(0.975, 2) = 4.3027: standard deviation 0.1, half width 0.2484; 0 in the other scene; 0.2484 / 2 of both.
    more = rows("ece", "1 %", "walk", (0.1, 0.2, 0.3), (0.5,) * 3, (0.5,) * 3)
    more += rows("ece", "1 %", "room", (0.4,) * 3, (0.3,) * 3, (0.1,) * 3)
    # Two seeds in one scene, one in the other: the mean has no interval, the scene has.
    more += rows("entropy_auroc", "10 %", "walk", (0.7, 0.8), (0.5, 0.6), (0.2, 0.3))
    more += rows("entropy_auroc", "10 %", "room", (0.9,), (0.8,), (0.7,))
    # t(0.975, 3) = 3.1824 and t(0.975, 4) = 2.7764.
    more += rows("ece", "all", "walk", (0.1, 0.2, 0.3, 0.4), (0.5,) * 4, (0.5,) * 4)
    more += rows("ece", "click", "walk", (0.1, 0.2, 0.3, 0.4, 0.5), (0.5,) * 5, (0.5,) * 5)
    lines = tables(base + more, "--scenes")
    assert lines[-1] == last, lines[-1]
    for want in ("| ECE | branch | paper | today | cells |", "| 1 % | 0.300 ± 0.124 | 0.400 ± 0.000 | 0.300 ± 0.000 | 6 |",
                 "| all | 0.250 ± 0.205 | 0.500 ± 0.000 | 0.500 ± 0.000 | 4 |",
                 "| click | 0.300 ± 0.196 | 0.500 ± 0.000 | 0.500 ± 0.000 | 5 |", "| 10 % | 0.800 | 0.633 | 0.400 | 3 |",
                 "| ECE, walk | branch | paper | today | cells |", "| 1 % | 0.200 ± 0.248 | 0.500 ± 0.000 | 0.500 ± 0.000 | 3 |",
                 "| 10 % | 0.750 ± 0.635 | 0.550 ± 0.635 | 0.250 ± 0.635 | 2 |", "| 10 % | 0.900 | 0.800 | 0.700 | 1 |",
                 "mIoU, room: no cell that all three have"):
        assert want in lines, (want, lines)
    assert not any("walk" in line for line in tables(base + more))

    (folder / "results.csv").write_text(HEAD + base + rows("frames", "click", "walk", (30,), (15,), (30,)))
    assert run("label_tables", folder).returncode == 1, "scored on other frames"
    (folder / "other.csv").write_text("a,b\n1,2\n")
    assert run("label_tables", folder / "other.csv").returncode == 1
    assert run("label_tables", folder / "absent").returncode == 1


def check_objects(folder):
    for room in ("living", "class", "room"):
        (folder / room / "checkpoints").mkdir(parents=True)
        (folder / room / "note").write_text("")
    (folder / "bin").mkdir()
    (folder / "bin" / "semfield").write_text(PROGRAM)
    (folder / "bin" / "semfield").chmod(0o755)
    words = ("object_tables", folder, "--build", folder, "--out", folder / "out")
    lines = lines_of(*words, "--cpu")
    assert lines[-1] == ("objects: exact_pq=0.700 degraded_pq=0.400 assignment_pq=0.600 peer_pq=n/a replica_pq=n/a "
                         "seconds_gpu=n/a peer_seconds=n/a cpu_pq=0.700 cpu_seconds=7.000 miou_change=0.000 "
                         "psnr_change=0.000 count_error=0.100"), lines[-1]
    # Three seeds a hundredth apart: 4.303 * 0.01 / sqrt(3).
    assert any(line.startswith("| living | exact | 0.900 ± 0.025 |") for line in lines), lines
    (folder / "class" / "note").write_text("LEARNS")
    assert "miou_change=n/a psnr_change=n/a" in lines_of(*words)[-1], "a run that was changed was not noticed"
    assert run(*words, "--only", "attic").returncode == 1

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
    check_labels(pathlib.Path(name))
    check_objects(pathlib.Path(name))
