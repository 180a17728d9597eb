"""The program as tests run it, each in a folder of its own, and a room to give it. They take the modules that this file imports along with it."""

import collections
import fcntl
import functools
import json
import math
import os
import pathlib
import pty
import shlex
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
import unittest
import zlib

SOURCE = pathlib.Path(__file__).resolve().parent.parent
# SEMFIELD_PROGRAM names a copy, for long runs during rebuilds.
PROGRAM = os.environ.get("SEMFIELD_PROGRAM") or os.environ.get("SEMFIELD_BINARY", "semfield")
Result = collections.namedtuple("Result", "code out err")  # code: minus the signal that ended it

# A small network on ROOM, which a test replaces; `train` lines come last, so that a test adds sections.
CONFIG = """scene: ROOM
rendering: {density_activation: softplus, far: background}
semantics: {hidden_width: 32, weight: 0.002}
passes:
  - name: main
    sampler: {type: occupancy_grid, resolution: 32, warmup_steps: 32, max_samples: 96, keep_last: true}
    position: {type: hash_grid, levels: 6, log2_entries: 11, finest_resolution: 64}
    direction: {type: spherical_harmonics, degree: 2}
    field: {type: tiny_mlp, hidden_width: 32, color_width: 32}
train: {steps: 200, rays: 192, adam: {learning_rate: 0.02}}
"""
ROOM = "{type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1}"


def on_terminal(words, folder, env=None):
    """Exit code of a program on a terminal of 80 columns in the folder, and all that it wrote."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen([str(word) for word in words], cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs,
                               start_new_session=True, env={**os.environ, **(env or {})})
    os.close(theirs)
    written = b""
    try:
        while part := os.read(ours, 4096):
            written += part
    except OSError:
        pass  # its end
    os.close(ours)
    return process.wait(), written.decode(errors="replace")


def png_file(chunks):
    """Of (name, bytes) of its chunks."""
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
        for name, part in chunks)


def png(path, width, height, color, bits, rows):
    """`rows`: bytes of each row. color 0: grey, 2: RGB."""
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    path.write_bytes(png_file(((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))))


def png_bytes(path):
    """Of the pixels of an image of grey or RGB, row by row."""
    data, rows, at, packed = path.read_bytes(), [], 8, b""
    width, _, bits, color = struct.unpack_from(">IIBB", data, 16)
    step = (3 if color == 2 else 1) * bits // 8
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        packed += data[at + 8:at + 8 + size] if kind == b"IDAT" else b""
        at += size + 12
    lines, above = zlib.decompress(packed), bytes(width * step)
    for begin in range(0, len(lines), width * step + 1):
        row = bytearray()
        for x, value in enumerate(lines[begin + 1:begin + 1 + width * step]):
            left, corner, up = row[x - step] if x >= step else 0, above[x - step] if x >= step else 0, above[x]
            near = min((left, up, corner), key=lambda one: abs(left + up - corner - one))
            row.append(value + (0, left, up, (left + up) // 2, near)[lines[begin]] & 255)
        rows.append(above := bytes(row))
    return b"".join(rows)


def write_room(folder, frames=5, width=40, height=30):
    """A box room of six walls, each a class, in the layout of Replica: photographs, depth, classes and instances."""
    half, names = (2, 1.5, 2.5), ("rgb", "depth", "semantic_class", "semantic_instance")
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
    poses = []
    for i in range(frames):
        c, s, at = math.cos(0.2 * i), math.sin(0.2 * i), (0.1 * i - 0.3, 0.05 * i, 0.2)
        poses.append(" ".join(f"{v:.12g}" for v in (c, 0, s, at[0], 0, 1, 0, at[1], -s, 0, c, at[2], 0, 0, 0, 1)))
        color, depth, label = [], [], []
        for y in range(height):
            row = []
            for x in range(width):
                d = ((x + 0.5) / (0.5 * width) - 1, (y + 0.5 - 0.5 * height) / (0.5 * width), 1)
                ray = (c * d[0] + s * d[2], d[1], -s * d[0] + c * d[2])
                row.append(min((((half[a] if ray[a] > 0 else -half[a]) - at[a]) / ray[a], 2 * a + (ray[a] > 0))
                               for a in range(3) if ray[a]))  # the nearest wall: distance along z, and which
            color.append(bytes(40 * wall + 10 * k + 5 for _, wall in row for k in range(3)))
            depth.append(struct.pack(f">{width}H", *(round(1000 * t) for t, _ in row)))
            label.append(bytes(wall + 1 for _, wall in row))
        for name, kind, bits, rows in zip(names, (2, 0, 0, 0), (8, 16, 8, 8), (color, depth, label, label)):
            png(folder / name / f"{name}_{i}.png", width, height, kind, bits, rows)
    (folder / "traj_w_c.txt").write_text("\n".join(poses) + "\n")
    (folder / "classes.yaml").write_text("- {id: 0, name: void, ignore: true}\n" + "".join(
        f"- {{id: {k + 1}, name: {name}}}\n" for k, name in enumerate("west east ceiling floor south north".split())))


@functools.cache
def crc_table():
    table = list(range(256))
    for _ in range(8):
        table = [crc >> 1 ^ (0x82F63B78 if crc & 1 else 0) for crc in table]
    return table


def crc32c(data):
    crc, table = 0xFFFFFFFF, crc_table()
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 255]
    return crc ^ 0xFFFFFFFF


def newest_step(run):
    """Of its checkpoints; -1: there is none."""
    return max((int(path.stem[5:]) for path in (run / "checkpoints").glob("step_*.safetensors")), default=-1)


@functools.cache
def sound_tensors(path, changed_at):
    """Bytes of a checkpoint's tensors by name; AssertionError where the file is damaged."""
    data = path.read_bytes()
    begin = 8 + struct.unpack_from("<Q", data)[0]
    header = json.loads(data[8:begin])
    at = data.index(mark := b'"semfield.crc32c":"') + len(mark)
    assert int(data[at:at + 8], 16) == crc32c(data[:at] + b"00000000" + data[at + 8:]), f"{path} is damaged"
    header.pop("__metadata__")
    return {name: data[begin + one["data_offsets"][0]:begin + one["data_offsets"][1]] for name, one in header.items()}


def tensors(run):
    """Of the newest checkpoint."""
    path = run / f"checkpoints/step_{newest_step(run):08}.safetensors"
    return sound_tensors(path, path.stat().st_mtime_ns)


def until(condition, seconds=60):
    """What `condition` gives once it is true, or at last."""
    end = time.monotonic() + seconds
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    return found


class Started:
    """A program that runs during the test; its output goes to files of `folder`."""

    def __init__(self, words, folder, env=None, program=PROGRAM):
        self.out_file, self.err_file = folder / "stdout", folder / "stderr"
        with open(self.out_file, "wb") as out, open(self.err_file, "wb") as err:
            self.process = subprocess.Popen([program, *map(str, words)], cwd=folder, stdin=subprocess.DEVNULL,
                                            stdout=out,
                                            stderr=err, env={**os.environ, **(env or {})})
        self.pid = self.process.pid

    def err(self):
        return self.err_file.read_text(errors="replace")

    def send(self, number):
        self.process.send_signal(number)

    def wait(self, seconds=None):
        code = self.process.wait(seconds)
        return Result(code, self.out_file.read_text(errors="replace"), self.err())

    def kill(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class ProgramCase(unittest.TestCase):
    maxDiff = None

    def setUp(self):
        self.dir = self.folder()

    def folder(self):
        """A fresh one, removed at the end."""
        made = tempfile.TemporaryDirectory(prefix="semfield_test_", ignore_cleanup_errors=True)
        self.addCleanup(made.cleanup)
        return pathlib.Path(made.name)

    def room(self, steps=200, every_s=0, more="", folder=None):
        """Packs the analytic room and writes config.yaml, which trains on it and saves so often; the file's path."""
        folder = folder or self.dir
        subprocess.run([os.environ["SEMFIELD_ANALYTIC_ROOM"], folder / "room.sfpack"], check=True)
        config = CONFIG.replace("ROOM", "{type: packed, file: room.sfpack}").replace("steps: 200", f"steps: {steps}")
        report = f"report: {{eval_every_s: 0, strips: 0, log_every_steps: 5, checkpoint_every_s: {every_s}}}\n"
        (folder / "config.yaml").write_text(config + report + more)
        return folder / "config.yaml"

    def write(self, name, text):
        path = self.dir / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    def start(self, *words, folder=None, env=None, program=PROGRAM):
        """Killed at the end, where it still runs."""
        started = Started(words, folder or self.folder(), env, program)
        self.addCleanup(started.kill)
        return started

    def semfield(self, words, folder=None, env=None):
        """The program's Result for words, a list or a text as a shell has it."""
        done = subprocess.run([PROGRAM, *(shlex.split(words) if isinstance(words, str) else map(str, words))],
                              cwd=folder or self.dir, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                              errors="replace", env={**os.environ, **(env or {})})
        return Result(done.returncode, done.stdout, done.stderr)

    def limited(self, limit, words, env=None):
        """By `ulimit`."""
        command = f"ulimit {limit}; exec {shlex.join(map(str, [PROGRAM, *words]))}"
        return self.start("-c", command, env=env, program="/bin/sh").wait()

    def on_terminal(self, words, env=None):
        """on_terminal() in the test's folder."""
        return on_terminal(words, self.dir, env)

    def ok(self, words, folder=None, env=None):
        """The Result of words that end in 0."""
        result = words if isinstance(words, Result) else self.semfield(words, folder, env)
        self.assertEqual(result.code, 0, f"{words}: {result.err}")
        return result

    def ended(self, words, code, *said, **more):
        """The Result of words that end in the code, each of `said` in what goes to standard error."""
        result = words if isinstance(words, Result) else self.semfield(words, **more)
        self.assertEqual(result.code, code, f"{words}: {result.err}{result.out}")
        self.has(result.err, *said)
        return result

    def has(self, text, *parts):
        for part in parts:
            self.assertIn(part, text)

    def lacks(self, text, *parts):
        for part in parts:
            self.assertNotIn(part, text)


def main():
    """Ends in 77, which CTest calls skipped, where all that ran holds and some of it was left out."""
    done = unittest.main(module="__main__", exit=False).result
    sys.exit(77 if done.wasSuccessful() and done.skipped else int(not (done.wasSuccessful() and done.testsRun)))


__all__ = [name for name in dir() if not name.startswith("_")]
