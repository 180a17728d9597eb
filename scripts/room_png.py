"""PNG files of scripts/make_room.py, by the standard library alone: the same bytes on every machine."""
import struct
import zlib


def write_png(path, width, height, rows):
    """8-bit RGB; each row takes the simpler of the filters 'sub' and 'up'."""
    raw, above = bytearray(), bytes(3 * width)
    for row in rows:
        sub = bytes((row[i] - (row[i - 3] if i >= 3 else 0)) & 255 for i in range(3 * width))
        up = bytes((a - b) & 255 for a, b in zip(row, above))
        cost = lambda f: sum(min(v, 256 - v) for v in f)
        raw += b"\x01" + sub if cost(sub) < cost(up) else b"\x02" + up
        above = row
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)) +
                   chunk(b"IDAT", zlib.compress(bytes(raw), 9)) + chunk(b"IEND", b""))
