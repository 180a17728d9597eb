#!/usr/bin/env python3
"""How well one click finds a thing on the labelling page, how long an answer takes, and what clicks count.

    studies/things.py configs/quickstart.yaml --ignore wall,floor,ceiling --set scene.instances=pieces

A simulated person clicks the most interior point of an instance in a view, then up to twice the most interior point of
the largest wrong region. IoU is that of the mask at the photograph's size; void pixels do not count. `wheel` is the best
of the levels that two turns of the wheel reach after one click. Training continues meanwhile. Segments of the scene
serve as truth alone: the page knows those of --segments.
"""
import argparse
import contextlib
import json
import pathlib
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

import semfield as sf
from common import png_values, settings, table
from labelling import Page
from semfield.program import program


def truths(run, options, words, folder):
    """Of the name of a frame: [H, W] numbers of instances, 0 for stuff, -1 for void."""
    names = [frame.name for frame in run.frames]
    things = [c.id for c in run.classes if c.name not in options.ignore.split(",")]
    valid = [c.id for c in run.classes]
    if not options.instances:
        subprocess.run([program(), "-q", "pack", options.config, "--format", "replica", "--out", folder, *words], check=True)

    def of(name):
        file = pathlib.Path(options.instances, f"{name}.png")
        if not options.instances:
            file = pathlib.Path(folder, "semantic_instance", f"semantic_instance_{names.index(name)}.png")
        labels, instances = run.pixels(name).labels, png_values(file.read_bytes())
        return np.where(np.isin(labels, things), instances, np.where(np.isin(labels, valid), 0, -1))
    return of


def interior(mask):
    """[x, y] of the middle of a pixel that lies farthest inside, by steps along rows and columns."""
    mask = np.pad(mask, 1)
    while mask.any():
        last = mask
        mask = mask & np.roll(mask, 1, 0) & np.roll(mask, -1, 0) & np.roll(mask, 1, 1) & np.roll(mask, -1, 1)
    rows, columns = np.nonzero(last)
    middle = len(rows) // 2
    return [float(columns[middle]) - 0.5, float(rows[middle]) - 0.5]


def largest(mask):
    """The connected part of the mask with the most pixels."""
    up, runs, before = [], [], []  # of each run of a row: the run that stands for its part; (row, begin, end)

    def part(run):
        while up[run] != run:
            run = up[run]
        return run
    for y, row in enumerate(np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)):
        own = []
        for begin, end in zip(np.flatnonzero(row == 1), np.flatnonzero(row == -1)):
            number = len(runs)
            up.append(number)
            runs.append((y, begin, end))
            own.append(number)
            for other in before:
                if runs[other][1] < end and begin < runs[other][2]:
                    a, b = sorted((part(other), part(number)))
                    up[b] = a
        before = own
    pixels = {}
    for number, (_, begin, end) in enumerate(runs):
        pixels[part(number)] = pixels.get(part(number), 0) + end - begin
    most = max(pixels, key=pixels.get, default=None)
    out = np.zeros_like(mask)
    for number, (y, begin, end) in enumerate(runs):
        if part(number) == most:
            out[y, begin:end] = True
    return out


class Person:
    def __init__(self, page):
        self.page, self.answers = page, []

    def thing(self, view, also, without, level):
        begin = time.perf_counter()
        facts, mask = self.page.parts("/thing", {"client": "person", "view": view, "also": also, "not": without,
                                                 "level": level})
        self.answers.append(1e3 * (time.perf_counter() - begin))
        return json.loads(facts), png_values(mask) > 0

    def course(self, view, truth, instance):
        """IoU after each of three clicks, and the best within two turns of the wheel."""
        wanted, counts = truth == instance, truth >= 0
        iou = lambda mask: float((mask & wanted).sum() / ((mask & counts) | wanted).sum())
        also, without, found, wheel = [interior(wanted)], [], [], 0.0
        for click in range(3):
            facts, mask = self.thing(view, also, without, 0)
            if mask.shape != wanted.shape:
                sys.exit(f"things: the mask has {mask.shape} pixels, the truth {wanted.shape}")
            found.append(iou(mask))
            if click == 0:
                levels = range(max(-2, facts["least"]), min(2, facts["most"]) + 1)
                wheel = max(iou(self.thing(view, also, without, level)[1]) for level in levels)
            missing, extra = largest(wanted & ~mask), largest(mask & counts & ~wanted)
            if not missing.any() and not extra.any():
                return found + [found[-1]] * (2 - click), wheel
            if missing.sum() >= extra.sum():
                also.append(interior(missing))
            else:
                without.append(interior(extra))
        return found, wheel


def miscounted(run, options, words, truth_of, folder):
    """The share of things that `semfield objects` counts wrongly in a run of all labels, from one click on each: where it
    has the most pixels."""
    best = {}
    for frame in run.frames:
        if frame.split != "train":
            continue
        truth, labels = truth_of(frame.name), run.pixels(frame.name).labels
        sizes = np.bincount(truth[truth > 0].ravel(), minlength=1)
        for i in np.flatnonzero(sizes):
            if sizes[i] > best.get(int(i), (0,))[0]:
                best[int(i)] = int(sizes[i]), frame.name, truth == i, labels
    name_of = {c.id: c.name for c in run.classes}
    with open(f"{folder}/clicks.jsonl", "w", encoding="utf-8") as file:
        for i, (_, frame, wanted, labels) in best.items():
            x, y = interior(wanted)
            event = {"id": f"thing-{i}", "type": "click", "time_ms": 1, "frame": frame, "size": wanted.shape[::-1],
                     "points": [[x, y]], "radius": 0, "class": name_of[int(labels[int(y), int(x)])], "object": i}
            file.write(json.dumps(event) + "\n")
    subprocess.run([program(), "-q", "train", options.config, "--out", f"{folder}/all", *words], check=True,
                   stdout=subprocess.PIPE)
    done = subprocess.run([program(), "-q", "objects", f"{folder}/all", "--segments", f"{folder}/clicks.jsonl", "--score",
                           "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode == 65:  # it has said why: the field is still fog, and there are no objects
        return 1.0
    done.check_returncode()
    return json.loads(done.stdout)["score"]["miscounted"]


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("config", help="of a scene with labels and instances")
    p.add_argument("--ignore", default="", help="names of classes that are stuff, separated by commas")
    p.add_argument("--instances", default="", help="folder of PNGs of numbers of things, by the names of frames (default: "
                                                   "the scene's own, where its lens has no distortion)")
    p.add_argument("--segments", default="", help="what the page gets of a segmenter, as `semfield serve --segments`")
    p.add_argument("--things", type=int, default=200, help="instances in views, spread over views")
    p.add_argument("--pixels", type=int, default=600, help="labelled ones that an instance has at least")
    p.add_argument("--geometry", type=float, default=60, help="seconds of training before the first click")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = p.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the served run ends too
    words = [word for setting in options.set for word in ("--set", setting)]
    with tempfile.TemporaryDirectory() as folder, sf.open(options.config, settings(options.set)) as run:
        truth_of = truths(run, options, words, f"{folder}/truth")
        more = ["--segments", options.segments] if options.segments else []
        with contextlib.closing(Page(options.config, folder, [*words, *more, "--set", "scene.labels.frames=none"])) as page:
            page.wait_for_geometry(options.geometry)
            cases = []
            for number, view in enumerate(page.state()["views"]):
                if view["held_out"]:
                    continue
                truth = truth_of(view["frame"])
                sizes = np.bincount(truth[truth > 0].ravel(), minlength=1)
                cases += [(number, truth, int(i)) for i in np.flatnonzero(sizes >= options.pixels)]
            random.Random(1).shuffle(cases)
            cases = sorted(cases[:options.things], key=lambda case: case[0])
            person, rows, wheels, firsts, seen = Person(page), [], [], [], -1
            for view, truth, instance in cases:
                before = len(person.answers)
                found, wheel = person.course(view, truth, instance)
                rows.append(found)
                wheels.append(wheel)
                if view != seen:
                    firsts.append(person.answers[before])
                seen = view
        wrong = miscounted(run, options, words, truth_of, folder)
    medians = [statistics.median(row[click] for row in rows) for click in range(3)]
    print(table(["", "1 click", "2 clicks", "3 clicks", "1 click and the wheel"],
                [["median IoU", *(f"{m:.3f}" for m in medians), f"{statistics.median(wheels):.3f}"],
                 ["mean IoU", *(f"{statistics.mean(row[c] for row in rows):.3f}" for c in range(3)),
                  f"{statistics.mean(wheels):.3f}"]]))
    print(f"things: things={len(rows)} iou1={medians[0]:.3f} iou2={medians[1]:.3f} iou3={medians[2]:.3f} "
          f"wheel={statistics.median(wheels):.3f} answer_p50_ms={statistics.median(person.answers):.0f} "
          f"answer_p95_ms={np.percentile(person.answers, 95):.0f} first_p50_ms={statistics.median(firsts):.0f} "
          f"first_p95_ms={np.percentile(firsts, 95):.0f} miscounted={wrong:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
