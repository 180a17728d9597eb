"""What the first minutes with Semfield promise."""
import json
import os
import pathlib
import re
import resource
import shutil
import time

from . import common

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
