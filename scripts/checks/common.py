"""What the steps of scripts/release_check share: their words, commands with their errors, folders and the last line."""
import argparse
import contextlib
import datetime
import inspect
import json
import pathlib
import re
import signal
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "release"
QUICKSTART = ROOT / "configs" / "quickstart.yaml"
# Of words that several steps have.
HELP = {"build": "folder of the build that is measured", "keep": "FOLDER in which to leave what was made",
        "run": "run folder", "mirror": "URL of Debian's packages (default: that of mmdebstrap)",
        "ccache": "FOLDER of the compiler's cache in the systems"}
wrongs = []  # what check() found


class Failed(RuntimeError):
    """A command that a step needs has failed, or something that it needs is not there."""


def say(text):
    print(f"{pathlib.Path(sys.argv[0]).name}: {text}", file=sys.stderr, flush=True)


def check(good, text):
    """Says what is wrong, which the exit code counts; whether it is good."""
    if not good:
        wrongs.append(text)
        say(f"WRONG: {text}")
    return good


def attempt(*parts):
    """Calls each; one that fails leaves its figures out and does not end the others."""
    for part in parts:
        try:
            part()
        except Failed as failed:
            say(str(failed))


def run(*words, **more):
    """What the command prints; Failed, with the end of what it complained of, where it does not end with 0."""
    words = [str(word) for word in words]
    done = subprocess.run(words, **{"capture_output": True, "text": True, "encoding": "utf-8", **more})
    if done.returncode != 0:
        complaint = ((done.stdout or "") + (done.stderr or "")).strip()[-800:]
        raise Failed(f"`{' '.join(words)}` ended with {done.returncode}: {complaint}")
    return done.stdout


def ask(*words, **more):
    """The object that a verb of the program prints."""
    return json.loads(run(*words, "--json", "--quiet", **more))


def read_pictures(pattern, pixels):
    """Bytes of the picture, or of all that a pattern names, one after the other."""
    return run("ffmpeg", "-v", "error", "-i", pattern, "-f", "rawvideo", "-pix_fmt", pixels, "-",
               text=None, encoding=None)


def write_pictures(pattern, raw, width, height, pixels):
    run("ffmpeg", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", pixels, "-s", f"{width}x{height}",
        "-i", "-", "-start_number", "0", pattern, input=raw, text=None, encoding=None)


def has_changed(commit, folders):
    """Whether more than documents, includes and empty lines of the folders, which move no bit, differ from a commit's;
    true also of an unknown commit."""
    done = subprocess.run(["git", "-C", ROOT, "diff", "--numstat", "-I", "^#include ", "--ignore-blank-lines", commit, "--",
                           *folders, ":(exclude)*.md"], capture_output=True, text=True)
    return done.returncode != 0 or done.stdout != ""


def source(command, n, environment=None, device="CPU"):
    """Where a figure comes from, as docs/evidence wants it; `environment` is a run's environment.json."""
    git = ["git", "-C", ROOT, "rev-parse", "--short", "HEAD"]
    if environment:
        ran = json.loads(environment.read_text())
        device = ran.get("device", "cpu").split(",")[0]
        device = f"{ran['cpu']}, {ran['threads']} threads" if device == "cpu" else device
    return {"date": datetime.date.today().isoformat(), "device": device, "command": command, "n": n,
            "commit": subprocess.run(git, capture_output=True, text=True).stdout.strip() or "unknown"}


@contextlib.contextmanager
def work_folder(keep=None):
    """`keep`, which is made, or else a folder for the time being."""
    with tempfile.TemporaryDirectory(prefix="semfield_check_") as temporary:
        folder = pathlib.Path(keep or temporary).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        yield folder


@contextlib.contextmanager
def served(*words, **more):
    """The address of the page that a verb serves, until it is left."""
    words = [*words, "--json", "-q"]
    program = subprocess.Popen([str(word) for word in words], stdout=subprocess.PIPE, text=True, **more)
    try:
        yield json.loads(program.stdout.readline() or run(*words, **more))["url"]
    finally:
        program.send_signal(signal.SIGINT)
        program.wait()


def some_of(names):
    """Reads a list with commas of some of the names."""
    def read(text):
        if not set(text.split(",")) <= set(names):
            raise argparse.ArgumentTypeError(f"they are {', '.join(names)}")
        return text.split(",")
    return read


def arguments(step, program, about):
    """A parser of the words that a step's signature declares: parameters are words and keywords are options, an
    annotation is the help, a default names the type, of which a tuple of names is for some of them. A word without a
    default is a path."""
    parser = argparse.ArgumentParser(prog=program, description=about,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    for one in inspect.signature(step).parameters.values():
        default, name = one.default, one.name.rstrip("_").replace("_", "-")
        is_option = one.kind is one.KEYWORD_ONLY
        about = HELP.get(one.name, "") if one.annotation is one.empty else one.annotation
        more = {"help": about, "metavar": name.upper()}
        if one.kind is one.VAR_POSITIONAL:
            more["nargs"] = "*"
        elif default is one.empty:
            more["type"] = pathlib.Path
        elif default is False:
            more = {"help": about, "action": "store_true"}
        elif isinstance(default, tuple) and isinstance(default[0], str):
            more.update(type=some_of(default), default=list(default))
            more["help"] += f" (default: {','.join(default)})"
        else:
            values = default if isinstance(default, tuple) else (default,)
            more.update(default=default, type=str if default is None else type(values[0]))
            if values is default or not is_option:
                more["nargs"] = len(values) if values is default else "?"
            more["help"] += "" if default in (None, "") else f" (default: {default})"
        dash = "" if not is_option else "--" if len(name) > 1 else "-"
        parser.add_argument(dash + name, **more, **({"dest": one.name} if is_option else {}))
    return parser


def call(step, words, line, program):
    """Calls a step with words of the command line and prints its last line; the exit code.

    `line` has `key:format` of each figure that the step returns, and perhaps a bound, `key:format<=3`. n/a is what was
    not measured."""
    last = "\n\nThe last line is `%s: %s`." % (step.__name__, re.sub(r":\S*", "=...", line)) if line else ""
    bounds = re.findall(r"(\w+):[^<>\s]*([<>]=\S+)", line)
    last += " It fails beyond " + ", ".join(map("".join, bounds)) + "." if bounds else ""
    given = vars(arguments(step, program, step.__doc__ + last).parse_args(words))
    plain = []
    for one in inspect.signature(step).parameters.values():
        if one.kind is one.VAR_POSITIONAL:
            plain += given.pop(one.name)
        elif one.kind is not one.KEYWORD_ONLY:
            plain.append(given.pop(one.name))
    found = step(*plain, **given)
    if isinstance(found, dict):
        shown = []
        for key, form, bound in re.findall(r"(\w+):([^<>\s]*)(\S*)", line):
            value = found.get(key)
            shown.append(f"{key}={'n/a' if value is None else format(value, form)}")
            if bound and value is not None:
                good = value <= float(bound[2:]) if bound[0] == "<" else value >= float(bound[2:])
                check(good, f"{key} is {value}, which has to be {bound}")
        print(f"{step.__name__}: " + " ".join(shown))
        found = 0
    return found or int(bool(wrongs))
