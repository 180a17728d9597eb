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


def run(*words):
    return subprocess.run([sys.executable, sys.argv[1], *words], capture_output=True, text=True)


with tempfile.TemporaryDirectory() as folder:
    with open(folder + "/results.csv", "w", encoding="utf-8") as file:
        file.write(ROWS)
    done = run(folder)
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    want = ("labels: click=0.700/0.550 p01=n/a/n/a p10=n/a/n/a noise90=n/a/n/a two=n/a/n/a f10=n/a/n/a sr16=n/a/n/a "
            "all=n/a/n/a psnr=30.00/29.00 step=1.20")  # `all`: no cell that both have
    assert last == want, last
    missing = run(folder + "/absent")
    assert missing.returncode != 0 and "semfield sweep" in missing.stderr, missing.stderr
    with open(folder + "/other.csv", "w", encoding="utf-8") as file:
        file.write("a,b\n1,2\n")
    other = run(folder + "/other.csv")
    assert other.returncode != 0 and "expected the columns" in other.stderr, other.stderr
