"""What several studies need: intervals of means, the machine in words, and parts of a page that a study renews."""
import datetime
import json
import math
import pathlib
import statistics
import struct
import sys
import zlib

import numpy as np

# 97.5th percentiles of Student's distribution for 1, 2, ... degrees of freedom; more than 20 have that of 20.
T_975 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13, 2.12, 2.11, 2.10,
         2.09, 2.09)


def half_width(values):
    """Half of the 95 % interval of the mean; infinite for one value."""
    n = len(values)
    return T_975[min(n - 1, 20) - 1] * statistics.stdev(values) / math.sqrt(n) if n > 1 else math.inf


def settings(pairs):
    """["train.rays=96", ...] of --set as a dict for semfield.open."""
    def value(text):
        try:
            return json.loads(text)
        except ValueError:
            return text
    return {key: value(text) for key, text in (pair.split("=", 1) for pair in pairs)}


def today():
    return datetime.datetime.now(datetime.timezone.utc).date().isoformat()


def machine():
    """What semfield knows of this build and machine: cpu, compiler, version, hardware_threads, ..."""
    from semfield import _core
    return json.loads(_core.environment())


def table(head, rows):
    """Markdown; bars within cells are escaped."""
    lines = [list(head), *([str(c).replace("|", "\\|") for c in row] for row in rows)]
    text = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([text[0], "|" + "---|" * len(head), *text[1:]]) + "\n"


def png_values(png):
    """[H, W] of a grey or palette PNG of 8 or 16 bits a pixel, not interlaced."""
    width, height, bits = struct.unpack_from(">IIB", png, 16)
    data, at = b"", 8
    while at < len(png):
        size, kind = struct.unpack_from(">I4s", png, at)
        data += png[at + 8:at + 8 + size] if kind == b"IDAT" else b""
        at += size + 12
    rows = np.frombuffer(zlib.decompress(data), np.uint8).reshape(height, bits // 8 * width + 1)
    pixels, step = rows[:, 1:].copy(), bits // 8
    for y in np.flatnonzero(rows[:, 0]):
        kind, row, above = rows[y, 0], pixels[y], pixels[y - 1] if y else np.zeros_like(pixels[y])
        if kind == 1:
            row[:] = np.cumsum(row.reshape(-1, step), axis=0, dtype=np.uint8).reshape(-1)
        elif kind == 2:
            row += above
        else:
            of_row, up = row.tolist(), above.tolist()
            for i in range(len(of_row)):
                a, b, c = (of_row[i - step], up[i], up[i - step]) if i >= step else (0, up[i], 0)
                near = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
                of_row[i] = (of_row[i] + ((a + b) // 2 if kind == 3 else near)) % 256
            row[:] = of_row
    return np.ascontiguousarray(pixels).view(f">u{step}").astype(np.int64)


def read(path):
    return pathlib.Path(path).read_text(encoding="utf-8")


def write(path, text):
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    pathlib.Path(path).write_text(text, encoding="utf-8")
