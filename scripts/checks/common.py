"""What the steps of scripts/release_check share: commands with their errors, folders, arguments and the last line."""
import argparse
import contextlib
import json
import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "release"
QUICKSTART = ROOT / "configs" / "quickstart.yaml"


class Failed(RuntimeError):
    """A command that a step needs has failed, or something that it needs is not there."""


def say(text):
    print(f"release_check: {text}", file=sys.stderr, flush=True)


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


def write_pictures(pattern, raw, width, height, pixels, *filters):
    run("ffmpeg", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", pixels, "-s", f"{width}x{height}",
        "-i", "-", *filters, "-start_number", "0", pattern, input=raw, text=None, encoding=None)


def commit():
    git = ["git", "-C", ROOT, "rev-parse", "--short", "HEAD"]
    return subprocess.run(git, capture_output=True, text=True).stdout.strip() or "unknown"


def parser_of(step):
    """A parser of the step's words, whose help is what the function says of itself."""
    return argparse.ArgumentParser(prog=f"release_check {step.__name__}", description=step.__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)


def add_build(parser):
    parser.add_argument("--build", type=pathlib.Path, default=BUILD, metavar="FOLDER",
                        help="folder of the build that is measured (default: build/release)")


@contextlib.contextmanager
def work_folder(keep=None):
    """`keep`, which is made, or else a folder for the time being."""
    with tempfile.TemporaryDirectory(prefix="semfield_check_") as temporary:
        folder = pathlib.Path(keep or temporary).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        yield folder


def print_line(name, figures, formats):
    """The last line: `name: key=value ...`, each value in the format of its key; n/a where none is known."""
    shown = (format(figures[key], form) if figures.get(key) is not None else "n/a" for key, form in formats.items())
    print(f"{name}: " + " ".join(f"{key}={value}" for key, value in zip(formats, shown)))
