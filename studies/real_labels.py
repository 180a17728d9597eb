#!/usr/bin/env python3
"""How good labels of a real room become: few, coarse and wrong ones, clicks by the page's questions, things by one click.

    studies/real_labels.py configs/real_room.yaml --out runs/real_labels --ignore wall,floor

It runs the settings of configs/experiments/real_labels.yaml on the scene, then studies/labelling.py and studies/things.py.
`semfield prepare` should have mended the cameras. What has been made in --out is not made again. The last line has means over seeds:
mIoU of held-out views with all labels (all), with one labelled pixel of each class and frame (click), within 8 pixels of
borders (click_border), with 1 % and with the labels of a tenth of the frames; of labels that cling to the photographs,
behind each the field's own. Then clicks by questions until mIoU is 0.6, the share of wrong pixels in specks, IoU of a
thing after one and three clicks, the median time of an answer, things miscounted, and the calibration error.
"""
import argparse
import csv
import pathlib
import re
import statistics
import subprocess
import sys

from common import write
from semfield.program import program

HERE = pathlib.Path(__file__).resolve().parent
SWEEP = HERE.parent / "configs" / "experiments" / "real_labels.yaml"


def last_line(words, path):
    """What a study printed last; kept in `path`."""
    if not path.is_file():
        done = subprocess.run([sys.executable, *map(str, words)], stdout=subprocess.PIPE, text=True)
        if done.returncode != 0:
            sys.exit(f"real_labels: {' '.join(map(str, words))} ended with {done.returncode}")
        write(path, done.stdout)
    print(path.read_text())
    return dict(re.findall(r"(\w+)=(\S+)", path.read_text().strip().split("\n")[-1]))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("config", type=pathlib.Path, help="of a scene with labels of all frames, and held-out frames")
    p.add_argument("--out", type=pathlib.Path, required=True)
    p.add_argument("--ignore", default="", help="names of classes that are stuff, separated by commas")
    p.add_argument("--instances", default="", help="as of studies/things.py")
    p.add_argument("--device", default="auto")
    p.add_argument("--seeds", type=int, default=3)
    p.add_argument("--steps", type=int, default=4000, help="of training, for each setting")
    p.add_argument("--clicks", type=int, default=200, help="by questions, for each seed")
    p.add_argument("--geometry", type=int, default=30, help="seconds of training before the first click")
    options = p.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    sweep = options.out / "sweep.yaml"
    write(sweep, f"include: {SWEEP}\nname: real_labels\nuse_scenes: [scene]\n"
                 f"scenes: {{scene: {{base: {options.config.resolve()}}}}}\nseeds: {list(range(1, options.seeds + 1))}\n"
                 f"set: {{train.steps: {options.steps}, runtime.device: {options.device}}}\n")
    if subprocess.run([program(), "sweep", sweep, "--out", options.out / "sweep"]).returncode != 0:
        return 1
    values = {}
    with open(options.out / "sweep" / "results.csv", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            values.setdefault((row["variant"], row["metric"]), []).append(float(row["value"] or "nan"))
    mean = lambda variant, metric: statistics.mean(values[variant, metric])
    pair = lambda variant, metric: f"{mean(variant, 'photo_' + metric):.3f}/{mean(variant, metric):.3f}"
    shared = ["--device", options.device, "--geometry", options.geometry]
    asked = last_line([HERE / "labelling.py", options.config, "--questions", "surface", "--seeds", options.seeds, "--clicks",
                       options.clicks, *shared], options.out / "labelling.txt")
    things = last_line([HERE / "things.py", options.config, "--ignore", options.ignore, "--geometry", options.geometry,
                        "--instances", options.instances, "--set", f"runtime.device={options.device}"], options.out / "things.txt")
    print(f"real_labels: all={pair('all', 'miou_present')} click={pair('click', 'miou_present')} "
          f"click_border={pair('click', 'border_miou')} p1={pair('1 %', 'miou_present')} "
          f"frames10={pair('10 % of the frames', 'miou_present')} clicks_to_06={asked.get('clicks_to_06', '-')} "
          f"specks={pair('click', 'specks')} iou1={things.get('iou1', '-')} iou3={things.get('iou3', '-')} "
          f"answer_ms={things.get('answer_p50_ms', '-')} miscounted={things.get('miscounted', '-')} ece={pair('click', 'ece')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
