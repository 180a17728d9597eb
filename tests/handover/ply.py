"""Reads PLY files, ASCII or little-endian."""
import struct
from pathlib import Path

KINDS = {"double": "d", "float64": "d", "float": "f", "float32": "f", "uchar": "B", "uint8": "B", "int": "i", "int32": "i", "uint": "I", "uint32": "I",
         "char": "b", "short": "h", "ushort": "H"}


def read(path):
    """{element: {property: values}}; a value of a list property is a list. ValueError for what is no such file."""
    head, mark, body = Path(path).read_bytes().partition(b"end_header\n")
    elements, ascii_numbers, at = {}, iter(body.split()) if b"\nformat ascii" in head else None, 0
    for words in map(str.split, head.decode("latin-1").splitlines()):
        if words[0] == "element":
            elements[words[1]] = (int(words[2]), [])
        elif words[0] == "property":
            elements[list(elements)[-1]][1].append(words[1:])

    def number(kind):
        nonlocal at
        if ascii_numbers:
            return float(next(ascii_numbers))
        at += struct.calcsize(KINDS[kind])
        return struct.unpack_from("<" + KINDS[kind], body, at - struct.calcsize(KINDS[kind]))[0]

    out = {}
    for name, (count, properties) in elements.items():
        columns = out[name] = {words[-1]: [] for words in properties}
        for _ in range(count):
            for words in properties:
                is_list = words[0] == "list"
                columns[words[-1]].append([number(words[2]) for _ in range(int(number(words[1])))] if is_list else number(words[0]))
    if not mark or not head.startswith(b"ply\nformat ") or not ascii_numbers and at != len(body):
        raise ValueError(f"{path}: header, or {len(body) - at} bytes after the last element")
    return out
