#!/usr/bin/env python3
"""The tables of bad files through the program: its exit code, what it says, and what refusing costs.

bad_files_test.py TABLE PROGRAM [MISSING...]: MISSING are `images`, `raycast` (formats that the build does not read) and
`measures` (a sanitizer's memory and time count for nothing). README.md has the words of the tables.
"""

import math
import os
import pathlib
import re
import resource
import shutil
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import zlib

HERE = pathlib.Path(__file__).parent
sys.path.insert(0, str(HERE.resolve().parent))
from program import crc32c, png_bytes, png_file  # noqa: E402

TABLE, PROGRAM, MISSING = sys.argv[1], pathlib.Path(sys.argv[2]).resolve(), sys.argv[3:]
# A network for configurations that include it.
SMALL = """passes:
  - name: main
    sampler: {type: stratified, samples: 8}
    position: {type: frequency, frequencies: 2}
    field: {type: nerf_mlp, depth: 2, width: 16, skip_at: 0}
train: {steps: 2, rays: 8}
"""


class Case:
    """A case, or a base."""

    def __init__(self, place, name, base, follows=False):
        self.place, self.name, self.base, self.follows, self.edits, self.words = place, name, base, follows, [], ""
        self.code, self.most_mib, self.file_kib, self.says, self.never, self.files = None, 256, 0, [], [], []


def unescaped(text):
    """With \\n, \\t, \\r, \\0, \\xHH and \\\\ as what they mean; any other character behind a backslash as itself."""
    known = {"n": b"\n", "t": b"\t", "r": b"\r", "0": b"\0"}
    plain = lambda at: bytes.fromhex(at[1]) if at[1] else known.get(at[2], at[2].encode())
    parts, last = [], 0
    for at in re.finditer(r"\\(?:x([0-9a-f]{2})|(.))", text):
        parts += [text[last:at.start()].encode(), plain(at)]
        last = at.end()
    return b"".join(parts) + text[last:].encode()


def named(files):
    """a{b,c}d is abd and acd."""
    at = re.fullmatch(r"(.*)\{(.*)\}(.*)", files)
    return [at[1] + one + at[3] for one in at[2].split(",")] if at else [files]


def read_cases(path):
    """Bases by name, and the cases."""
    bases, cases, now, first, in_case = {}, [], None, 0, False
    lines = iter(enumerate(path.read_text(encoding="utf-8").splitlines(), 1))
    for number, line in lines:
        place = f"{path.name}:{number}"
        begun = re.fullmatch(r"(base|case|or|then)(?: (\w+))?(?: (\w+))?(?:: (.*))?", line)
        if begun:
            verb, name, base, line = begun.groups()
            if verb == "base":
                now = bases[name] = Case(place, name, base)
                now.words = bases[base].words if base else ""
            else:
                first = len(cases) if verb != "or" else first
                base = base or (list(bases)[-1] if verb == "case" else now.base)
                now = Case(place, name or now.name, base, verb == "then")
                cases.append(now)
            in_case = verb != "base"
        verb, _, rest = (line or "").lstrip().partition(" ")
        if not verb or verb.startswith("#"):
            continue
        if verb in ("is", "holds", "lacks", "same", "shows", "near"):
            assert in_case, f"{place}: '{verb}' before any case"
            file, _, what = rest.partition(" ")
            for one in cases[first:]:
                one.files += [(verb, name, unescaped(what)) for name in named(file)]
        elif verb in ("run", "within", "writes_within", "says", "never", "and"):
            assert in_case or verb == "run", f"{place}: '{verb}' before any case"
            for one in cases[first:] if in_case else [now]:
                if verb == "run":
                    one.words = rest.strip()
                elif verb == "within":
                    one.most_mib = int(rest)
                elif verb == "writes_within":
                    one.file_kib = int(rest)
                elif verb == "says":
                    code, _, said = rest.partition(" ")
                    one.code, _ = int(code), one.says.append(said.strip())
                else:
                    (one.never if verb == "never" else one.says).append(rest.strip())
        else:
            file, _, what = (rest, "", "") if verb == "setup" else rest.partition(" ")
            if what == "<<":
                text = ""
                for _, inner in lines:
                    if inner == ">>":
                        break
                    text += inner + "\n"
                words = [text.encode()]
            elif verb == "replace":
                old, arrow, new = what.partition(" => ")
                if not arrow:
                    old = what.removesuffix(" =>")
                words = [unescaped(old), unescaped(new)]
            else:
                words = [unescaped(what)]
            now.edits += [(place, verb, [name, *words]) for name in named(file)]
    return bases, cases


def numbers(words):
    """1 2 3*7 is 1 2 7 7 7."""
    for word in words:
        times, _, value = word.rpartition("*")
        yield from [float(value) if set(value) & set(".nef") else int(value)] * int(times or 1)


def png(width, height, kind, values):
    """A value for each pixel or its channels, or one for all. As the program's own writer has it: colour by the Paeth filter, everything else unfiltered."""
    bits, color = {"gray8": (8, 0), "gray16": (16, 0), "rgb": (8, 2), "palette": (8, 3)}[kind]
    if kind == "rgb" and len(values) == 3 * width * height:
        pixels = [bytes(values[i:i + 3]) for i in range(0, len(values), 3)]
    else:
        pack = (lambda v: struct.pack(">H", v & 65535)) if bits == 16 else (lambda v: bytes([v & 255] * (3 if color == 2 else 1)))
        pixels = [pack(v) for v in (values * width * height if len(values) == 1 else values)]
    rows = [b"\0" + b"".join(pixels[width * y:width * (y + 1)]) for y in range(height)]
    if kind == "rgb" and len(values) == 1:  # what every neighbour predicts is there
        rows = [b"\4" + (pixels[0] if y == 0 else b"\0" * 3) + b"\0" * 3 * (width - 1) for y in range(height)]
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0))]
    if kind == "palette":
        chunks.append((b"PLTE", bytes([0, 0, 0, 255, 0, 0, 0, 255, 0])))
    chunks += [(b"IDAT", zlib.compress(b"".join(rows), 4)), (b"IEND", b"")]
    return png_file(chunks)


def array(kind, shape, values):
    """A file of NumPy: f4, f8, u1, u2 or i4; 2x3 numbers, or one for all."""
    sizes = [int(size) for size in shape.split("x")]
    values = list(numbers(values))
    values = values * math.prod(sizes) if len(values) == 1 else values
    head = f"{{'descr': '{'|' if kind == 'u1' else '<'}{kind}', 'fortran_order': False, 'shape': ({', '.join(map(str, sizes))},), }}"
    head = head.ljust((len(head) + 11 + 63) // 64 * 64 - 11) + "\n"
    code = {"f4": "f", "f8": "d", "u1": "B", "u2": "H", "i4": "i"}[kind]
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode() + struct.pack(f"<{len(values)}{code}", *values)


def write_model(folder, error_px, *names):
    """COLMAP's binary files of views of the box room, in which two points are off by that error; a view NAME:N shows one of them N times. A
    view whose name is a number is that of the room."""
    images, points = struct.pack("<Q", len(names)), struct.pack("<Q", 2)
    for k, name in enumerate(names):
        name, _, seen = name.partition(":")
        stem, seen = name.split(".")[0], int(seen or 0)
        i = int(stem) if stem.isdigit() else k
        s, c, x, z = math.sin(0.2 * i), math.cos(0.2 * i), 0.1 * i - 0.3, 0.2
        images += struct.pack("<I7dI", i + 1, math.cos(0.1 * i), 0, -math.sin(0.1 * i), 0, s * z - c * x, -0.05 * i, -s * x - c * z, 1)
        images += name.encode() + b"\0" + struct.pack("<Q", seen) + seen * struct.pack("<2dq", 10, 10, 1)
    for k, off in ((2, -0.25), (1, 0.25)):
        points += struct.pack("<Q3d", k, 1, 0.5, off) + b"rgb" + struct.pack("<dQ", float(error_px) + off, 0)
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 1, 4, 40, 30, 20, 20, 20, 15, 0, 0, 0, 0))
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(points)


def sealed(data):
    """Right checksums for a PNG or a packed scene that was changed on purpose."""
    data = bytearray(data)
    if data[1:4] == b"PNG":
        at = 8
        while at + 12 <= len(data):
            length = struct.unpack_from(">I", data, at)[0]
            if length > len(data) - at - 12:
                break
            struct.pack_into(">I", data, at + 8 + length, zlib.crc32(data[at + 4:at + 8 + length]))
            at += length + 12
    elif len(data) >= 64:
        struct.pack_into("<Q", data, 16, len(data))
        offset, length = struct.unpack_from("<QQ", data, 24)
        if offset <= len(data) and length <= len(data) - offset:
            struct.pack_into("<I", data, 40, crc32c(data[offset:offset + length]))
        struct.pack_into("<I", data, 60, crc32c(data[:60]))
    return bytes(data)


def apply(edit, folder):
    place, verb, (name, *words) = edit
    path, what = folder / os.fsdecode(unescaped(name)), words[-1]
    text = what.decode(errors="surrogateescape")
    written = None
    if verb == "setup":
        code, said, *_ = run(name, folder)
        assert code == 0, f"{place}: setup '{name}': {said}"
    elif verb == "write":
        written = what
    elif verb == "model":
        write_model(path, *text.split())
    elif verb == "film":  # small pictures of noise, equal numbers alike
        written = b"".join(bytes((7919 * p + 31 * int(k)) % 251 for p in range(256 * 256)) for k in text.split())
    elif verb == "image":
        width, height, kind, *values = text.split()
        written = png(int(width), int(height), kind, list(numbers(values)))
    elif verb == "array":
        kind, shape, *values = text.split()
        written = array(kind, shape, values)
    elif verb == "folder":
        path.mkdir(parents=True, exist_ok=True)
    elif verb == "copy":
        path, written = folder / text, path.read_bytes()
    elif verb == "pipe":
        os.mkfifo(path, 0o600)
    elif verb == "link":
        path.symlink_to(text)
    elif verb == "remove":
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    elif verb == "sparse":  # a file of so many bytes that takes no space
        path.unlink(missing_ok=True)
        path.write_bytes(b"")
        os.truncate(path, int(text))
    elif verb == "fill":
        count, _, piece = what.partition(b" ")
        written = piece.lstrip() * int(count)
    else:
        assert stat.S_ISREG(path.stat().st_mode), f"{place}: no file {path}"
        data = path.read_bytes()
        if verb in ("append", "prepend"):
            written = data + what if verb == "append" else what + data
        elif verb == "cut":
            assert int(text) < len(data), f"{place}: the file is shorter already"
            written = data[:int(text)]
        elif verb == "poke":
            at, patch = int(text.split()[0]), bytes.fromhex(text.split()[1])
            assert at + len(patch) <= len(data), f"{place}: poke inside the file"
            written = data[:at] + patch + data[at + len(patch):]
        elif verb == "seal":
            written = sealed(data)
        else:
            assert verb == "replace" and words[0] in data, f"{place}: '{verb}' changes nothing"
            written = data.replace(words[0], what, 1)
    if written is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(written)
        if written.startswith(b"#!"):
            path.chmod(0o700)


def run(words, folder, file_kib=0):
    """Exit code, or minus the signal that ended it; what it said; CPU seconds; the most memory in KiB. Programs in bin/ come first."""
    def limits():
        if "measures" not in MISSING:
            resource.setrlimit(resource.RLIMIT_CPU, (10, 10))
            resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        if file_kib:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_kib << 10, file_kib << 10))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(120)
    with open(f"{folder}.said", "w+b") as said:
        child = subprocess.Popen([PROGRAM, *words.split()], cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                                 preexec_fn=limits, env=dict(os.environ, PATH=f"{folder}/bin:/usr/bin:/bin"))
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        return child.returncode, said.read().decode(errors="replace"), used.ru_utime + used.ru_stime, used.ru_maxrss


def shown(path):
    """The values of a PNG, row by row."""
    data = png_bytes(path)
    return list(struct.unpack(f">{len(data) // 2}H", data) if path.read_bytes()[24] == 16 else data)


def content(path):
    """For people."""
    if not path.is_file():
        return "no file"
    return " ".join(map(str, shown(path))) if path.suffix == ".png" else path.read_text(errors="replace")[:2000]


def is_right(root, verb, file, what):
    """Whether a file is as the case says."""
    path = root / file
    if verb == "shows":
        return path.is_file() and shown(path) == list(numbers(what.decode().split()))
    data = path.read_bytes().replace(os.fsencode(root), b"ROOT") if path.is_file() else b""
    if verb == "near":
        have, wanted = ([float(word) for word in text.split()] for text in (data, what))
        return len(have) == len(wanted) and all(abs(a - b) < 1e-9 for a, b in zip(have, wanted))
    return {"is": path.is_file() and data.strip() == what.strip(), "holds": path.is_file() and what in data, "lacks": not os.path.lexists(path),
            "same": path.is_file() and verb == "same" and path.read_bytes() == (root / os.fsdecode(what)).read_bytes()}[verb]


def made_base(name, bases, folder):
    """The folder of a base, made when its first case asks for it."""
    made, base = folder / f"base_{name}", bases[name]
    if not made.exists():
        if base.base:
            shutil.copytree(made_base(base.base, bases, folder), made, symlinks=True)
        else:
            made.mkdir()
            (made / "small.yaml").write_text(SMALL)
        for edit in base.edits:
            apply(edit, made)
    return made


def problems_of(one, bases, folder):
    """What is wrong with the answer to a case, its CPU seconds and memory; None where the build reads no such file."""
    root = folder / one.name
    if not one.follows:
        shutil.copytree(made_base(one.base, bases, folder), root, symlinks=True)
    for edit in one.edits:
        apply(edit, root)
    code, said, cpu_s, peak_kib = run(one.words or bases[one.base].words, root, one.file_kib)
    said = said.replace(str(root), "ROOT").replace(str(PROGRAM.parent.parent / "share/semfield"), "SHARE")
    if "SEMFIELD_SHOW_CASES" in os.environ:
        print(f"@ {one.name} {code}\n{said}", end="")
    if {"images", "raycast"} & set(MISSING) and "this build " in said:
        return None
    lines = [line for line in said.splitlines() if line and not line.endswith("# default")]  # keys of several sections
    found = [f"it ended in {code}, not {one.code}"] if code != one.code else []
    found += [f"not said: {part}" for part in one.says if part not in said]
    found += [f"said: {part}" for part in one.never if part in said]
    found += [f"said twice: {line}" for line in sorted({line for line in lines if lines.count(line) > 1})]
    if peak_kib > one.most_mib << 10 and "measures" not in MISSING:
        found.append(f"it took {peak_kib >> 10} MiB, and may take {one.most_mib}")
    found += [f"{file} {verb} not: {what.decode(errors='replace')}; it is: {content(root / file)}"
              for verb, file, what in one.files if not is_right(root, verb, file, what)]
    return [f"{one.place}: {one.name}: {what}\n{said}" for what in found], cpu_s, peak_kib


def main():
    tables = {path.stem: read_cases(path) for path in sorted(HERE.glob("*.cases"))}
    names = [one.name for _, cases in tables.values() for one in cases if not one.follows]
    assert len(set(names)) == len(names), [name for name in names if names.count(name) > 1]
    assert sum(one.code != 0 for _, cases in tables.values() for one in cases) >= 300
    bases, cases = tables[TABLE]
    assert all(one.says for one in cases)
    with tempfile.TemporaryDirectory() as folder:
        answers = []
        for one in cases:
            unread = one.follows and answers[-1] is None
            answers.append(None if unread else problems_of(one, bases, pathlib.Path(folder)))
    known = [answer for answer in answers if answer is not None]
    problems = [problem for found, *_ in known for problem in found]
    print("\n".join(problems), end="\n" if problems else "")
    print(f"{TABLE}: {len(cases)} cases, slowest {max(cpu_s for _, cpu_s, _ in known):.2f} s of the CPU, "
          f"largest {max(kib for _, _, kib in known) >> 10} MiB")
    if len(known) < len(cases) and not problems:
        print(f"{len(cases) - len(known)} of {len(cases)} need formats that this build does not read; the others hold")
        return 77
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
