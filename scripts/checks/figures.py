"""What the first minutes with Semfield promise."""
import contextlib
import fcntl
import json
import os
import pathlib
import pty
import re
import resource
import shutil
import signal
import struct
import subprocess
import termios
import time

from . import common

PRESETS = ("room", "unbounded", "object")
COLUMNS = 80


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


def on_terminal(words, folder):
    """What a program that ends well shows on a terminal of 80 columns, line by line as it stood at last, without
    colours."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, COLUMNS, 0, 0))
    process = subprocess.Popen([str(word) for word in words], cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs,
                               env={**os.environ, "SEMFIELD_CACHE": str(folder / "cache")})
    os.close(theirs)
    said = b""
    with contextlib.suppress(OSError):  # its end
        while part := os.read(ours, 4096):
            said += part
    os.close(ours)
    text = re.sub(r"\x1b\[[0-9;]*[mK]", "", said.decode(errors="replace").replace("\r\n", "\n"))
    if process.wait() != 0:
        raise common.Failed(f"`{' '.join(map(str, words))}` ended with {process.returncode}: {text[-800:]}")
    return [line.rsplit("\r", 1)[-1] for line in text.split("\n")]


def terminal(program, folder):
    """The demo and what it advises, as a person would type it, on a terminal."""
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    lines = on_terminal([program, "demo"], folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    figures = {"demo_s": time.monotonic() - begin,
               "demo_cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}
    common.say(f"load {os.getloadavg()[0]:.1f} at the end; " + " ".join(" ".join(lines).split("demo: ")[-1].split()))
    figures["demo_size"] = re.search(r"render: \S+ size=(\S+)", " ".join(lines))[1]
    common.check((folder / "runs/demo/first_look.png").exists(), "the demo has no first picture")
    advised = [line.split("   # ")[0].strip() for line in lines[lines.index("next"):] if str(program) in line]
    failed = 0
    for line in advised:
        # A page is served until somebody stops it, and five minutes more are as good as one second.
        words = re.sub(r"--time \S+", "--time 1s", line.split(None, 1)[1]).split()
        if words[0] != "view":
            try:
                lines += on_terminal([program, *words], folder)
            except common.Failed as wrong:
                failed += not common.check(False, str(wrong))
        else:
            failed += not served([program, *words], folder)
    common.check(len(advised) >= 3, f"the demo advises {len(advised)} commands")
    for words in (["inspect", "runs/demo/run.yaml"], ["train", "quickstart", "--dry-run"], ["mesh", "runs/demo"]):
        lines += on_terminal([program, *words], folder)
    wide = [line for line in lines if len(line) > COLUMNS and not line.lstrip(" $").startswith(str(program))]
    for line in wide:
        common.say(f"wider than {COLUMNS} columns: {line}")
    return {**figures, "next_lines_failed": failed, "wrapped_lines": len(wide)}


def served(words, folder):
    """Whether a verb says where its page is, and then ends when it is asked to."""
    page = subprocess.Popen([str(word) for word in words], cwd=folder, stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True)
    said = ""
    while "http://" not in said and (line := page.stdout.readline()):
        said += line
    page.send_signal(signal.SIGINT)
    page.communicate()
    return common.check("http://" in said, f"`{' '.join(map(str, words))}` serves no page: {said}")


def old_runs(program, folder, runs):
    """How many kinds of what 1.0.0 made open today: a run folder, a packed scene with a configuration, and a run of
    clicks, of each scene that has a folder in RUNS."""
    kinds = {"run": ("eval run", "render run --out pictures", "train --resume run --steps 2", "mesh run --resolution 24",
                     "report run"),
             "scene.sfpack": ("init scene.sfpack --out new.yaml", "inspect scene.sfpack.yaml",
                              "pack scene.sfpack.yaml --out again.sfpack"),
             "clicked": ("labels export clicked --out labels.json", "train --resume clicked --steps 2")}
    wrong = set()
    for made in sorted(path for path in pathlib.Path(runs).resolve().iterdir() if path.is_dir()):
        shutil.copytree(made, folder / made.name)
        for kind, commands in kinds.items():
            for words in commands:
                try:
                    common.run(program, *words.split(), cwd=folder / made.name)
                except common.Failed as failed:
                    wrong.add(kind)
                    common.check(False, f"{made.name}: {failed}")
    return {"runs_of_1_0_opened": f"{len(kinds) - len(wrong)}/{len(kinds)}"}


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


def first_minute(*, only: "parts" = ("build", "terminal", "length", "advice", "old"),
                 program: "build folder of the program; else of the part build, or build/release" = None,
                 preset: "of the part length" = "quickstart", time_: "seconds that it asks for" = 20.0,
                 scenes: "FOLDER of folders with a transforms.json" = None,
                 runs: "FOLDER of what 1.0.0 made: folders with run, clicked, scene.sfpack and scene.sfpack.yaml" = None,
                 train_time: "seconds of each training of advice" = 60.0,
                 downscale: "what images are divided by there" = 2,
                 margin: "dB that an advised preset may lose" = 0.3):
    """Measures what the first minutes with Semfield promise, in parts:

  build   a clean build of the demo from a clone of HEAD with the compiler's cache off, then the demo from there
  terminal  the demo on a terminal of 80 columns, every command that it advises, and lines too wide for it
  length  trains for --time seconds, resumes for as many more, and compares what was asked with what was trained
  advice  for every scene of --scenes: is the preset that `semfield inspect` advises at least as good, on held-out
          frames, as each other one after --train-time seconds of training?
  old     runs, packed scenes and clicks of --runs are opened

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
                elif part == "terminal":
                    found = terminal(build / "bin" / "semfield", folder)
                elif part == "length":
                    found = trained_lengths(semfield, time_, preset)
                elif part == "advice" and scenes:
                    found = advice(semfield, folder, scenes, train_time, downscale, margin)
                elif part == "old" and runs:
                    found = old_runs(build / "bin" / "semfield", folder, runs)
                else:
                    common.say(f"{part} is not measured: name its folder with --scenes or --runs")
                    continue
                figures.update(found)
            except common.Failed as failed:
                common.check(False, f"{part}: {failed}")
    return figures
