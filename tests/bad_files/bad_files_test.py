"""The table of bad files: bad_files_test.py [--measured] [--whole] --program FILE --share FOLDER NAME.cases, or all of them to compare.

Scenes as they should be, and cases that spoil one thing in one of them, as text (README.md), through the real program: its exit code, what
it says and writes, and what refusing costs. --measured: memory and time count, which a sanitizer takes of its own; --whole: the build
reads every format, so that no case may be passed over."""
import argparse
import math
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import zlib


class Case:
    def __init__(self, name, place, base, follows=False):
        self.name, self.place, self.base, self.follows, self.edits = name, place, base, follows, []
        self.words, self.code, self.most_mib, self.file_kib, self.says, self.never, self.files = b"", -1, 256, 0, [], [], []


def unescaped(text):
    """With the characters of \\n, \\t, \\r, \\0, \\xHH and of a backslash before any other."""
    known = {b"n": b"\n", b"t": b"\t", b"r": b"\r", b"0": b"\0"}
    return re.sub(rb"\\(?:x([0-9a-f]{2})|(.))",
                  lambda m: bytes.fromhex(m[1].decode()) if m[1] else known.get(m[2], m[2]), text, flags=re.S)


def read_edit(verb, rest, lines):
    """(verb, file, what, what stands in its place)."""
    if verb == b"setup":
        return verb, b"", rest, b""
    file, _, what = rest.partition(b" ")
    if what == b"<<":
        return verb, file, b"".join(line + b"\n" for line in iter(lambda: next(lines)[1], b">>")), b""
    if verb != b"replace":
        return verb, file, unescaped(what), b""
    old, arrow, new = (what + b" ").partition(b" => ")
    if not arrow:
        raise ValueError("replace FILE OLD => NEW")
    return verb, file, unescaped(old), unescaped(new[:-1])


def read_cases(path):
    """Bases by name, each its edits and the words of its cases that have none; and the cases."""
    bases, cases, edits, of_case, first = {}, [], None, None, 0
    with open(path, "rb") as file:
        lines = iter(enumerate(file.read().split(b"\n"), 1))
    for number, line in lines:
        place = f"{os.path.basename(path)}:{number}"
        verb, _, rest = line.partition(b" ")
        if not line.strip() or line.startswith(b"#"):
            continue
        if verb == b"base":
            base, of_case = bases.setdefault(rest.strip(), [[], b""]), None
            edits = base[0]
        elif verb in (b"case", b"or", b"then"):
            name, _, of_base = rest.partition(b" ")
            if verb != b"or":
                first = len(cases)
            of_case = (Case(of_case.name, place, of_case.base, True) if verb == b"then" else
                       Case(name.decode(), place, of_base.strip() if verb == b"case" else of_case.base))
            cases.append(of_case)
            edits = of_case.edits
        elif edits is None:
            raise ValueError(f"{place}: '{verb.decode()}' before any base or case")
        elif verb == b"run" and of_case is None:
            base[1] = rest
        elif verb in (b"is", b"holds", b"lacks", b"same"):
            file, _, what = rest.partition(b" ")
            of_case.files.append((verb, os.fsdecode(file), unescaped(what)))
        elif verb in (b"run", b"within", b"writes_within", b"says", b"and", b"never"):
            if of_case is None:
                raise ValueError(f"{place}: '{verb.decode()}' before any case")
            code, _, said = rest.strip().partition(b" ") if verb == b"says" else (b"", b"", rest.strip())
            for one in cases[first:]:
                if verb == b"run":
                    one.words = said
                elif verb == b"within":
                    one.most_mib = int(said)
                elif verb == b"writes_within":
                    one.file_kib = int(said)
                elif verb == b"never":
                    one.never.append(said)
                else:
                    one.code = int(code or one.code)
                    one.says.append(said.strip())
        else:
            edits.append((place, *read_edit(verb, rest, lines)))
    return bases, cases


def png_of(words):
    """WIDTH HEIGHT KIND VALUE: every pixel the same."""
    width, height, kind, value = words.split()
    width, height, value = int(width), int(height), int(value)
    bits, color, pixel = {b"gray8": (8, 0, bytes([value % 256])), b"gray16": (16, 0, struct.pack(">H", value % 65536)),
                          b"rgb": (8, 2, bytes([value % 256] * 3)), b"palette": (8, 3, bytes([value % 256]))}[kind]
    # Of colours each pixel stands as its difference from what is foreseen.
    rows = [b"\0" + pixel * width] * height
    if kind == b"rgb":
        rows = [b"\4" + pixel + bytes(3 * width - 3)] + [b"\4" + bytes(3 * width)] * (height - 1)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0))]
    if kind == b"palette":
        chunks.append((b"PLTE", bytes([0, 0, 0, 255, 0, 0, 0, 255, 0])))
    chunks += [(b"IDAT", zlib.compress(b"".join(rows), 4)), (b"IEND", b"")]
    return sealed(b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(data)) + kind + data + bytes(4) for kind, data in chunks))


def write_model(folder, words):
    """ERROR_PX NAME[:POINTS]...: COLMAP's binary files of the box room's views, in which two points are off by that error, one of which a view
    shows so many times. A view whose name is a number is that of the room."""
    error_px, *names = words.split()
    images = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        name, _, points = name.partition(b":")
        stem = name.split(b".")[0]
        i = int(stem) if stem.isdigit() else k
        s, c, x, z = math.sin(0.2 * i), math.cos(0.2 * i), 0.1 * i - 0.3, 0.2
        images += struct.pack("<I7dI", i + 1, math.cos(0.1 * i), 0, -math.sin(0.1 * i), 0, s * z - c * x, -0.05 * i, -s * x - c * z, 1)
        images += name + b"\0" + struct.pack("<Q", int(points or 0)) + int(points or 0) * struct.pack("<2dq", 10, 10, 1)
    points = struct.pack("<Q", 2)
    for k, off in ((2, -0.25), (1, 0.25)):
        points += struct.pack("<Q3d", k, 1, 0.5, off) + b"rgb" + struct.pack("<dQ", float(error_px) + off, 0)
    os.makedirs(folder)
    for name, data in (("cameras", struct.pack("<QIiQQ8d", 1, 1, 4, 40, 30, 20, 20, 20, 15, 0, 0, 0, 0)), ("images", images),
                       ("points3D", points)):
        with open(os.path.join(folder, name + ".bin"), "wb") as file:
            file.write(data)


def crc32c(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return struct.pack("<I", crc ^ 0xFFFFFFFF)


def sealed(data):
    """Right checksums for a PNG or a packed scene that was changed on purpose."""
    out = bytearray(data)
    if data[1:4] == b"PNG":
        at = 8
        while at + 12 <= len(out):
            end = at + 8 + int.from_bytes(out[at:at + 4], "big")
            if end + 4 > len(out):
                break
            out[end:end + 4] = struct.pack(">I", zlib.crc32(out[at + 4:end]))
            at = end + 4
    elif len(out) >= 64:
        out[16:24] = struct.pack("<Q", len(out))
        offset, length = struct.unpack("<QQ", out[24:40])
        if offset + length <= len(out):
            out[40:44] = crc32c(out[offset:offset + length])
        out[60:64] = crc32c(out[:60])
    return bytes(out)


def apply(edit, folder, program):
    place, verb, file, what, new = edit
    path = os.path.join(folder, os.fsdecode(unescaped(file)))
    if verb == b"setup":
        code, said, *_ = run(program, what, folder, False)
        if code != 0:
            raise ValueError(f"{place}: setup '{what.decode()}': {said.decode(errors='replace')}")
    elif verb == b"model":
        write_model(path, what)
    elif verb == b"film":
        with open(path, "wb") as file:
            file.writelines(bytes((7919 * p + 31 * int(k)) % 251 for p in range(256 * 256)) for k in what.split())
    elif verb == b"folder":
        os.makedirs(path, exist_ok=True)
    elif verb == b"pipe":
        os.mkfifo(path, 0o600)
    elif verb == b"link":
        os.symlink(what, path)
    elif verb == b"remove":
        shutil.rmtree(path) if os.path.isdir(path) and not os.path.islink(path) else os.remove(path)
    else:
        data = b""
        if verb not in (b"write", b"image", b"fill", b"sparse"):
            with open(path, "rb") as found:
                data = found.read()
        if verb == b"replace" and what not in data:
            raise ValueError(f"{place}: nothing to replace")
        if verb == b"cut" and int(what) >= len(data):
            raise ValueError(f"{place}: the file is shorter already")
        if verb == b"poke":
            offset, changed = int(what.split()[0]), bytes.fromhex(what.split()[1].decode())
            if offset + len(changed) > len(data):
                raise ValueError(f"{place}: poke FILE OFFSET HEX, inside the file")
            data = data[:offset] + changed + data[offset + len(changed):]
        if verb == b"fill":
            count, _, piece = what.partition(b" ")
            data = int(count) * piece
        changes = {b"write": lambda: what, b"append": lambda: data + what, b"prepend": lambda: what + data,
                   b"cut": lambda: data[:int(what)], b"seal": lambda: sealed(data), b"image": lambda: png_of(what),
                   b"replace": lambda: data.replace(what, new, 1)}
        data = changes[verb]() if verb in changes else data if verb in (b"poke", b"fill", b"copy", b"sparse") else None
        if verb == b"copy":
            path = os.path.join(folder, os.fsdecode(what))
        if data is None:
            raise ValueError(f"{place}: unknown change '{verb.decode()}'")
        os.makedirs(os.path.dirname(path), exist_ok=True)
        if os.path.lexists(path):
            os.remove(path)
        with open(path, "wb") as out:
            out.write(data)
            if verb == b"sparse":  # a file of so many bytes that takes no space
                out.truncate(int(what))
        if data.startswith(b"#!"):
            os.chmod(path, 0o700)


def run(program, words, folder, measured, file_kib=0):
    """Exit code, minus the signal that ended it; what it said; seconds of CPU; KiB at its peak. Programs in bin/ come first."""
    def limits():
        for what, most in ((resource.RLIMIT_CPU, 10), (resource.RLIMIT_AS, 8 << 30)) if measured else ():
            resource.setrlimit(what, (most, most))
        if file_kib:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_kib << 10, file_kib << 10))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(120)
    with open(folder + ".said", "w+b") as log:
        child = subprocess.Popen([os.fsencode(program)] + words.split(), cwd=folder, stdin=subprocess.DEVNULL, stdout=log,
                                 stderr=subprocess.STDOUT, preexec_fn=limits,
                                 env=dict(os.environ, PATH=os.path.join(folder, "bin") + ":/usr/bin:/bin"))
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        log.seek(0)
        return child.returncode, log.read(), used.ru_utime + used.ru_stime, used.ru_maxrss


def faults_of(case, outcome, options, root):
    code, said, _, peak_kib = outcome
    if code != case.code:
        yield f"ends with {code}, not {case.code}"
    if not case.says:
        yield "says nothing"
    yield from (f"not said: {part.decode(errors='replace')}" for part in case.says if part not in said)
    yield from (f"said: {part.decode(errors='replace')}" for part in case.never if part in said)
    lines = [line for line in said.split(b"\n") if line]
    yield from (f"said twice: {line.decode(errors='replace')}" for line in sorted(set(lines)) if lines.count(line) > 1)
    if options.measured and peak_kib > case.most_mib << 10:
        yield f"takes {peak_kib >> 10} MiB, at most {case.most_mib} are allowed"
    for verb, file, what in case.files:
        path, data = os.path.join(root, file), b""
        if os.path.isfile(path):
            with open(path, "rb") as found:
                data = found.read().replace(os.fsencode(root), b"ROOT")
        if verb == b"same":
            with open(os.path.join(root, os.fsdecode(what)), "rb") as other:
                right = data == other.read()
        else:
            right = {b"is": data.strip() == what.strip(), b"holds": what in data and os.path.exists(path),
                     b"lacks": what not in data if what else not os.path.lexists(path)}[verb]
        if not right:
            yield f"{file}: {verb.decode()} not {what.decode(errors='replace')}, but\n{data[:3000].decode(errors='replace')}"


def play(path, options, folder):
    """Number of faults, and of cases that need what this build lacks."""
    bases, cases = read_cases(path)
    faults = absent = 0
    outcomes, root = [], ""
    for case in cases:
        if case.base not in bases:
            raise ValueError(f"{case.place}: no base '{case.base.decode()}'")
        if not case.follows:
            shutil.rmtree(root, ignore_errors=True)
            made, root = (os.path.join(folder, name) for name in ("base_" + case.base.decode(), case.name))
            if not os.path.exists(made):
                os.makedirs(made)
                for edit in bases[case.base][0]:
                    apply(edit, made, options.program)
            shutil.copytree(made, root, symlinks=True)
        for edit in case.edits:
            apply(edit, root, options.program)
        code, said, *cost = run(options.program, case.words or bases[case.base][1], root, options.measured, case.file_kib)
        said = said.replace(os.fsencode(root), b"ROOT").replace(os.fsencode(options.share), b"SHARE")
        if os.environ.get("SEMFIELD_SHOW_CASES"):
            print(f"@ {case.name} {code}\n{said.decode(errors='replace')}", end="")
        if not options.whole and b"this build " in said:
            absent += 1
            continue
        outcomes.append((code, said, *cost))
        for fault in faults_of(case, outcomes[-1], options, root):
            faults += 1
            print(f"{case.place}: {case.name}: {fault}\n{said.decode(errors='replace')}")
    print(f"{os.path.basename(path)}: {len(cases)} cases, slowest {max(o[2] for o in outcomes):.2f} s of the CPU, largest "
          f"{max(o[3] for o in outcomes) >> 10} MiB, {absent} need formats that this build does not read, {faults} faults")
    return faults, absent


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program")
    parser.add_argument("--share")
    parser.add_argument("--measured", action="store_true")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("cases", nargs="+")
    options = parser.parse_args()
    if len(options.cases) > 1:
        all_cases = [case for path in options.cases for case in read_cases(path)[1]]
        names = [case.name for case in all_cases if not case.follows]
        twice = sorted({name for name in names if names.count(name) > 1})
        bad = sum(case.code != 0 for case in all_cases)
        print(f"{len(names)} cases, {bad} of which are refused; twice: {twice}")
        return int(bool(twice) or bad < 300)
    with tempfile.TemporaryDirectory(prefix="semfield_bad_files_") as folder:
        faults, absent = play(options.cases[0], options, os.path.realpath(folder))
    return 1 if faults else 77 if absent else 0


if __name__ == "__main__":
    sys.exit(main())
