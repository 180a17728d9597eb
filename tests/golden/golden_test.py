#!/usr/bin/env python3
"""The program gives the bits that it gave: checksums of what golden_rows makes, on an instruction set or a GPU.

SEMFIELD_GOLDEN: an instruction set, `cuda`, or `file`, which looks at golden.txt alone. SEMFIELD_GOLDEN_ROWS makes the
values, SEMFIELD_COMPILER and SEMFIELD_NVCC built it."""

import fcntl
import os
import pathlib
import re
import subprocess
import sys
import tempfile

FILE = pathlib.Path(__file__).with_name("golden.txt")
HEAD = """\
# CRC-32C of what tests/golden/golden_rows.cpp makes. A column is an instruction set of the CPU, or a GPU. A
# section holds for one compiler and one C library: compilers contract different products and sums to fused
# multiply-adds, C libraries round exp and log differently; for a GPU also for one compiler of its kernels.
# avx512_bf16 also names the maker of the CPU, since nothing promises that both round VDPBF16PS alike; amx stands
# for both, the tile instructions and their emulation. Files (-) are made by the first three instruction sets.
# A change that is meant to change numbers names its rows in docs/decisions.md (0045), writes the columns
# of its machine anew, and removes by hand those that it cannot write. On a CPU with every set, or a GPU:
# SEMFIELD_WRITE_GOLDEN=1 ctest --test-dir build/release -R '^golden[.]'
"""
WITH_FILES = ("generic", "avx2", "avx512")
SAME_BITS = "/tiny_hash_grid_occupancy"  # of a run that was never stopped and of the resumed one
SKIPPED = 77


def read_golden(text):
    """Section -> row -> column -> checksum; "-": that column does not make it."""
    sections, section, columns = {}, None, []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or line[0] == "#":
            continue
        if line[0] == "[" and line[-1] == "]":
            section, columns = sections.setdefault(line[1:-1], {}), []
        elif section is None or len(words) < 2 or columns and len(words) != len(columns):
            sys.exit(f"{FILE}:{number}: no row of golden values; write the section anew, as the head of the file says")
        elif not columns:
            columns = words
        else:
            row = section.setdefault(words[0], {})
            row.update((column, word) for column, word in zip(columns[1:], words[1:]) if word != "-")
    return sections


def written(sections):
    text = HEAD
    for name, section in sorted(sections.items()):
        columns = sorted({column for values in section.values() for column in values})
        text += f"\n[{name}]\n"
        for row, words in [("row", columns)] + [(row, [values.get(column, "-") for column in columns])
                                                for row, values in sorted(section.items())]:
            cells = [word.ljust(max(8, len(column))) for word, column in zip(words, columns)]
            text += "  ".join([row.ljust(40), *cells]).rstrip() + "\n"
    return text


def made(parts, **environment):
    """What golden_rows says of these parts; it ends in 69 without a GPU and in 78 without the instruction set."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([os.environ["SEMFIELD_GOLDEN_ROWS"], *parts], cwd=folder, capture_output=True, text=True,
                              env={**os.environ, "SEMFIELD_CACHE": "off", **environment})
    if done.returncode == 69 and "cuda" in parts or done.returncode == 78 and "SEMFIELD_ISA" in done.stderr:
        print(done.stderr)
        sys.exit(SKIPPED)
    if done.returncode != 0:
        sys.exit(f"golden_rows ended in {done.returncode}: {done.stderr}")
    return dict(line.split() for line in done.stdout.splitlines())


def check(name, column, found):
    """Compares with the column, or writes it when SEMFIELD_WRITE_GOLDEN says so. Exit code."""
    if "SEMFIELD_WRITE_GOLDEN" in os.environ:
        unmade = [row for row, value in found.items() if value == "-"]
        if unmade:
            sys.exit(f"a build without the labelling page cannot write {unmade}")
        with FILE.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # its neighbours write other columns
            sections = read_golden(file.read())
            section = sections.setdefault(name, {})
            for values in section.values():
                values.pop(column, None)
            for row, value in found.items():
                section.setdefault(row, {})[column] = value
            sections[name] = {row: values for row, values in section.items() if values}
            file.seek(0)
            file.truncate()
            file.write(written(sections))
        print(f"[{name}] {column}: {len(found)} rows are written")
        return 0
    section = read_golden(FILE.read_text()).get(name, {})
    expected = {row: values[column] for row, values in section.items() if column in values}
    if not expected:
        print(f"golden.txt has no values of [{name}] {column}; write them at a commit that is known to be good")
        return SKIPPED
    faults = [f"row {row} is no longer made" for row in expected if row not in found]
    faults += [f"row {row} has other bits on {column}: {value}, not {expected.get(row, 'in golden.txt')}"
               for row, value in found.items() if value not in ("-", expected.get(row))]
    unmade = [row for row, value in found.items() if value == "-"]
    print("\n".join(faults or [f"{len(found)} rows of [{name}] {column}"]
                    + [f"this build does not make {row}" for row in unmade]))
    return 1 if faults else SKIPPED if unmade else 0


def check_file():
    """No two rows agree, for each makes something else, but a resumed run and one that was never stopped. Instruction
    sets agree in fp32, but for the generic one, which has no fused multiply-adds."""
    text = FILE.read_text()
    sections, faults = read_golden(text), []
    for name, section in sections.items():
        row_of = {}
        for row, values in section.items():
            for column, value in values.items():
                other = row_of.setdefault((column, value), row)
                if other != row and not row.endswith(SAME_BITS):
                    faults.append(f"{name}: {other} and {row} agree")
            if not row.endswith("bf16") and len({value for column, value in values.items() if column != "generic"}) > 1:
                faults.append(f"{name}: {row} differs among instruction sets")
            if row.endswith("/resumed_at_step_10") and values != section[row.partition("/")[0] + SAME_BITS]:
                faults.append(f"{name}: {row} is not the run that was never stopped")
    if written(sections) != text:
        faults.append("golden.txt is not as it would be written")
    print("\n".join(faults or [f"{len(sections)} sections"]))
    return 1 if faults or not sections else 0


def main():
    wanted = os.environ["SEMFIELD_GOLDEN"]
    toolchain = f"{os.environ['SEMFIELD_COMPILER']}, {os.confstr('CS_GNU_LIBC_VERSION')}"
    if wanted == "file":  # others are writing it
        return SKIPPED if "SEMFIELD_WRITE_GOLDEN" in os.environ else check_file()
    if wanted == "cuda":
        rows = made(["cuda"])
        return check(f"{toolchain}, {os.environ['SEMFIELD_NVCC']}", rows.pop("device"), rows)
    cpu = pathlib.Path("/proc/cpuinfo").read_text()
    if "flags" in cpu and not {"avx2", "fma"} <= set(re.search(r"^flags.*", cpu, re.M)[0].split()):
        print("this CPU has no fused multiply-add, by which the C library picks its exp and log; the values had one")
        return SKIPPED
    maker = "amd" if "AuthenticAMD" in cpu else "intel" if "GenuineIntel" in cpu else "other"
    column = "amx" if wanted.startswith("amx") else f"{wanted}/{maker}" if wanted == "avx512_bf16" else wanted
    parts = ["steps", "files"] if wanted in WITH_FILES else ["steps"]
    return check(toolchain, column, made(parts, SEMFIELD_ISA=wanted))


if __name__ == "__main__":
    sys.exit(main())
