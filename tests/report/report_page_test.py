"""The report's page in a real browser: what it shows of hand-made data, section by section."""
import copy
import json
import os
import pathlib
import sys
import unittest

PAGE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "framework", "eval", "report", "page")
sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "page"))
import browser  # noqa: E402


def row(train_s, psnr, split="test", frames=30, **more):
    sample = {"split_frames": 30, "pixel_stride": 1} if frames < 30 else {}
    return {"kind": "eval", "step": int(10 * train_s), "train_s": train_s, "split": split, "psnr": psnr, "frames": frames, **sample, **more}


def run(name, rows, **more):
    environment = [["version", "1.0"], ["cpu", "EPYC"], ["input_hash", "aa"], ["started", "2026-11-22"]]
    return {"name": name, "rows": rows, "config": "seed: 1", "scene": "obj_room, room", "environment": environment, "left_out": [], "labels": None,
            "rounds": [], "eval": None, "clicked": None, **more}


def data(*runs, **more):
    return {"title": "Room & friends", "split": "test", "classes": [], "runs": list(runs), "strips": [], "worst": [], "clicked": [], **more}


RISE = [row(t, p, miou=p / 40, miou_present=p / 40, total_accuracy=p / 40) for t, p in ((10, 20), (20, 28), (40, 30))]
LABELS = {"train_frames": 200, "labelled_frames": 4, "train_pixels": 3840000, "labelled_pixels": 76800, "degrade": [],
          "classes": [{"id": 1, "name": "wall", "pixels": 76000}, {"id": 2, "name": "clock", "pixels": 800}, {"id": 3, "name": "mug", "pixels": 0}]}
BINS = [{"pixels": 0, "confidence": None, "accuracy": None}] * 15
BINS = BINS[:7] + [{"pixels": 25, "confidence": 0.5, "accuracy": 0.6}] + BINS[8:14] + [{"pixels": 75, "confidence": 0.98, "accuracy": 0.9}]
EVAL = {"classes": [{"id": 1, "name": "wall", "color": [196, 200, 208]}, {"id": 4, "name": "chair <b>", "color": [1, 2, 3]}, {"id": 9, "name": "table", "color": [4, 5, 6]}, {"id": 10, "name": "nowhere", "color": [7, 8, 9]}],
        "confusion": {"pixels": [[80, 15, 5, 0], [30, 10, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]}, "reliability": {"bins": BINS, "nonfinite_pixels": 0}, "entropy": {"auroc": 0.9125},
        "per_frame": [{"frame": "good", "psnr": 30, "miou_present": 0.9, "absrel": None}, {"frame": "bad & worse", "psnr": 31, "miou_present": 0.1, "absrel": None},
                      {"frame": "unlabelled", "psnr": 10, "miou_present": None, "absrel": None}]}
PNG = "data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
STRIP = {"name": "f/2", "note": "9 clicks", "images": [{"caption": "entropy", "png": PNG}, {"caption": "depth", "png": PNG}]}
LONG = [row(10, 23.8, "test_sample", 4), row(58.3, 27, "test_sample", 4), row(58.3, 25)]
MANY = {"classes": [{"id": c, "name": f"class{c}", "color": [0, 0, 0]} for c in range(70)],
        "confusion": {"pixels": [[c + 1 if c == other else 0 for other in range(70)] for c in range(70)]}}


def changed(value, **more):
    return {**copy.deepcopy(value), **more}


def hashed(one, value):
    return changed(one, environment=[["input_hash", value]], scene="replica, <office>")


# What is shown, of which data, where; texts that are there, texts that are not, and how many of what.
CASES = [
    ("a run that has not begun", data(run("a", []), split=""), "body", ["No frame was scored", "0 s"], ["NaN", "undefined", "null"], {"#curves": 0, "#labels": 0}),
    ("the head", data(run("a", [row(20, 30)], labels=LABELS)), ".top", ["obj_room, room", "200 training (4 labelled), 30 test", "Semfield 1.0", "30.00", "all 30 frames"],
     ["not ranked", "fitted"], {"nav a": 3}),
    ("an infinite value", data(run("a", [row(20, "inf")])), "#figures", ["∞"], ["inf"], {}),
    ("a course", data(run("a", RISE)), "#curves", ["a: 30.00 at 40.030.00"], ["logarithmic"], {"#curves .ln": 2}),
    ("runs of other lengths", data(run("a", RISE), run("b", [row(1, 10), row(4, 20)])), "#curves", ["seconds of training, logarithmic"], [], {"#curves .plots": 1}),
    ("a single evaluation", data(run("a", RISE[:1])), "body", ["20.00"], ["–"], {"#curves": 0}),
    ("one score everywhere", data(run("a", [row(9, 20, "test_sample", 4), row(20, 28, "test_sample", 4), row(20, 25)])), "body",
     ["Lines are of a sample, 4 of 30 frames", "25.00dB", "a: 25.00 at 20.025.00"], [], {"#curves .end": 1}),
    ("terms of the loss", data(run("a", [{"kind": "train", "step": s, "train_s": s, "loss": 0.5, "loss_color": 1, "loss_depth": 0.5} for s in (1, 2)])), "#curves",
     ["Loss: depth"], ["Loss: color"], {"#curves figure": 2}),
    ("the best of a row", data(run("a", [row(9, 30, absrel=0.05)]), run("b", [row(9, 20, absrel=0.01)])), "#figures", ["30.00", "0.0100"], [],
     {"#figures .best": 2, "#figures .best:nth-child(2)": 1}),
    ("second figures of PSNR", data(run("a", [row(9, 30, psnr_fitted_colors=29.5, psnr_refined_poses=28.25)])), ".cards",
     ["PSNR, colours fitted", "29.50", "PSNR, poses fitted", "28.25"], [], {}),
    ("no two values", data(run("a", [row(9, 30)]), run("b", [row(9, 30)])), "#figures", [], [], {"#figures .best": 0}),
    ("the longest training", data(run("slow", [row(242, 30)]), run("quick", [row(100, 30, step=2500)])), ".cards", ["4 min 02 s", "slow: 2,420 steps"], ["2,500"], {}),
    ("figures of a sample", data(run("a", [row(5, 18, "test_sample", 4), row(6, 21.5, "test_sample", 2)])), "body", ["2 of 30 frames", "21.50", "of a sample"], ["18.00"], {}),
    ("every pixel in 49", data(run("a", [row(10, 24), changed(row(20, 27, "test_sample"), split_frames=30, pixel_stride=7)])), "body",
     ["all 30 frames at 1 pixel in 49", "27.00"], ["24.00"], {}),
    ("other data", data(run("a", RISE), hashed(run("b", RISE), "bb")), "body", ["not ranked", "a on obj_room, room", "b on replica, <office>"],
     ["best: ", "Time to a common level"], {".best": 0}),
    ("other frames", data(run("a", RISE, eval=EVAL), run("b", RISE, eval=changed(EVAL, per_frame=EVAL["per_frame"][:1]))), ".top", ["not ranked", "on good and others"], [], {}),
    ("other pixels", data(run("a", [row(9, 30, pixels=900)]), run("b", [row(9, 31, pixels=300)])), ".top", ["a on 900", "b on 300"], [], {}),
    ("part of a split", data(run("all", [row(20, 30)]), run("some", [row(20, 31, "test_sample", 6)])), ".top", ["all 30 frames", "6 of 30 frames"], [], {}),
    ("times to a level", data(run("long", LONG), run("short", [row(40, 20.58)])), "#curves", ["≥ 20.58 dB", "≤ 58.3 s", "≤ 40.0 s", "4 of 30 frames"], [], {"#curves .best": 0}),
    ("times by samples", data(run("long", LONG), run("short", [row(10, 15, "test_sample", 4), row(40, 20, "test_sample", 4), row(40, 20.58)])), "#curves",
     ["≥ 20.00 dB", "≤ 10.0 s", "40.0 s"], [], {"#curves .best": 1}),
    ("labels of one run", data(run("a", RISE, labels=changed(LABELS, degrade=[{"type": "pixel_noise", "facts": {"share": "<12>"}}]), rounds=["self-training at step 45"])),
     "#labels", ["4 of 200", "76,800", "2 % of all", "2 of 3", "pixel_noise: share <12>", "self-training at step 45"], [], {"#labels svg": 0}),
    ("labels of several runs", data(run("few", RISE, labels=LABELS), run("many", RISE, labels=changed(LABELS, labelled_pixels=1920000)), run("<old>", RISE)), "#labels",
     ["50 % of all", "logarithmic number", "older version): <old>."], [], {"#labels .plots svg": 2}),
    ("a scene without classes", data(run("photos", RISE, labels=changed(LABELS, classes=[])), run("room", RISE, labels=LABELS)), "#labels", ["no classes: photos"], [], {}),
    ("worth of labels", data(run("a", [*RISE, row(40, 1, "train", given_miou=0.345, miou=0.812)], labels=LABELS)), "#labels", ["0.3450", "0.8120"], [], {}),
    ("classes", data(run("a", [row(9, 30, per_class_iou={"wall": 0.5, "lamp <b>": None})]), classes=[{"name": "wall", "color": [1, 2, 3]}]), "#classes",
     ["0.500"], ["lamp"], {"#classes .bar": 1, "#classes i": 1}),
    ("confusions", data(run("a", RISE, eval=EVAL), run("old", RISE)), "#confusion", ["75 % of chair <b>", "30 px, 60 %", "80", "ended): old."], ["nowhere"],
     {"#confusion tbody tr": 2, "#confusion .v": 3}),
    ("many classes", data(run("a", RISE, eval=changed(EVAL, **MANY))), "#confusion", ["6\nclass6", "64 of 70", "Every scored pixel has its class"], ["class5\n"], {"#confusion .v": 64}),
    ("calibration", data(run("a", RISE, eval=EVAL)), "#calibration", ["ECE 0.0850", "over-confident by 0.035", "AUROC 0.912", "91 %"], [],
     {"#calibration .br": 2, "#calibration .rf": 1}),
    ("lost probabilities", data(run("a", RISE, eval=changed(EVAL, reliability={"bins": BINS, "nonfinite_pixels": 1200}, entropy=None))), "#calibration",
     ["no ECE: 1,200 px"], ["AUROC 0."], {}),
    ("entropy by given labels", data(run("<a>", [row(9, 1, "train_sample", 4, given_right_entropy=0.125, given_wrong_auroc=0.875)]), run("b", RISE)), "#calibration",
     ["<a>", "0.125", "0.875"], [], {"#calibration tbody tr": 2}),
    ("worst frames", data(run("a", RISE, eval=EVAL), worst=[STRIP]), "#worst",
     ["Scores of all 3 frames", "bad & worse0.100031.00good0.900030.00unlabelled–", "9 clicks"], ["AbsRel"], {"#worst img": 2, "#worst tbody tr": 3}),
    ("pictures", data(run("a", RISE), strips=[STRIP, STRIP, STRIP]), "#frames", ["2 more frames", "0 to ln C"], [], {"#frames img": 6}),
    ("clicks", data(run("a", [], clicked={"step": 900, "clicks": 17, "clicked_frames": 3, "frames": 20, "classes": [
        {"id": 1, "name": "wa<ll", "color": [10, 20, 30], "clicks": 12, "area_share": 0.4, "confidence": 0.93},
        {"id": 7, "name": "cup", "color": [200, 0, 0], "clicks": 5, "area_share": 0.0004, "confidence": 0.5}]}), clicked=[STRIP]), "#clicks",
     ["17 clicks in 3 of 20 frames, at step 900", "wa<ll", "40 %", "93 %", "under 0.1 %"], [], {"#clicks img": 2}),
    ("what is left out", data(*(run(name, RISE, left_out=[{"component": "depth loss", "rule": "", "evidence": "`0`", "proof": "B", "saving_estimate": "4 B",
                                                           "saving_measured": None}, {"component": "x", "rule": "not asked for"}]) for name in "ab")), "#setup", ["depth loss", "every run", "the same bits", "1 part"],
     ["null", "not asked"], {".left-out tbody tr": 1, "details[open] .left-out": 1}),
    ("a scene", data(run("a", RISE), scene="<p>\"A & B\"</p>"), "#scene", [], [], {"iframe[srcdoc]": 1}),
    ("a sweep", {"title": "Noise", "experiments": [
        {"name": "tiny", "title": "Noise", "note": "", "scored": "Scored.", "unequal": "", "tables": [[["mIoU", "room"], ["p|q", "0.5 ± 0.1"]]],
         "plot": {"title": "mIoU", "x_label": "noise", "series": [{"name": "room", "color": 0, "points": [{"x": 0, "y": 0.5, "low": 0.1, "high": 0.9}, {"x": 1, "y": 0.6}]}]}},
        {"name": "bad", "title": "Bad", "note": "", "scored": "", "unequal": "other frames", "tables": [], "plot": None}]}, "main", ["p|q", "0.5 ± 0.1", "Not compared: other frames"], [],
     {".eb": 3, "main svg": 2}),
]
# Of plots.js, as lists of JSON: what it gives, and what it should.
VALUES = [
    ("linear_ticks(0, 95, 5)", [0, 20, 40, 60, 80, 100]), ("linear_ticks(12.3, 31.1, 5)", [10, 15, 20, 25, 30, 35]), ("log_ticks(0.009, 11).length", 4),
    ("log_ticks(1, 6)", [1, 2, 5]), ("log_ticks(3000, 4500).length > 1", True), ("[31.4159, 41230, -2.5, 1e-7, Infinity].map((v) => figure(v, 3))", ["31.4", "41230", "−2.50", "1.00e-07", "∞"]),
    ("[[0, 0.25, -2], [5e3, 2.5e4], [1e6, 2e6], [2e-5, 1e-3]].map(tick_texts)", [["0", "0.25", "−2"], ["5k", "25k"], ["1M", "2M"], ["2·10⁻⁵", "10⁻³"]]), ("thinned(Array.from({length: 1000}, (_, x) => ({x, y: 2 * x})), 10)[9]", {"x": 949.5, "y": 1899}),
    ("plot({title: '', x_label: '', log_y: true, series: [{name: 'a', color: 0, points: [{x: 0, y: 0}, {x: 1, y: -1}]}]}).text.includes('no data')", True),
    ("(plot({title: '', x_label: '', log_x: true, markers: true, series: [{name: 'a', color: 0, points: [0, 10, 100].map((x) => ({x, y: 1}))}]}).text.match(/<circle/g)).length", 2),
    ("[[[0, 10], [10, 20]], [[0, 10], [5, 15]], [[0, 10], null]].map((all) => first_for_certain(all.map((t) => t && {before: t[0], at: t[1]})))", [0, -1, -1]),
]


class ReportPage(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.driver = browser.Driver()
        cls.browser = cls.driver.browser()
        page = pathlib.Path(PAGE, "report.html").read_text(encoding="utf-8")
        for name in ("report.css", "plots.js", "report.js"):
            page = page.replace(f"/*{name}*/", pathlib.Path(PAGE, name).read_text(encoding="utf-8"))
        cls.page = page.replace("<!--policy-->", "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'")

    @classmethod
    def tearDownClass(cls):
        cls.driver.close()

    def open(self, shown):
        path = os.path.join(self.driver.folder, "report.html")
        with open(path, "w", encoding="utf-8") as file:
            file.write(self.page.replace("/*data*/", json.dumps(shown).replace("<", "\\u003c")))
        self.browser.open("file://" + path)
        self.assertEqual(self.browser.complaints(), [])

    def test_sections(self):
        for what, shown, place, there, absent, counts in CASES:
            with self.subTest(what):
                self.open(shown)
                text = self.browser.run("""const place = document.querySelector(arguments[0]);
                    for (const one of place.querySelectorAll('details')) one.open = true;
                    for (const one of place.querySelectorAll('script, noscript')) one.remove();
                    return place.textContent""", place)
                for one in there:
                    self.assertIn(one, text)
                for one in absent:
                    self.assertNotIn(one, text)
                for selector, count in counts.items():
                    self.assertEqual(self.browser.run("return document.querySelectorAll(arguments[0]).length", selector), count, selector)

    def test_values(self):
        self.open(data(run("a", RISE)))
        for expression, wanted in VALUES:
            with self.subTest(expression):
                self.assertEqual(self.browser.run(f"return {expression}"), wanted)


if __name__ == "__main__":
    if not browser.programs():
        print("skipped: the page was tried in no browser; install Debian's chromium and chromium-driver")
        sys.exit(77)
    unittest.main(verbosity=2)
