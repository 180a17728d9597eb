"""Runs the commands of pages: page_commands.py --program FILE --scenes FOLDER PAGE...

A page's blocks run in order, in a scratch folder that looks like the repository's: configs/ (presets made small), scenes/, scripts/,
data/ (what page_scenes.py made), and `semfield` in PATH; SEMFIELD_BUILD names the build. Blocks with `file=NAME` behind their language, the page's and
those of own_data.md, are saved there before, but for sources of plugins/. Every command of
a block marked `sh`, or behind `$ ` in one marked `console`, has to end with exit code 0; `semfield serve` and `view` are stopped when they serve, and
minutes of `--time` are 2 seconds. Blocks marked `python` without a file are one program, which runs last, where the build has the Python module.
A comment before a block says what a reader need not see, one thing per line:

  <!-- not run: needs a GPU -->                     the block is not run, for this reason
  <!-- run: first cp -r runs/a runs/b -->           a command before the block
  <!-- run: --frames 240 => --frames 4 -->          a text of the block replaced by a shorter one
  <!-- run: needs ffmpeg -->                        a program that may be missing
  <!-- run: exit 1 -->                              the exit code of the block's last command

Commands in blocks of another kind are refused: nothing would run them."""
import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time

sys.dont_write_bytecode = True
REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
BLOCK = re.compile(r"(?:^<!-- (?P<mark>(?:not )?run:\s(?:(?!-->).)*?)\s-->\n)?^```(?P<info>[^`\n]*)\n(?P<text>.*?)^```[ ]*$", re.M | re.S)
COMMAND = re.compile(r"^(?:\$ )?(?:semfield|(?:\./)?scripts/\w+|cmake|ctest|cpack|python3|pip|apt-get|apt|docker|mkdocs) .*", re.M)
SKIPPED = 69
SMALL = [(r"(\b|_)steps: [0-9]+", r"\1steps: 60"), (r"\brays: [0-9]+", "rays: 256"), (r"log2_entries: 0", "log2_entries: 10"),
         (r"resolution: 64", "resolution: 32"), (r"max_samples: [0-9]+", "max_samples: 8"), (r"\bframes: 200", "frames: 12, width_px: 48, height_px: 36"),
         (r"test_frames: [0-9]+", "test_frames: 2"), (r"\bframes: 60", "frames: 8"), (r"width_px: 160, height_px: 120", "width_px: 48, height_px: 36")]


def read(page):
    with open(os.path.join(REPOSITORY, page), encoding="utf-8") as file:
        return file.read()


def small_presets(folder):
    """Copies configs/ so that training takes a moment: fewer steps, rays, frames and samples."""
    for where, _, names in os.walk(os.path.join(REPOSITORY, "configs")):
        for name in names:
            path = os.path.join(where, name)
            with open(path, encoding="utf-8") as file:
                text = file.read()
            for large, small in SMALL:
                text = re.sub(r"(?m)^( *)frames: 200$", r"\1frames: 12\n\1width_px: 48\n\1height_px: 36", text)
                text = re.sub(large, small, text)
            to = os.path.join(folder, os.path.relpath(path, REPOSITORY))
            os.makedirs(os.path.dirname(to), exist_ok=True)
            with open(to, "w", encoding="utf-8") as file:
                file.write(text)


def commands_of(kind, text):
    """Commands of a block: its lines, those ending in a backslash joined with the next."""
    if kind == "console":
        return re.findall(r"^\$ (.*)", text, re.M)
    return [line for line in re.sub(r"\\\n\s*", "", text).split("\n") if line.strip() and not line.lstrip().startswith("#")]


class Scratch:
    """Where the commands of a page run."""

    def __init__(self, folder, program, scenes, texts):
        self.folder = folder
        small_presets(folder)
        for text in texts:
            self.save_named(text)
        for name in ("scenes", "scripts", "plugins"):
            os.symlink(os.path.join(REPOSITORY, name), os.path.join(folder, name))
        shutil.copytree(scenes, os.path.join(folder, "data"), symlinks=True)
        os.mkdir(os.path.join(folder, "bin"))
        os.symlink(program, os.path.join(folder, "bin", "semfield"))
        build = os.path.dirname(os.path.dirname(program))
        self.python = os.path.join(build, "python")
        self.environment = dict(os.environ, PATH=os.path.join(folder, "bin") + os.pathsep + os.environ["PATH"], HOME=folder,
                                SEMFIELD_CACHE=os.path.join(folder, ".cache"), OMP_WAIT_POLICY="passive",
                                SEMFIELD_BUILD=build)

    def save_named(self, text):
        """Writes the blocks that a page has to save; of two with one name the first."""
        for block in reversed(list(BLOCK.finditer(text))):
            name = re.fullmatch(r"(?:yaml|json|csv|text|python|cpp|cmake) file=(?!plugins/)(\S+)", block["info"])
            if name:
                path = os.path.join(self.folder, name[1])
                os.makedirs(os.path.dirname(path), exist_ok=True)
                with open(path, "w", encoding="utf-8") as file:
                    file.write(block["text"])

    def run(self, command):
        """Exit code and what it printed."""
        words = shlex.split(command, comments=True)
        if words[:2] in (["semfield", "serve"], ["semfield", "view"]):
            return self.serve(command, 0)
        done = subprocess.run(["bash", "-c", command], cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        return done.returncode, done.stdout

    def serve(self, command, shown_s):
        """The same of a command that serves a page, which is stopped so long after it has begun."""
        said = ""
        with subprocess.Popen(["bash", "-c", "exec " + command], cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
            for line in process.stdout:
                said += line
                if ": open http" in line:
                    time.sleep(shown_s)
                    process.send_signal(signal.SIGINT)
        return 0 if process.returncode == 128 + signal.SIGINT else process.returncode, said


def play(new_scratch, text):
    """(commands run, sentences on what is wrong, programs that are missing) of a page."""
    count, faults, missing, scratch, program = 0, [], [], None, []
    for block in BLOCK.finditer(text):
        kind = block["info"].partition(" ")[0]
        if kind not in ("sh", "console") and block["info"] != "python":
            hidden = COMMAND.search(block["text"])
            if hidden and kind not in ("cmake", "python", "cpp", "yaml", "dockerfile"):
                faults.append(f"'{hidden[0]}' is in a block marked '{kind}'; mark it sh or console, so that it is run")
            continue
        mark, exit_code, body, first = block["mark"] or "", 0, block["text"], []
        if mark.startswith("not run: "):
            continue
        clauses = [clause.strip() for clause in mark.removeprefix("run:").split("\n") if clause.strip()]
        for clause in clauses:
            if clause.startswith("first "):
                first.append(clause[len("first "):])
            elif clause.startswith("exit "):
                exit_code = int(clause[len("exit "):])
            elif clause.startswith("needs "):
                missing += [program for program in clause.split()[1:] if not shutil.which(program)]
            elif " => " in clause:
                long, short = clause.split(" => ")
                if long not in body:
                    faults.append(f"the block does not have '{long}', which its comment replaces")
                body = body.replace(long, short)
            else:
                faults.append(f"'{clause}' of a comment before a block means nothing")
        if kind == "python":
            program.append(body)
            continue
        commands = first + commands_of(kind, re.sub(r"(--time )[0-9.]+[mh]\b", r"\g<1>2s", body))
        if missing:
            continue
        scratch = scratch or new_scratch()
        for command in commands:
            expected = exit_code if command == commands[-1] else 0
            code, said = scratch.run(command)
            count += 1
            if code != expected:
                faults.append(f"`{command}` ends with {code}, not {expected}:\n{said[-2000:]}")
                break
    if program:
        scratch = scratch or new_scratch()
        if os.path.isdir(scratch.python):
            with open(os.path.join(scratch.folder, "page.py"), "w", encoding="utf-8") as file:
                file.write("\n".join(program))
            code, said = scratch.run(f"PYTHONPATH={shlex.quote(scratch.python)} {shlex.quote(sys.executable)} page.py")
            count += len(program)
            if code != 0:
                faults.append(f"the page's Python ends with {code}:\n{said[-2000:]}")
    return count, faults, missing


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True)
    parser.add_argument("--scenes", required=True, help="folder that page_scenes.py made")
    parser.add_argument("pages", nargs="+")
    options = parser.parse_args()
    bad, gone, own_data = 0, [], read("docs/guide/own_data.md")
    for page in options.pages:
        text = read(page)
        with tempfile.TemporaryDirectory(prefix="semfield_page_") as folder:
            count, faults, missing = play(lambda: Scratch(folder, os.path.abspath(options.program), options.scenes, (own_data, text)), text)
        for fault in faults:
            print(f"{page}: {fault}")
        print(f"{page}: commands={count} faults={len(faults)}" + (f" NOT RUN for want of {' '.join(missing)}" if missing else ""))
        bad, gone = bad + len(faults), gone + missing
    return 1 if bad else (SKIPPED if gone else 0)


if __name__ == "__main__":
    sys.exit(main())
