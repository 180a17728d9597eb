"""What the first minutes with Semfield promise, and what a release has to show."""
import json
import os
import pathlib
import re
import resource
import shutil
import subprocess
import sys
import time

from . import common, hand_over

sys.path.insert(1, str(common.ROOT / "tests"))
from program import on_terminal  # noqa: E402

COLUMNS = 80  # of its terminal
PROGRAM = "framework", "plugins", "configs"  # what figures depend on
COMMIT = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*\d)[0-9a-f]{8}\b")


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


def lines_of(words, folder):
    """What a program that ends well shows on a terminal, line by line as it stood at last, without colours."""
    code, said = on_terminal(words, folder, {"SEMFIELD_CACHE": str(folder / "cache")})
    text = re.sub(r"\x1b\[[0-9;]*[mK]", "", said.replace("\r\n", "\n"))
    if code != 0:
        raise common.Failed(f"`{' '.join(map(str, words))}` ended with {code}: {text[-800:]}")
    return [line.rsplit("\r", 1)[-1] for line in text.split("\n")]


def terminal(semfield, folder):
    """The demo and what it advises, as a person would type it, on a terminal."""
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    lines = lines_of([semfield, "demo"], folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    figures = {"demo_s": time.monotonic() - begin,
               "demo_cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}
    common.say(f"load {os.getloadavg()[0]:.1f} at the end; " + " ".join(" ".join(lines).split("demo: ")[-1].split()))
    figures["demo_size"] = re.search(r"render: \S+ size=(\S+)", " ".join(lines))[1]
    common.check((folder / "runs/demo/first_look.png").exists(), "the demo has no first picture")
    advised = [line.split("   # ")[0].strip() for line in lines[lines.index("next"):] if str(semfield) in line]
    failed = 0
    for line in advised:
        # A page is served until somebody stops it, and five minutes more are as good as one second.
        words = re.sub(r"--time \S+", "--time 1s", line.split(None, 1)[1]).split()
        try:
            if words[0] == "view":
                with common.served(semfield, *words, cwd=folder):
                    continue
            lines += lines_of([semfield, *words], folder)
        except common.Failed as wrong:
            failed += not common.check(False, str(wrong))
    common.check(len(advised) >= 3, f"the demo advises {len(advised)} commands")
    for words in (["inspect", "runs/demo/run.yaml"], ["train", "quickstart", "--dry-run"], ["mesh", "runs/demo"]):
        lines += lines_of([semfield, *words], folder)
    wide = [line for line in lines if len(line) > COLUMNS and not line.lstrip(" $").startswith(str(semfield))]
    for line in wide:
        common.say(f"wider than {COLUMNS} columns: {line}")
    return {**figures, "next_lines_failed": failed, "wrapped_lines": len(wide)}


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


def first_minute(*, only: "parts" = ("build", "terminal", "length", "old"),
                 program: "build folder of the program; else of the part build, or build/release" = None,
                 preset: "of the part length" = "quickstart", time_: "seconds that it asks for" = 20.0,
                 runs: "FOLDER of what 1.0.0 made: folders with run, clicked, scene.sfpack and scene.sfpack.yaml" = None):
    """Measures what the first minutes with Semfield promise, in parts:

  build   a clean build of the demo from a clone of HEAD with the compiler's cache off, then the demo from there
  terminal  the demo on a terminal of 80 columns, every command that it advises, and lines too wide for it
  length  trains for --time seconds, resumes for as many more, and compares what was asked with what was trained
  old     runs, packed scenes and clicks of --runs are opened

A training more than 15 % longer or shorter than asked breaks a promise."""
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
                elif part == "old" and runs:
                    found = old_runs(build / "bin" / "semfield", folder, runs)
                else:
                    common.say(f"{part} is not measured: name a folder with --runs")
                    continue
                figures.update(found)
            except common.Failed as failed:
                common.check(False, f"{part}: {failed}")
    return figures


def counted(word, *words):
    """A figure of the last line of a script, which may fail by it."""
    done = subprocess.run([str(common.ROOT / words[0]), *words[1:]], capture_output=True, text=True)
    return int(re.search(rf"\b{word}=(\d+)", done.stdout)[1])


def evidence():
    """(place, commits that it names) of each row of evidence."""
    for page in [common.ROOT / "README.md", *sorted((common.ROOT / "docs/evidence").iterdir())]:
        text = page.read_text(encoding="utf-8")
        if page.suffix == ".json":
            rows = json.loads(text)
            rows = rows.values() if isinstance(rows, dict) else rows
            yield from ((page.name, COMMIT.findall(json.dumps(row))) for row in rows)
        elif page.suffix == ".md":
            yield from ((page.name, COMMIT.findall(line)) for line in text.split("\n"))


def release(run, old: "FOLDER of what 1.0.0 made, as first_minute --runs takes it", *, build=common.BUILD):
    """Asks first_minute, pages, scripts/pictures and the documents. A row of evidence is old if framework, plugins or
configs differ by more than includes from those of a commit that it names; the last line counts them, for files as for tables."""
    found = first_minute(only=("terminal", "old"), program=build, runs=old)
    found |= hand_over.pages(run, build=build)
    found["pictures_stale"] = counted("stale", "scripts/pictures", "--stale")
    rows = [(place, commits) for place, commits in evidence() if commits]
    aged = {commit: common.has_changed(commit, PROGRAM) for commit in {one for _, commits in rows for one in commits}}
    old_rows = [place for place, commits in rows if any(aged[commit] for commit in commits)]
    for place in sorted(set(old_rows)):
        common.say(f"{place}: {old_rows.count(place)} old rows")
    found["evidence_rows_old"] = len(old_rows)
    found["words"] = counted("words", "tests/docs/docs_check.py", "--root", str(common.ROOT))
    return found
