#!/usr/bin/env python3
"""Draws a mesh from above, in its colours and, where it has classes, by class: the picture of README.md; with --objects also by object. Needs the
standard library alone.

usage: mesh_picture.py MESH.ply [CLASSES.yaml] OUT.png [--objects] [--up AXIS] [AZIMUTH_DEG ELEVATION_DEG [WIDTH_PX HEIGHT_PX]]
e.g.   mesh_picture.py runs/demo/mesh.ply runs/demo/classes.yaml docs/images/room_mesh.png

MESH.ply is what `semfield mesh RUN` writes. AXIS is the axis of the world that is upright, x, -x, y, -y, z or -z (default: z); scenes of COLMAP
mostly have -y. Faces that look away from the camera are left out, and so is what lies at the near walls and under the ceiling: the view into the
room is open."""
import colorsys
import math
import re
import struct
import sys

from room_png import write_png

SAMPLES = 2  # a pixel's side in samples
CUT = 0.1  # share of the box that is cut off at near walls; twice that under the ceiling
TYPES = {"double": "d", "float": "f", "uchar": "B", "ushort": "H", "int": "i", "uint": "I"}


def read_ply(path):
    """A dict of the vertices' columns, and the faces as (3, corner, corner, corner)."""
    with open(path, "rb") as file:
        data = file.read()
    end = data.find(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode(errors="replace").split("\n")
    if "format binary_little_endian 1.0" not in header or "end_header" not in header:
        sys.exit(f"{path}: not a binary little-endian PLY; `semfield mesh RUN` writes one")
    counts = {line.split()[1]: int(line.split()[2]) for line in header if line.startswith("element ")}
    first = header.index(next(line for line in header if line.startswith("element face")))
    columns = [line.split()[1:] for line in header[:first] if line.startswith("property ")]
    row = struct.Struct("<" + "".join(TYPES[kind] for kind, _ in columns))
    body = row.size * counts["vertex"]
    vertices = dict(zip((name for _, name in columns), zip(*row.iter_unpack(data[end:end + body]))))
    faces = list(struct.iter_unpack("<Biii", data[end + body:end + body + 13 * counts["face"]]))
    return vertices, faces


def upright(vertices, axis):
    """The vertices turned so that `axis` is +z."""
    turns = {"z": ("x", "y", "z"), "-z": ("x", "-y", "-z"), "y": ("x", "-z", "y"), "-y": ("x", "z", "-y"), "x": ("y", "z", "x"), "-x": ("z", "y", "-x")}
    if axis not in turns: sys.exit(f"--up {axis}: expected one of {', '.join(turns)}")
    turned = dict(vertices)
    for prefix in ("", "n"):
        for to, source in zip("xyz", turns[axis]):
            column = vertices[prefix + source[-1]]
            turned[prefix + to] = tuple(-v for v in column) if source[0] == "-" else column
    return turned


def class_colors(path):
    text = open(path, encoding="utf-8").read()
    found = re.findall(r"id: (\d+),.*?color: \[(\d+), (\d+), (\d+)\]", text)
    return {int(i): (int(r), int(g), int(b)) for i, r, g, b in found}


def object_color(number):
    """Grey for none; hues by the golden ratio, so that any run of numbers is told apart."""
    if number < 1: return (205, 205, 205)
    return tuple(255 * v for v in colorsys.hsv_to_rgb(number * 0.618034 % 1, (0.55, 0.85, 0.7)[number % 3], (0.95, 0.7, 0.82)[number // 3 % 3]))


def camera_of(vertices, azimuth, elevation):
    """Eye and axes (right, up, back) of a camera outside the box that looks at a point below its middle."""
    low = [min(vertices[a]) for a in "xyz"]
    high = [max(vertices[a]) for a in "xyz"]
    middle = [(a + b) / 2 for a, b in zip(low, high)]
    middle[2] -= 0.12 * (high[2] - low[2])
    a, e = math.radians(azimuth), math.radians(elevation)
    back = (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))
    right = (-math.sin(a), math.cos(a), 0.0)
    up = (-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e))
    eye = [m + 1.9 * math.dist(low, high) * b for m, b in zip(middle, back)]
    return eye, right, up, back


def in_front(vertices, faces, back):
    """Faces without those in the cut-off parts of the box."""
    keep = [True] * len(vertices["x"])
    for axis, side, share in zip("xyz", back, (CUT, CUT, 2 * CUT)):
        low, high = min(vertices[axis]), max(vertices[axis])
        if side > 0: high -= share * (high - low)
        else: low += share * (high - low)
        keep = [k and low <= v <= high for k, v in zip(keep, vertices[axis])]
    return [face for face in faces if keep[face[1]] and keep[face[2]] and keep[face[3]]]


def project(vertices, camera):
    """Per vertex: x to the right and y down, both divided by depth, and depth."""
    (ex, ey, ez), right, up, back = camera
    points = []
    for x, y, z in zip(vertices["x"], vertices["y"], vertices["z"]):
        x, y, z = x - ex, y - ey, z - ez
        depth = -(x * back[0] + y * back[1] + z * back[2])
        points.append(((x * right[0] + y * right[1] + z * right[2]) / depth,
                       -(x * up[0] + y * up[1] + z * up[2]) / depth, depth))
    return points


def draw(points, faces, width, height):
    """Per sample the vertex that is seen, or -1: the nearest corner of the nearest face that looks at the camera."""
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    seen = set()
    for _, a, b, c in faces:
        (ax, ay, _), (bx, by, _), (cx, cy, _) = points[a], points[b], points[c]
        if (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0: seen.update((a, b, c))
    x0, x1 = min(xs[i] for i in seen), max(xs[i] for i in seen)
    y0, y1 = min(ys[i] for i in seen), max(ys[i] for i in seen)
    scale = 0.98 * min(width / (x1 - x0), height / (y1 - y0))
    ox, oy = width / 2 - scale * (x0 + x1) / 2, height / 2 - scale * (y0 + y1) / 2
    depth, owner = [math.inf] * (width * height), [-1] * (width * height)
    on_image = [(ox + scale * x, oy + scale * y, z) for x, y, z in points]
    for _, a, b, c in faces:
        ax, ay, az = on_image[a]
        bx, by, bz = on_image[b]
        cx, cy, cz = on_image[c]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area >= 0: continue  # looks away
        for row in range(max(0, math.ceil(min(ay, by, cy))), min(height - 1, math.floor(max(ay, by, cy))) + 1):
            for column in range(max(0, math.ceil(min(ax, bx, cx))), min(width - 1, math.floor(max(ax, bx, cx))) + 1):
                wb = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (row - ay) - (by - ay) * (column - ax)) / area
                wa = 1 - wb - wc
                if wa < 0 or wb < 0 or wc < 0: continue
                z = wa * az + wb * bz + wc * cz
                at = row * width + column
                if z < depth[at]:
                    depth[at] = z
                    owner[at] = a if wa >= wb and wa >= wc else (b if wb >= wc else c)
    return owner


def rows_of(owner, colors, width, height):
    """Rows of RGB bytes: means of SAMPLES x SAMPLES samples over white."""
    for top in range(0, height, SAMPLES):
        row = bytearray()
        for left in range(0, width, SAMPLES):
            r = g = b = 0
            for y in range(top, top + SAMPLES):
                for x in range(left, left + SAMPLES):
                    color = colors[owner[y * width + x]]
                    r, g, b = r + color[0], g + color[1], b + color[2]
            # Six bits a channel: the file is half the size, and nothing of it is seen.
            row += bytes(v // (SAMPLES * SAMPLES) & 0xFC | v // (SAMPLES * SAMPLES) >> 6 for v in (r, g, b))
        yield bytes(row)


def main():
    if sys.argv[1:2] in (["-h"], ["--help"]):
        print(__doc__)
        sys.exit(0)
    words, up = [word for word in sys.argv[1:] if word != "--objects"], "z"
    by_object = len(words) < len(sys.argv) - 1
    if "--up" in words:
        at = words.index("--up")
        up = words[at + 1] if at + 1 < len(words) else ""
        del words[at:at + 2]
    inputs = next((i for i, word in enumerate(words) if word.endswith(".png")), 0)
    if inputs not in (1, 2):
        print(__doc__, file=sys.stderr)
        sys.exit(2)
    mesh, classes, out = words[0], words[1] if inputs == 2 else None, words[inputs]
    numbers = [float(v) for v in words[inputs + 1:inputs + 5]]
    azimuth, elevation, width, height = numbers + [312.0, 38.0, 560.0, 440.0][len(numbers):]
    width, height = int(width) * SAMPLES, int(height) * SAMPLES
    vertices, faces = read_ply(mesh)
    vertices = upright(vertices, up)
    camera = camera_of(vertices, azimuth, elevation)
    owner = draw(project(vertices, camera), in_front(vertices, faces, camera[3]), width, height)
    colorings = [list(zip(*(vertices[k] for k in ("red", "green", "blue"))))]
    light = [0.15 * r + 0.6 * u + 0.6 * b for r, u, b in zip(*camera[1:])]
    norm = math.hypot(*light)

    def lit(column, color_of):
        colors = []
        for nx, ny, nz, number in zip(*(vertices[k] for k in ("nx", "ny", "nz", column))):
            shade = 0.7 + 0.35 * max(0.0, (nx * light[0] + ny * light[1] + nz * light[2]) / norm)
            colors.append([min(255, shade * v) for v in color_of(number)])
        return colors

    if classes is not None and "label" in vertices:
        table = class_colors(classes)
        colorings.append(lit("label", lambda label: table.get(label, (0, 0, 0))))
    if by_object:
        if "instance" not in vertices: sys.exit(f"{mesh}: it has no objects; find them with `semfield objects RUN` and write the mesh again")
        colorings.append(lit("instance", object_color))
    white = [(255, 255, 255)]
    panels = [rows_of(owner, [tuple(int(v) for v in c) for c in colors] + white, width, height) for colors in colorings]
    write_png(out, len(panels) * width // SAMPLES, height // SAMPLES, [b"".join(row) for row in zip(*panels)])


main()
