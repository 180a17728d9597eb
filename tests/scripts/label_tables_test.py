"""scripts/label_tables on a small results.csv: label_tables_test.py SCRIPT."""
import subprocess
import sys
import tempfile

ROWS = """experiment,scene,variant,seed,metric,value
labels_fast,walk,click,1,miou_present,0.6
labels_fast,walk,click,2,miou_present,0.8
labels_paper,walk,click,1,miou_present,0.5
labels_paper,walk,click,2,miou_present,0.6
labels_today,walk,click,1,miou_present,0.3
labels_today,walk,click,2,miou_present,0.5
labels_fast,walk,all,1,miou_present,0.9
labels_paper,other,all,1,miou_present,0.1
labels_fast,walk,click,1,psnr,30
labels_today,walk,click,1,psnr,29
labels_fast,walk,click,1,train_s,12
labels_today,walk,click,1,train_s,10
labels_fast,walk,click,1,steps,100
labels_today,walk,click,1,steps,100
"""
LAST = ("labels: click=0.700/0.550 p01=n/a/n/a p10=n/a/n/a noise90=n/a/n/a two=n/a/n/a f10=n/a/n/a sr16=n/a/n/a "
        "all=n/a/n/a psnr=30.00/29.00 step=1.20")  # `all`: no cell that both have


def run(*words):
    return subprocess.run([sys.executable, sys.argv[1], *words], capture_output=True, text=True, encoding="utf-8")


def lines_of(*words):
    done = run(*words)
    assert done.returncode == 0, done.stderr
    return [" ".join(line.split()) for line in done.stdout.splitlines()]


def csv_rows(metric, variant, scene, *networks):
    """A row per seed for the branch, the paper's networks and the grid alone."""
    return "".join(f"labels_{name},{scene},{variant},{seed},{metric},{value}\n"
                   for name, seeds in zip(("fast", "paper", "today"), networks) for seed, value in enumerate(seeds, 1))


with tempfile.TemporaryDirectory() as folder:
    def write(name, text):
        with open(f"{folder}/{name}", "w", encoding="utf-8") as file:
            file.write(text)
        return f"{folder}/{name}"

    write("results.csv", ROWS)
    lines = lines_of(folder)
    assert lines[-1] == LAST, lines[-1]
    # t(0.975, 1) = 12.706 times the standard error, half of the distance of two seeds.
    assert "click 0.700 ± 1.271 0.550 ± 0.635 0.400 ± 1.271 2" in lines, lines
    assert "all n/a n/a n/a 0" in lines, lines
    assert "ECE: no cell that all three have" in lines and "AUROC of entropy: no cell that all three have" in lines, lines

    write("results.csv", ROWS + csv_rows("frames", "click", "walk", (30,), (30,), (30,)) + csv_rows("pixels", "click", "walk", (900,), (900,), (900,)))
    assert lines_of(folder)[-1] == LAST
    write("results.csv", ROWS + csv_rows("frames", "click", "walk", (30,), (15,), (30,)))
    done = run(folder)
    assert done.returncode == 1 and "the networks were scored on other frames" in done.stderr, done

    more = ROWS
    # Three seeds, t(0.975, 2) = 4.3027: standard deviation 0.1, half width 0.2484; 0 in the other scene; 0.2484 / 2 of both.
    more += csv_rows("ece", "1 %", "walk", (0.1, 0.2, 0.3), (0.5,) * 3, (0.5,) * 3)
    more += csv_rows("ece", "1 %", "room", (0.4,) * 3, (0.3,) * 3, (0.1,) * 3)
    more += csv_rows("entropy_auroc", "click", "walk", (0.75,), (0.5,), (0.25,))  # one seed: no interval
    # Two seeds in one scene, one in the other: the mean has no interval, the scene has.
    more += csv_rows("entropy_auroc", "10 %", "walk", (0.7, 0.8), (0.5, 0.6), (0.2, 0.3))
    more += csv_rows("entropy_auroc", "10 %", "room", (0.9,), (0.8,), (0.7,))
    # t(0.975, 3) = 3.1824 and t(0.975, 4) = 2.7764.
    more += csv_rows("ece", "all", "walk", (0.1, 0.2, 0.3, 0.4), (0.5,) * 4, (0.5,) * 4)
    more += csv_rows("ece", "click", "walk", (0.1, 0.2, 0.3, 0.4, 0.5), (0.5,) * 5, (0.5,) * 5)
    path = write("more.csv", more)
    lines = lines_of(path)
    assert lines[-1] == LAST, "further tables leave the last line as it is"
    for want in ("mIoU branch paper today cells", "ECE branch paper today cells", "1 % 0.300 ± 0.124 0.400 ± 0.000 0.300 ± 0.000 6",
                 "all 0.250 ± 0.205 0.500 ± 0.000 0.500 ± 0.000 4", "click 0.300 ± 0.196 0.500 ± 0.000 0.500 ± 0.000 5",
                 "AUROC of entropy branch paper today cells", "click 0.750 0.500 0.250 1", "10 % 0.800 0.633 0.400 3"):
        assert want in lines, (want, lines)
    assert not any("walk" in line for line in lines), lines

    lines = lines_of("--scenes", path)
    assert lines[-1] == LAST, lines[-1]
    for want in ("ECE, walk branch paper today cells", "1 % 0.200 ± 0.248 0.500 ± 0.000 0.500 ± 0.000 3",
                 "ECE, room branch paper today cells", "1 % 0.400 ± 0.000 0.300 ± 0.000 0.100 ± 0.000 3",
                 "10 % 0.750 ± 0.635 0.550 ± 0.635 0.250 ± 0.635 2", "10 % 0.900 0.800 0.700 1",
                 "mIoU, room: no cell that all three have"):
        assert want in lines, (want, lines)

    lines = lines_of("--markdown", path)
    assert lines[-1] == LAST, lines[-1]
    start = lines.index("| ECE | branch | paper | today | cells |")
    assert lines[start + 1] == "|---|---|---|---|---|", lines[start + 1]
    assert lines[start + 3] == "| 1 % | 0.300 ± 0.124 | 0.400 ± 0.000 | 0.300 ± 0.000 | 6 |", lines[start + 3]
    assert lines[start + 10] == "", "eight settings, then an empty line"

    missing = run(folder + "/absent")
    assert missing.returncode != 0 and "semfield sweep" in missing.stderr, missing.stderr
    other = run(write("other.csv", "a,b\n1,2\n"))
    assert other.returncode != 0 and "expected the columns" in other.stderr, other.stderr
    unknown = run("--scene-tables", path)
    assert unknown.returncode != 0 and "--scene-tables" in unknown.stderr, unknown.stderr
