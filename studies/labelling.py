#!/usr/bin/env python3
"""How many clicks a simulated person needs on the labelling page, and how long an answer takes.

    studies/labelling.py CONFIG --clicks 180 --seeds 5 --geometry 30

For each person `semfield serve` trains the scene without labels. The person then names one pixel after the other with
the truth, by the page's own requests: the place that the page proposes (`surface`), or any pixel of any view
(`random`); a pixel that is void in truth is passed over. mIoU is over the classes in the held-out views.
Training continues.
"""
import argparse
import contextlib
import http.client
import itertools
import json
import random
import re
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse

import numpy as np

import semfield as sf
from common import png_values, settings, table
from semfield.program import program

MARKS = (10, 20, 30, 60, 100, 180, 300)  # clicks after which the held-out views are scored


class Page:
    """A served run."""

    def __init__(self, config, folder, words):
        self.process = subprocess.Popen([program(), "serve", config, "--out", f"{folder}/run", *words],
                                        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        said = ""
        for line in self.process.stdout:
            said += line
            if found := re.search(r"http://[\d.]+:\d+/\S+", line):
                self.url = urllib.parse.urlsplit(found.group(0))
                threading.Thread(target=self.process.stdout.read, daemon=True).start()
                return
        sys.exit(f"labelling: semfield serve ended: {said.strip()[-600:]}")

    def request(self, path, body=None):
        connection = http.client.HTTPConnection(self.url.hostname, self.url.port, timeout=120)
        connection.request("GET" if body is None else "POST", self.url.path.rstrip("/") + path,
                           body and json.dumps(body))
        answer = connection.getresponse()
        data = answer.read()
        connection.close()
        if answer.status != 200:
            sys.exit(f"labelling: {path} was answered by {answer.status}: {data[:300]!r}")
        return data

    def parts(self, path, body):
        data, found = self.request(path, body), []
        while data:
            size = struct.unpack_from("<I", data)[0]
            found.append(data[4:4 + size])
            data = data[4 + size:]
        return found

    def state(self, after=0):
        """All of it; with `after` once there is news, which is what the answer has."""
        news = json.loads(self.request(f"/state?after={after}"))
        if after:
            for view in news.pop("views", []):
                self.known["views"][view["index"]].update(view)
            self.known["marks"][news.pop("marks_kept", len(self.known["marks"])):] = news.pop("marks", [])
            news = {**self.known, **news}
        self.known = news
        if self.known["failure"]:
            sys.exit(f"labelling: training failed: {self.known['failure']}")
        return self.known

    def wait_for_geometry(self, seconds):
        """Of training, or all of it where that is shorter."""
        step, since = -1, time.monotonic()
        while not (run := self.state()["run"])["geometry_ready"] or run["train_s"] < seconds:
            if run["step"] != step:
                step, since = run["step"], time.monotonic()
            if run["geometry_ready"] and time.monotonic() > since + 5:
                return
            time.sleep(0.2)

    def picture(self, view, client, full=False):
        """Palette PNG of the labels, whose index 0 is none; None where a later request has replaced this one."""
        head, _, png, _ = self.parts("/picture", {"client": client, "view": view, "labels": True, "full": full})
        return None if json.loads(head)["stale"] else png

    def labels(self, view, client, full=False):
        """[H, W] index of the class, -1 for none."""
        return png_values(png) - 1 if (png := self.picture(view, client, full)) else None

    def learn(self):
        """Until labels have learned every event."""
        revision = 0
        while (state := self.state(revision))["overlay"]["events"] < state["events"]:
            revision = state["revision"]

    def close(self):
        self.process.terminate()
        self.process.wait()


def miou(confusion):
    """Over classes that are there in truth; [K, K + 1] pixels, row = truth, last column = no label."""
    hit, truth = np.diag(confusion), confusion.sum(1)
    return float(np.mean((hit / np.maximum(truth + confusion[:, :-1].sum(0) - hit, 1))[truth > 0]))


def truth_of(config, pairs):
    """{frame: [H, W] class ids} of the frames that have labels."""
    with sf.open(config, settings(pairs)) as run:
        return {f.name: labels for f in run.frames if (labels := run.pixels(f.name).labels) is not None}


def clicks_of(page, truth, question, seed):
    """Names one pixel after the other; of each click its class and the milliseconds until it was shown."""
    state = page.state()
    name_of = {c["id"]: c["name"] for c in state["classes"]}
    views = [v for v in state["views"] if not v["held_out"]]
    draw, events = random.Random(seed), state["events"]
    while True:
        proposal = state["proposal"] if question == "surface" else None
        if proposal:
            view, (x, y) = proposal["view"], proposal["at"]
        else:
            view = draw.randrange(len(views))
            x, y = draw.randrange(views[view]["width"]) + 0.5, draw.randrange(views[view]["height"]) + 0.5
        frame, size = views[view]["frame"], [views[view]["width"], views[view]["height"]]
        id_ = int(truth[frame][int(y), int(x)])
        event = {"id": f"p-{seed}-{events}", "frame": frame, "size": size, "points": [[x, y]]}
        begin, events = time.perf_counter(), events + 1
        if id_ in name_of:
            page.request("/event", {**event, "type": "click", "radius": 0, "class": name_of[id_]})
            page.learn()
            page.labels(view, "person")
            yield id_, 1e3 * (time.perf_counter() - begin)
        else:
            page.request("/event", {**event, "type": "skip"})
        state = page.state()


def course(page, truth, question, seed, clicks):
    """(mIoU by number of clicks, milliseconds of each answer, classes that have a click)."""
    index_of = {c["id"]: c["index"] for c in page.state()["classes"]}
    scores, answers, named = {}, [], set()
    for id_, took in itertools.islice(clicks_of(page, truth, question, seed), clicks):
        answers.append(took)
        named.add(id_)
        if len(answers) in MARKS or len(answers) == clicks:
            scores[len(answers)] = held_out_miou(page, truth, index_of)
    return scores, answers, len(named)


def held_out_miou(page, truth, index_of):
    confusion = np.zeros((len(index_of), len(index_of) + 1), np.int64)
    for number, view in enumerate(page.state()["views"]):
        if not view["held_out"]:
            continue
        while (found := page.labels(number, "score", full=True)) is None:
            pass
        ids = truth[view["frame"]]
        ids = ids[:: ids.shape[0] // found.shape[0], :: ids.shape[1] // found.shape[1]]
        for id_, index in index_of.items():
            confusion[index] += np.bincount(np.where(found < 0, len(index_of), found)[ids == id_],
                                            minlength=len(index_of) + 1)
    return miou(confusion)


def clicks_to(level, found):
    """Clicks of the page's questions until the median of persons has this mIoU, between marks along a line; '-': never."""
    scores = [s for s, _, _ in found]
    marks = [(0, 0.0)] + [(m, statistics.median(s[m] for s in scores)) for m in sorted(scores[0])] if scores else []
    for (before, low), (after, high) in zip(marks, marks[1:]):
        if high >= level:
            return round(before + (after - before) * (level - low) / (high - low))
    return "-"


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("config", nargs="?", default="quickstart", help="of a labelled scene with held-out views")
    p.add_argument("--questions", default="random,surface")
    p.add_argument("--seeds", type=int, default=5, help="persons for each question; the seed is runtime.seed too")
    p.add_argument("--clicks", type=int, default=180)
    p.add_argument("--geometry", type=float, default=30, help="seconds of training before the first click")
    p.add_argument("--device", default="auto")
    p.add_argument("--segments", default="", help="what the page gets of a segmenter, as `semfield serve --segments`")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = p.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the served run ends too
    truth = truth_of(options.config, options.set)
    rows = {}
    for question in options.questions.split(","):
        for seed in range(1, options.seeds + 1):
            words = ["--device", options.device, *(["--segments", options.segments] if options.segments else [])]
            for setting in [*options.set, "scene.labels.frames=none", f"runtime.seed={seed}"]:
                words += ["--set", setting]
            with tempfile.TemporaryDirectory() as folder:
                with contextlib.closing(Page(options.config, folder, words)) as page:
                    page.wait_for_geometry(options.geometry)
                    rows.setdefault(question, []).append(course(page, truth, question, seed, options.clicks))
    marks = sorted({m for found in rows.values() for scores, _, _ in found for m in scores})
    answers = [ms for found in rows.values() for _, times, _ in found for ms in times]
    cells = []
    for question, found in rows.items():
        at = [[scores[m] for scores, _, _ in found] for m in marks]
        cells.append([question, *(f"{statistics.median(s):.3f} ({min(s):.3f} to {max(s):.3f})" for s in at),
                      f"{statistics.median(f[2] for f in found):.0f}"])
    print(table(["question", *(f"mIoU after {m}" for m in marks), "classes"], cells))
    print(f"labelling: clicks_to_06={clicks_to(0.6, rows.get('surface', []))} answer_p50_ms={statistics.median(answers):.0f} answer_p95_ms={np.percentile(answers, 95):.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
