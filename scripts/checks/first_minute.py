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
MOST_CPU_S, MOST_OFF = 360, 0.15
FIGURES = ("build_cpu_s", "demo_wall_s", "time_asked", "time_trained", "resume_trained", "advice_right")


class Measurement:
    def __init__(self, options, folder):
        self.options, self.folder, self.figures, self.broken = options, folder, {}, 0
        self.build_folder = (options.program or common.BUILD).resolve()

    def promise(self, kept, text):
        common.say(text if kept else f"BROKEN: {text}")
        self.broken += not kept

    def semfield(self, *words):
        return common.ask(self.build_folder / "bin" / "semfield", *words, cwd=self.folder)

    def write(self, name, text):
        (self.folder / name).write_text(text, encoding="utf-8")
        return name

    def build(self):
        clone = self.folder / "clone"
        common.run("git", "clone", "-q", "--no-hardlinks", common.ROOT, clone)
        environment = {**os.environ, "CCACHE_DISABLE": "1", "XDG_CACHE_HOME": str(self.folder / "cache")}
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        # The demo in two parts, of which the first is all of its building.
        common.run("./scripts/setup", cwd=clone, env={**environment, "SEMFIELD_TARGET": "semfield_app"})
        after, wall_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - begin
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        common.say(common.run("./scripts/demo", cwd=clone, env=environment).strip().split("\n")[-1])
        self.figures.update(build_cpu_s=f"{cpu_s:.0f}", demo_wall_s=f"{time.monotonic() - begin:.0f}")
        self.promise(cpu_s <= MOST_CPU_S,
                     f"the build took {cpu_s:.0f} s of CPU time of {MOST_CPU_S} ({wall_s:.0f} s here)")
        if self.options.program is None:
            self.build_folder = clone / "build" / os.environ.get("SEMFIELD_PRESET", "release")

    def length(self):
        asked, preset = self.options.time, self.options.preset
        config = os.path.abspath(preset) if os.path.exists(preset) else preset
        trained, ended = [], 0
        for words in ["train", config, "--out", "run"], ["train", "--resume", "run"]:
            out = self.semfield(*words, "--time", f"{asked:g}s")
            trained.append(out.get("trained_s", out["train_s"] - ended))
            ended = out["train_s"]
            self.promise(abs(trained[-1] / asked - 1) <= MOST_OFF,
                         f"{' '.join(words)}: trained for {trained[-1]:.1f} s of {asked:g}, up to step {out['step']}")
        names = ("time_trained", "resume_trained")
        self.figures.update(time_asked=f"{asked:g}", **{name: f"{value:.1f}" for name, value in zip(names, trained)})

    def psnr_of(self, name, section, advised):
        """PSNR of each preset that fits the scene, on all held-out frames."""
        psnr, scored = {}, None
        for preset in PRESETS:
            if preset == "object" and advised != preset:
                continue  # for plain backgrounds alone
            run = f"runs/{name}_{preset}"
            config = self.write(f"{name}_{preset}.yaml", f"include: presets/{preset}.yaml\n{section}")
            try:
                self.semfield("train", config, "--time", f"{self.options.train_time:g}s", "--out", run)
                scores = self.semfield("eval", run)  # every pixel of every frame, which a timed training may not score
            except common.Failed as failed:
                common.say(f"{name}: {preset} cannot be trained: {failed}")
                continue
            part = scores["frames"], scores["pixels"]
            if part != (scored or part):
                raise common.Failed(f"{name}: presets were scored on other frames or pixels: {part}, {scored}")
            psnr[preset], scored = scores["psnr"], part
            shutil.rmtree(self.folder / run)
        return psnr

    def advice(self):
        indices = self.options.scenes.resolve().glob("*/transforms*.json")
        scenes = sorted({index.parent for index in indices if not re.search("_(test|val)", index.name)})
        held = []
        for scene in scenes:
            section = (f"scene:\n  type: transforms_json\n  root: {json.dumps(str(scene))}\n"
                       f"  load: {{downscale: {self.options.downscale}}}\n")
            # What inspect advises does not depend on the preset that it is asked with.
            config = self.write(f"{scene.name}.yaml", f"include: presets/room.yaml\n{section}")
            report = self.semfield("inspect", config)
            if not report.get("preset"):
                common.say(f"{scene.name}: inspect advises no preset")
                continue
            advised = pathlib.Path(report["preset"]).stem
            if report.get("background"):
                section += f"rendering: {{background: {json.dumps(report['background'])}}}\n"
            psnr = self.psnr_of(scene.name, section, advised)
            held.append(advised in psnr and psnr[advised] >= max(psnr.values()) - self.options.margin)
            shown = ", ".join(f"{preset} {value:.2f}" for preset, value in psnr.items())
            self.promise(held[-1], f"{scene.name}: {advised} is advised; held-out PSNR {shown}")
        self.figures["advice_right"] = f"{sum(held)}/{len(held)}"


def first_minute(words):
    """Measures what the first minutes with Semfield promise, in parts:

  build   a clean build of the demo from a clone of HEAD with the compiler's cache off, then the demo from there
  length  trains for --time seconds, resumes for as many more, and compares what was asked with what was trained
  advice  for every scene of --scenes: is the preset that `semfield inspect` advises at least as good, on held-out
          frames, as each other one after --train-time seconds of training?

Exit code 1 where a promise is broken: more than 360 s of CPU time for the build, a training more than 15 % longer or
shorter than asked, an advice that is worse by more than --margin dB.
The last line is `first_minute: build_cpu_s=... ... advice_right=...`; n/a is what was left out."""
    parts = ("build", "length", "advice")
    parser = common.parser_of(first_minute)
    parser.add_argument("--only", default=",".join(parts), metavar="LIST", help="parts (default: %(default)s)")
    parser.add_argument("--program", type=pathlib.Path, metavar="FOLDER",
                        help="build folder of the program (default: that of the part build, else build/release)")
    parser.add_argument("--preset", default="quickstart", help="of the part length (default: %(default)s)")
    parser.add_argument("--time", type=float, default=20, help="seconds that it asks for (default: %(default)s)")
    parser.add_argument("--scenes", type=pathlib.Path, metavar="FOLDER", help="of folders with a transforms.json")
    parser.add_argument("--train-time", type=float, default=60, help="seconds of each training of advice (%(default)s)")
    parser.add_argument("--downscale", type=int, default=2, help="what images are divided by there (%(default)s)")
    parser.add_argument("--margin", type=float, default=0.3, help="dB that an advised preset may lose (%(default)s)")
    options = parser.parse_args(words)
    if not set(options.only.split(",")) <= set(parts):
        parser.error(f"--only: the parts are {', '.join(parts)}")
    with common.work_folder() as folder:
        measurement = Measurement(options, folder)
        for part in (part for part in parts if part in options.only.split(",")):
            if part == "advice" and not options.scenes:
                common.say("advice is not measured: name a folder of scenes with --scenes")
                continue
            try:
                getattr(measurement, part)()
            except common.Failed as failed:
                measurement.promise(False, f"{part}: {failed}")
    common.print_line("first_minute", measurement.figures, dict.fromkeys(FIGURES, ""))
    return 1 if measurement.broken else 0
