#!/usr/bin/env python3
"""Runs that leave a component out against runs that keep it: the proof that nothing is lost, and the time it saves.

    studies/leave_out.py                                          # every pair, in minutes
    studies/leave_out.py --only undistortion,late_samples
    studies/leave_out.py --data docs/reference/leave_out.json     # puts its rows into the data

Times are CPU seconds of one thread, medians of rounds that alternate. Rows of the data that no pair measures here stay
as they are. Exit code 1 when a proof does not hold.
"""
import argparse
import ctypes
import dataclasses
import hashlib
import json
import pathlib
import statistics
import sys
import tempfile
import time

import numpy as np

import semfield as sf
from common import half_width, machine, read, settings, today, write

PSNR_MARGIN_DB, MIOU_MARGIN = -0.1, -0.005  # lower limits of the interval of the mean difference
ROOM = {"scene.frames": 30, "scene.test_frames": 5, "scene.width_px": 80, "scene.height_px": 60, "train.rays": 256}
# Both sides must walk the same lattice of steps: a ray with more than max_samples of them takes longer ones.
COARSE = {"passes.0.sampler.step_m": 0.05, "passes.0.sampler.max_samples": 256, "passes.0.sampler.warmup_steps": 32}


@dataclasses.dataclass
class Pair:
    """`kind`: training, rendering, quality, cost, rows, evaluation or library; see the functions of these names."""
    name: str
    component: str  # of left_out.json; "": it is in no run's list
    rule: str
    proof: str  # B bitwise, C certified, S statistical
    kind: str
    config: str = "quickstart"
    both: dict = dataclasses.field(default_factory=dict)
    out: dict = dataclasses.field(default_factory=dict)
    kept: dict = None  # None: the component is kept
    kept_by: str = ""
    but: str = ""  # not empty: it stays in, and why
    bound: float = 0.0  # certified: what a ray may lose of its opacity
    steps: int = 60  # before anything is compared

    def __post_init__(self):
        if self.kept is None:
            self.kept = {"runtime.keep": [self.component]}
        self.kept_by = self.kept_by or f"`--keep {self.component}`"


NEVER_SKIP = {"passes.0.sampler.skip": "never"}
# The branch keeps every sample: one whose weight crosses least_weight would move logits, whatever was skipped.
CERTIFIED = {"both": {**COARSE, "passes.0.semantic.3.least_weight": 0, "rendering.early_stop": 0,
                      "rendering.density_bias": -9},
             "out": {"passes.0.sampler.skip": "certified", "passes.0.sampler.skip_budget": 1e-3},
             "kept": NEVER_SKIP, "kept_by": "`passes.N.sampler.skip: never`", "bound": 1e-3}
PAIRS = [
    # With the rows of rays that have no label, or there would be no work to save.
    Pair("semantics", "semantics", "no labelled pixel in the training frames", "B", "training",
         both={"scene.labels.frames": "none", "train.ray_source": "all_images"},
         kept={"runtime.keep": ["semantics", "unlabelled_rays"]}),
    Pair("unlabelled_rays", "unlabelled_rays", "the head runs on rays with a label alone", "B", "training",
         both={"train.ray_source": "all_images"}),
    Pair("absent_classes", "absent_classes", "classes without a training pixel get no logit", "S", "quality"),
    Pair("coarse_passes", "coarse_passes", "the last pass's sampler reads no earlier pass", "B", "training",
         "quickstart_frequency",
         both={"passes.1.sampler": {"type": "occupancy_grid", "resolution": 32, "max_samples": 24, "keep_last": True},
               "runtime.tile_rays": 32}),
    # Thick fog, in which every ray ends early, before it has learned to be air.
    Pair("late_samples", "late_samples", "rendering ends a ray whose transmittance is below `rendering.early_stop`",
         "C", "rendering", both={"rendering.early_stop": 1e-4, "rendering.density_bias": 20}, bound=1e-4, steps=5),
    Pair("late_samples_deep", "late_samples", "the same, stratified and importance samples", "C", "rendering",
         "quickstart_frequency", both={"rendering.early_stop": 1e-4, "rendering.density_bias": 6}, bound=1e-4),
    Pair("late_samples_room", "late_samples", "the same in the room as it is learned", "C", "rendering",
         both={"rendering.early_stop": 1e-4}, bound=1e-4, steps=1000),
    Pair("empty_space_certified", "empty_space",
         "cells whose optical depth fits a ray's budget of 1e-3, by a grid that is updated every step", "C",
         "rendering",
         **{**CERTIFIED, "both": {**CERTIFIED["both"], "passes.0.sampler.update_every": 1,
                                  "passes.0.sampler.update_share": 1}}),
    Pair("empty_space_lagging", "empty_space",
         "the same by a grid of which an eighth is updated every 16 steps (the default)", "C", "rendering",
         but="its densities are estimates and lag behind a field that changes fast: then the budget bounds nothing, so "
             "that a run's list says S", **CERTIFIED),
    Pair("empty_space_threshold", "empty_space", "cells below a fixed density, whatever their number", "S", "quality",
         both=COARSE, out={"passes.0.sampler.skip": "threshold"}, kept=NEVER_SKIP,
         kept_by="`passes.N.sampler.skip: never`"),
    Pair("table_size", "table_size", "sizes of the hash grid from the scene's extent and pixels", "S", "quality",
         kept={"passes.0.position.log2_entries": 19, "passes.0.position.finest_resolution": 512},
         kept_by="numbers in `passes.N.position`"),
    Pair("untouched_rows", "untouched_rows", "a table's row is updated in the steps that give it a gradient", "B",
         "rows", kept={}, kept_by="Adam's rule for tables"),
    Pair("view_branch", "view_branch", "training rays within 5 degrees of each other", "S", "quality",
         out={"passes.0.direction": None}, kept={},
         but="a scene seen from several sides keeps it: its direction part is computed once per ray already"),
    Pair("frequency_bands", "", "bands finer than a pixel", "S", "cost", "quickstart_frequency",
         both={"passes.1.sampler.keep_previous": True}, out={"passes.0.position.frequencies": 4},
         kept={"passes.0.position.frequencies": 8}, kept_by="`passes.N.position.frequencies`",
         but="who writes a number of bands asks for them; half of them cost"),
    Pair("class_weights", "class_weights", "`semantics.balance_classes` is false", "B", "cost",
         kept={"semantics.balance_classes": True}, kept_by="`semantics.balance_classes: true`",
         but="built when asked for, however alike the classes' frequencies are: they cost"),
    Pair("undistortion", "undistortion", "every distortion coefficient is 0", "B", "training"),
    Pair("training_depth", "training_depth", "depth of training frames gives the bounds and is then dropped", "B",
         "training"),
    Pair("instances", "", "instances are kept for `semfield objects`, and for label steps that read them", "B",
         "training", both={"scene.instances": "pieces", "scene.labels.frames": "all"},
         kept={"scene.labels.degrade": [{"type": "region_noise", "ratio": 0, "min_frames": 1}]},
         kept_by="ask for one of them"),
    Pair("periodic_evaluation", "periodic_evaluation", "`report.eval_every_s` is 0", "B", "evaluation", kept={},
         kept_by="`report.eval_every_s`"),
    Pair("image_library", "image_library", "loaded when the first image other than PNG is met", "B", "library", kept={},
         kept_by="it is loaded by itself"),
]


@dataclasses.dataclass
class Found:
    holds: bool
    result: str
    saving: str
    idle: bool = False  # nothing was left out, so that nothing is proved


class Study:
    def __init__(self, options):
        self.options = options
        self.room = {**ROOM, **settings(options.set)}

    def settings(self, pair, own, seed=1):
        # What is compared are sums of fp32, on one thread so that CPU time is the step's.
        return {**self.room, **pair.both, **own, "runtime.threads": 1, "runtime.precision": "fp32",
                "runtime.seed": seed}

    def sides(self, pair, seed=1):
        return tuple(sf.open(pair.config, self.settings(pair, own, seed)) for own in (pair.out, pair.kept))

    def times(self, out, kept, rounds=None, units=1):
        """Seconds of rounds that alternate [N, 2], `units` of work in each."""
        times = []
        for _ in range(rounds or self.options.rounds):
            marks = [time.process_time()]
            for work in (out, kept):
                work()
                marks.append(time.process_time())
            times.append(np.diff(marks) / units)
        return np.array(times)

    def training(self, pair, cost=False):
        """Tensors after training; `cost`: the sides are different trainings, and what leaving it out would save."""
        out, kept = self.sides(pair)
        for run in (out, kept):
            train(run, 1)  # outside the timing: memory grows in it
        saving = saving_text("step", self.times(lambda: train(out, 5), lambda: train(kept, 5), units=5))
        (a, count), (b, _) = hash_of_shared(out, kept), hash_of_shared(kept, out)
        if cost:
            differ = a != b or count == 0
            return Found(differ, "" if differ else "both sides are the same training, so nothing was measured", saving)
        of = f"{count} tensors and their moments after {out.step} steps"
        return Found(a == b and count > 0, hashes_text(a, b, of), saving)

    def rendering(self, pair):
        """Pictures of one field within a bound: what a ray may lose of its opacity moves a colour by at most as much,
        and the difference of two logits by at most twice that times their range over the samples."""
        with tempfile.TemporaryDirectory() as folder:
            run = sf.open(pair.config, self.settings(pair, pair.out))
            train(run, min(pair.steps, self.options.most_steps))
            run.save(folder + "/run")
            out, kept = (sf.load(folder + "/run", {"runtime.threads": 1, **own}) for own in (pair.out, pair.kept))
        tests = [f.name for f in out.frames if f.split == "test"]
        frames = tests[:: max(1, len(tests) // 2)][:2]
        rounding = 2e-6  # of sums of fp32
        colour = depth = odds = reach = 0.0
        same = True
        for name in frames:
            a, b = (side.render(frame=name, probability=True) for side in (out, kept))
            same = same and all((getattr(a, k) == getattr(b, k)).all() for k in ("rgb", "depth_m", "opacity"))
            colour = max(colour, float(np.abs(a.rgb - b.rgb).max()))
            depth = max(depth, float(np.abs(a.depth_m - b.depth_m).max()))
            odds = max(odds, float(np.abs(log_odds(a.probability) - log_odds(b.probability)).max()))
            reach = max(reach, range_of_logits(out, out.frames[[f.name for f in out.frames].index(name)]))
        bounds = pair.bound + rounding, out.far_m * (pair.bound + rounding), (2 * pair.bound + rounding) * reach
        saving = saving_text("picture", self.times(lambda: out.render(frame=frames[0]),
                                                   lambda: kept.render(frame=frames[0])))
        text = (f"colour: bound {bounds[0]:.2g}, difference {colour:.2g}; depth: bound {bounds[1]:.2g} m, difference "
                f"{depth:.2g}; logits (a sample's range {reach:.1f}): bound {bounds[2]:.2g}, difference {odds:.2g}")
        holds = colour <= bounds[0] and depth <= bounds[1] and odds <= bounds[2] + 1e-5  # probabilities are of fp32
        return Found(holds, text + ("; nothing was left out" if same else ""), saving, same)

    def quality(self, pair):
        """Test scores over seeds."""
        steps, psnr, miou, times = self.options.steps, [], [], []
        rounds = max(1, steps // 20)  # in pieces that alternate: what disturbs the machine meets both
        units = steps // rounds
        for seed in range(1, self.options.seeds + 1):
            out, kept = self.sides(pair, seed)
            times.append(self.times(lambda: train(out, units), lambda: train(kept, units), rounds, units))
            a, b = out.evaluate("test"), kept.evaluate("test")
            psnr.append(a.psnr - b.psnr)
            if a.miou_present is not None and b.miou_present is not None:
                miou.append(a.miou_present - b.miou_present)
        holds, text = True, f"{self.options.seeds} seeds, {steps} steps: "
        for name, differences, margin, factor, unit in (("PSNR", psnr, PSNR_MARGIN_DB, 1, "dB"),
                                                        ("mIoU", miou, MIOU_MARGIN, 100, "points")):
            if not differences:
                continue
            mean, half = statistics.mean(differences), half_width(differences)
            holds = holds and mean - half >= margin
            low, high = factor * (mean - half), factor * (mean + half)
            text += f"{name} {factor * mean:+.2f} [{low:+.2f}, {high:+.2f}] {unit}, "
        idle = not any(psnr) and not any(miou)
        return Found(holds, text[:-2] + ("; nothing was left out" if idle else ""),
                     saving_text("step", np.concatenate(times)), idle)

    def rows(self, pair):
        """Rows of tables that no ray met keep their first bits. What a dense update would cost is not measured here."""
        run = sf.open(pair.config, self.settings(pair, pair.out))
        before = run.parameters()
        train(run, min(pair.steps, self.options.most_steps))
        after = run.parameters()
        rows = untouched = changed = 0
        for name in before:
            if "/position/level_" not in name or name.startswith("adam/"):
                continue
            met = (after["adam/m/" + name] != 0).any(1) | (after["adam/v/" + name] != 0).any(1)
            differs = (after[name].view(np.uint32) != before[name].view(np.uint32)).any(1)
            rows += len(met)
            untouched += int((~met).sum())
            changed += int((~met & differs).sum())
        return Found(untouched > 0 and changed == 0, f"{untouched} of {rows} rows of tables never met in {run.step} "
                     f"steps; {changed} of them differ from their first bits", "")

    def evaluation(self, pair):
        """Tensors after training with evaluations between and without."""
        out, kept = self.sides(pair)
        frames = [f.name for f in kept.frames if f.split == "test"][: kept.config["report"]["eval_frames"]]
        seconds, every_s = [], 10.0  # the default of report.eval_every_s
        for _ in range(self.options.rounds):
            train(out, 5)
            train(kept, 5)
            begin = time.process_time()
            kept.evaluate(frames=frames)
            seconds.append(time.process_time() - begin)
        (a, count), (b, _) = hash_of_shared(out, kept), hash_of_shared(kept, out)
        times = np.array([[every_s, every_s + s] for s in seconds])
        return Found(a == b and count > 0, hashes_text(a, b, f"{count} tensors after {out.step} steps, with "
                                                            f"{len(seconds)} evaluations and without"),
                     saving_text("stretch of 10 s of training", times))

    def library(self, pair):
        """The process's memory map after training and rendering, and what loading the library costs."""
        run = sf.open(pair.config, self.settings(pair, {}))
        train(run, 5)
        run.render(frame=0)
        if mapped("OpenImageIO"):
            return Found(False, "the library was mapped before it was needed", "")
        framework = mapped("libsemfield.so")
        images = sorted(pathlib.Path(framework[0]).parent.rglob("libsemfield_images.so")) if framework else []
        if not images:
            return Found(True, "this build has none", "", True)
        before, begin = resident_bytes(), time.process_time()
        ctypes.CDLL(str(images[0]))
        took = time.process_time() - begin
        return Found(bool(mapped("OpenImageIO")), "no OpenImageIO in the process's memory map after training and "
                     "rendering, mapped when asked for",
                     f"{seconds_text(took)} of CPU time at the start, {1e-6 * (resident_bytes() - before):.1f} MB")


def train(run, steps):
    run.train(steps, every=steps).last()


def hash_of_shared(run, other):
    """SHA-256 of values and moments of the learned tensors that `other` has too, and how many they are."""
    mine, theirs, total, count = run.parameters(), other.parameters(), hashlib.sha256(), 0
    for name, value in mine.items():
        if f"adam/m/{name}" not in mine or name not in theirs or theirs[name].size != value.size:
            continue
        total.update(name.encode())
        for tensor in (value, mine[f"adam/m/{name}"], mine[f"adam/v/{name}"]):
            total.update(np.ascontiguousarray(tensor).tobytes())
        count += 1
    return total.hexdigest(), count


def hashes_text(a, b, of):
    return f"SHA-256 {a[:16]}... on both sides ({of})" if a == b else f"SHA-256 {a[:16]}... against {b[:16]}... ({of})"


def log_odds(probability):
    """Differences of logits to that of the first class that is learned [..., C]; classes without a logit have none."""
    learned = probability.reshape(-1, probability.shape[-1]).max(0) > 0
    log = np.log(np.maximum(probability[..., learned].astype(np.float64), 1e-38))
    return log - log[..., :1]


def range_of_logits(run, frame):
    """Largest difference of two logits of a point along the frame's rays, every fourth pixel, 64 points on each."""
    camera = frame.camera
    v, u = np.mgrid[0:camera.height:4, 0:camera.width:4].reshape(2, -1) + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)],
                    1) @ frame.pose[:3, :3].T
    depth = np.linspace(run.near_m, run.far_m, 64)
    found = run.query((frame.pose[:3, 3] + rays[:, None] * depth[:, None]).reshape(-1, 3)).probability
    log = log_odds(found)
    return float((log.max(1) - log.min(1)).max())


def mapped(name):
    """Paths in this process's memory map that have `name` in them."""
    return sorted({line.split()[-1] for line in read("/proc/self/maps").splitlines() if name in line})


def resident_bytes():
    return 4096 * int(read("/proc/self/statm").split()[1])


def seconds_text(s):
    return f"{1e6 * s:.3g} µs" if s < 1e-3 else f"{1e3 * s:.3g} ms" if s < 1 else f"{s:.3g} s"


def saving_text(of, times):
    """`times`: seconds of rounds [N, 2], without the component and with it."""
    share = np.sort(1 - times[:, 0] / times[:, 1])
    median, noise = float(np.median(share)), 0.5 * float(share[len(share) * 3 // 4] - share[len(share) // 4])
    out_s, kept_s = np.median(times, 0)
    if abs(median) <= noise:
        return f"no more than its noise: {100 * median:+.1f} ± {100 * noise:.1f} % of a {of} ({seconds_text(out_s)})"
    return (f"{'none, it costs ' if median < 0 else ''}{100 * abs(median):.1f} ± {100 * noise:.1f} % of a {of} "
            f"({seconds_text(out_s)} against {seconds_text(kept_s)})")


def merged(old, fresh):
    """The rows of `old` in their order, those measured now in place of theirs; what was not measured stays."""
    new = {row["name"]: row for row in fresh["rows"]}
    rows = []
    for row in old["rows"]:
        replaced = new.pop(row["name"], row)
        rows.append({**replaced, "saving_measured": replaced["saving_measured"] or row["saving_measured"]})
    return {"about": fresh["about"], "rows": rows + list(new.values())}


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--only", default="", help="pairs, with commas: " + ", ".join(pair.name for pair in PAIRS))
    p.add_argument("--rounds", type=int, default=9, help="alternating rounds that are timed")
    p.add_argument("--seeds", type=int, default=5, help="runs on each side of a statistical pair")
    p.add_argument("--steps", type=int, default=400, help="steps of each of these runs")
    p.add_argument("--most-steps", type=int, default=10**6, help="steps before pictures are compared, at most")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a value of all pairs")
    p.add_argument("--data", metavar="FILE", help="put the rows into this file in the place of those of the same pairs")
    options = p.parse_args()
    only = options.only.split(",") if options.only else [pair.name for pair in PAIRS]
    unknown = set(only) - {pair.name for pair in PAIRS}
    if unknown:
        sys.exit(f"leave_out: there is no pair {', '.join(sorted(unknown))}; --help lists them")
    study, rows, all_hold = Study(options), [], True
    for pair in PAIRS:
        if pair.name not in only:
            continue
        found = study.training(pair, cost=True) if pair.kind == "cost" else getattr(study, pair.kind)(pair)
        all_hold = all_hold and (found.holds or bool(pair.but))
        verdict = "kept" if pair.but else "holds" if found.holds else "DOES NOT HOLD"
        print(f"{pair.name:22} {pair.proof}  {verdict}  {found.result}\n{'':26} saves {found.saving or 'not measured'}",
              flush=True)
        rows.append({**{key: getattr(pair, key) for key in ("name", "component", "rule", "proof", "kept_by", "but")},
                     "result": found.result, "saving_measured": found.saving, "holds": found.holds})
    e = machine()
    command = "studies/leave_out.py" + (" --only ..." if options.only else "")
    room = ", ".join(f"{key}={value}" for key, value in study.room.items())
    about = f"`{command}`, one core of {e['cpu']}, {e['compiler']}, {today()}; {options.rounds} rounds; scene: {room}."
    if options.data:
        data = merged(json.loads(read(options.data)), {"about": about, "rows": rows})
        write(options.data, json.dumps(data, indent=2, ensure_ascii=False) + "\n")
    print(f"leave_out: pairs={len(rows)} hold={'all' if all_hold else 'not all'}")
    return 0 if all_hold else 1


if __name__ == "__main__":
    sys.exit(main())
