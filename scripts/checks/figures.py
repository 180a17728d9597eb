"""What the first minutes with Semfield promise, and the table of figures of objects."""
import hashlib
import json
import os
import pathlib
import re
import resource
import shutil
import statistics
import sys
import time

from . import common

sys.path.insert(1, str(common.ROOT / "cmake"))
from make_pages import data_rows, table_of  # noqa: E402

PRESETS = ("room", "unbounded", "object")


def clean_build(folder):
    """Figures of the demo from a clone, and the folder of its build."""
    clone = folder / "clone"
    common.run("git", "clone", "-q", "--no-hardlinks", common.ROOT, clone)
    environment = {**os.environ, "CCACHE_DISABLE": "1", "XDG_CACHE_HOME": str(folder / "cache")}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    # The demo in two parts, of which the first is all of its building.
    common.run("./scripts/setup", cwd=clone, env={**environment, "SEMFIELD_TARGET": "semfield_app"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    common.say(f"built in {time.monotonic() - begin:.0f} s")
    common.say(common.run("./scripts/demo", cwd=clone, env=environment).strip().split("\n")[-1])
    figures = {"build_cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
               "demo_wall_s": time.monotonic() - begin}
    return figures, clone / "build" / os.environ.get("SEMFIELD_PRESET", "release")


def trained_lengths(semfield, asked, preset):
    config, trained, ended = os.path.abspath(preset) if os.path.exists(preset) else preset, [], 0
    for words in ["train", config, "--out", "run"], ["train", "--resume", "run"]:
        out = semfield(*words, "--time", f"{asked:g}s")
        trained.append(out.get("trained_s", out["train_s"] - ended))
        ended = out["train_s"]
        common.check(abs(trained[-1] / asked - 1) <= 0.15,
                     f"{' '.join(words)}: trained for {trained[-1]:.1f} s of {asked:g}, up to step {out['step']}")
    return {"time_asked": asked, "time_trained": trained[0], "resume_trained": trained[1]}


def psnr_of(semfield, folder, name, section, advised, seconds):
    """PSNR of each preset that fits the scene, on all held-out frames."""
    psnr, scored = {}, None
    for preset in PRESETS:
        if preset == "object" and advised != preset:
            continue  # for plain backgrounds alone
        run, config = folder / "runs" / f"{name}_{preset}", folder / f"{name}_{preset}.yaml"
        config.write_text(f"include: presets/{preset}.yaml\n{section}", encoding="utf-8")
        try:
            semfield("train", config, "--time", f"{seconds:g}s", "--out", run)
            scores = semfield("eval", run)  # every pixel of every frame, which a timed training may not score
        except common.Failed as failed:
            common.say(f"{name}: {preset} cannot be trained: {failed}")
            continue
        part = scores["frames"], scores["pixels"]
        if part != (scored or part):
            raise common.Failed(f"{name}: presets were scored on other frames or pixels: {part}, {scored}")
        psnr[preset], scored = scores["psnr"], part
        shutil.rmtree(run)
    return psnr


def advice(semfield, folder, scenes, seconds, downscale, margin):
    indices = pathlib.Path(scenes).resolve().glob("*/transforms*.json")
    held = []
    for scene in sorted({index.parent for index in indices if not re.search("_(test|val)", index.name)}):
        section = (f"scene:\n  type: transforms_json\n  root: {json.dumps(str(scene))}\n"
                   f"  load: {{downscale: {downscale}}}\n")
        # What inspect advises does not depend on the preset that it is asked with.
        config = folder / f"{scene.name}.yaml"
        config.write_text(f"include: presets/room.yaml\n{section}", encoding="utf-8")
        report = semfield("inspect", config)
        if not report.get("preset"):
            common.say(f"{scene.name}: inspect advises no preset")
            continue
        advised = pathlib.Path(report["preset"]).stem
        if report.get("background"):
            section += f"rendering: {{background: {json.dumps(report['background'])}}}\n"
        psnr = psnr_of(semfield, folder, scene.name, section, advised, seconds)
        held.append(advised in psnr and psnr[advised] >= max(psnr.values()) - margin)
        shown = ", ".join(f"{preset} {value:.2f}" for preset, value in psnr.items())
        common.check(held[-1], f"{scene.name}: {advised} is advised; held-out PSNR {shown}")
    return {"advice_right": f"{sum(held)}/{len(held)}"}


def first_minute(*, only: "parts" = ("build", "length", "advice"),
                 program: "build folder of the program; else of the part build, or build/release" = None,
                 preset: "of the part length" = "quickstart", time_: "seconds that it asks for" = 20.0,
                 scenes: "FOLDER of folders with a transforms.json" = None,
                 train_time: "seconds of each training of advice" = 60.0,
                 downscale: "what images are divided by there" = 2,
                 margin: "dB that an advised preset may lose" = 0.3):
    """Measures what the first minutes with Semfield promise, in parts:

  build   a clean build of the demo from a clone of HEAD with the compiler's cache off, then the demo from there
  length  trains for --time seconds, resumes for as many more, and compares what was asked with what was trained
  advice  for every scene of --scenes: is the preset that `semfield inspect` advises at least as good, on held-out
          frames, as each other one after --train-time seconds of training?

A training more than 15 % longer or shorter than asked breaks a promise, and an advice that is worse by more than
--margin dB."""
    figures, build = {}, pathlib.Path(program or common.BUILD).resolve()
    with common.work_folder() as folder:
        semfield = lambda *words: common.ask(build / "bin" / "semfield", *words, cwd=folder)
        for part in only:
            try:
                if part == "build":
                    found, built = clean_build(folder)
                    build = build if program else built
                elif part == "length":
                    found = trained_lengths(semfield, time_, preset)
                elif scenes:
                    found = advice(semfield, folder, scenes, train_time, downscale, margin)
                else:
                    common.say("advice is not measured: name a folder of scenes with --scenes")
                    continue
                figures.update(found)
            except common.Failed as failed:
                common.check(False, f"{part}: {failed}")
    return figures


ROOMS = ("living", "class", "room")
EXACT = ("objects.damage.shuffle=true",)
WORSE = (*EXACT, *(f"objects.damage.{what}" for what in ("split=0.2", "merge=0.2", "missing=0.2", "border_px=2")))
CASES = {"exact": EXACT, "degraded": WORSE, "assignment": (*EXACT, "objects.method={type: assignment, slots: 160}")}


def fingerprint(run):
    """Of what the run has learned: a figure of its field cannot change while this stays."""
    total = hashlib.sha256()
    for file in sorted(file for file in (run / "checkpoints").rglob("*") if file.is_file()):
        total.update(file.name.encode() + file.read_bytes())
    return total.hexdigest()


def object_tables(folder: "of runs", *, out: "folder of the objects" = pathlib.Path("object_tables"),
                  seeds: "how many" = 3, only: "rooms" = (*ROOMS, "replica"),
                  peer: "a PYTHON with PyTorch: runs the peer too" = None,
                  packed: "FOLDER where ROOM.sfpack are, for --peer" = None,
                  json_: "FILE of figures, those of earlier calls of this commit and device included" = None,
                  gpu: "the runs were opened on the GPU (default)" = False,
                  cpu: "the runs were opened on the CPU" = False, build=common.BUILD):
    """Objects of rooms whose objects are known, as a table of figures and one line of means.

FOLDER has a trained run for each room, FOLDER/living, FOLDER/class and FOLDER/room, whose scenes hold instances, and
perhaps FOLDER/replica. Of each: exact segments with shuffled numbers, the same made worse (20 % split, 20 % joined, 20
% missing, borders moved by 2 pixels), and the method `assignment` on exact ones, for every seed, with 95 % intervals.
The last line has means over the three rooms and the seeds."""
    if peer and not packed:
        raise common.Failed("--peer needs --packed FOLDER")
    command = f"scripts/release_check object_tables RUNS --{'cpu' if cpu else 'gpu'}"
    command += " --peer PYTHON --packed FOLDER" if peer else ""
    source = common.source(command, seeds, next(iter(sorted(folder.glob("*/environment.json"))), None),
                           "CPU" if cpu else "gpu")
    kept = pathlib.Path(json_) if json_ else None
    found = json.loads(kept.read_text()) if kept and kept.exists() else {}
    rows = found["rows"] if found and all(found[key] == source[key] for key in ("commit", "device")) else {}
    unchanged = True

    def measure(room, case, seed):
        if "peer" in case:
            script = common.ROOT / "studies" / "peers" / "grouping_peer.py"
            damage = ["--damage"] if case == "degraded_peer" else []
            return json.loads(common.run(peer, script, pathlib.Path(packed) / f"{room}.sfpack", "--seed", seed, *damage,
                                         "--device", "cpu" if cpu else "cuda"))
        settings = (*CASES[case], f"objects.seed={seed}")
        made = common.ask(build / "bin" / "semfield", "objects", folder / room, "--score",
                          "--out", out / f"{room}_{case}", *(word for one in settings for word in ("--set", one)))
        return {**made["score"], "seconds": made["seconds"]["all"]}

    for room in only:
        if not (folder / room).is_dir():
            common.say(f"{room}: no run {folder / room}")
            continue
        before = fingerprint(folder / room)
        for case in (*CASES, *(("peer", "degraded_peer") if peer else ())):
            if room != "replica" or case in ("exact", "peer"):
                rows[f"{room}/{case}"] = [measure(room, case, seed) for seed in range(1, seeds + 1)]
                common.say(f"{room} {case}: pq={statistics.mean(one['pq'] for one in rows[f'{room}/{case}']):.3f}")
        unchanged = unchanged and fingerprint(folder / room) == before
    if kept:
        kept.write_text(json.dumps({**source, "rows": rows}, indent=1))
    if not rows:
        raise common.Failed(f"{folder}: no run of {', '.join(only)}")
    print(table_of(data_rows({"rows": rows}), ("pq", "sq", "rq", "mcov", "count_error", "seconds")))

    def mean(case, key, rooms=ROOMS):
        values = [one[key] for room in rooms for one in rows.get(f"{room}/{case}", [])]
        return statistics.mean(values) if values else None

    on_device = {"cpu_pq": mean("exact", "pq"), "cpu_seconds": mean("exact", "seconds")} if cpu else {
        "seconds_gpu": mean("exact", "seconds")}
    same = {"miou_change": 0, "psnr_change": 0} if unchanged else {}
    return {**{f"{case}_pq": mean(case, "pq") for case in (*CASES, "peer")}, **on_device, **same,
            "replica_pq": mean("exact", "pq", ["replica"]), "peer_seconds": mean("peer", "seconds"),
            "count_error": mean("exact", "count_error")}
