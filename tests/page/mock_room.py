"""A small room of boxes and a ball, cast ray by ray: photographs, true objects and PNG files for the mock server."""

import functools
import math
import struct
import threading
import zlib

OBJECTS = ["floor", "ceiling", "wall", "wall", "sofa", "table", "cupboard", "lamp"]  # by number; two walls look different
LOW, HIGH = (-3.0, -2.5, 0.0), (3.0, 2.5, 2.6)
BOXES = [  # object, low corner, high corner, colour
    (4, (-2.9, -1.2, 0.0), (-1.9, 1.2, 0.45), (118, 130, 160)),
    (4, (-2.9, -1.2, 0.45), (-2.55, 1.2, 0.95), (108, 120, 152)),
    (5, (-0.6, -0.5, 0.38), (0.6, 0.5, 0.46), (150, 106, 70)),
    (5, (-0.08, -0.08, 0.0), (0.08, 0.08, 0.38), (120, 84, 56)),
    (6, (1.2, 1.9, 0.0), (2.7, 2.45, 1.9), (176, 168, 150)),
]
BALL = (7, (1.9, -1.6, 1.35), 0.28, (240, 226, 180))
SIDES = [(158, 132, 102), (228, 228, 224), (198, 190, 178), (170, 184, 178)]


def png(width, height, rows, color_type, palette=None):
    """A PNG of 8 bits a value. color_type: 0 grey, 2 RGB, 3 palette, whose entry 0 is transparent."""
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    out = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, color_type, 0, 0, 0))
    if palette:
        out += chunk(b"PLTE", bytes(v for rgb in palette for v in rgb)) + chunk(b"tRNS", b"\0")
    return out + chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows), 1)) + chunk(b"IEND", b"")


def look(position, target):
    """A camera with OpenCV axes: position and the row-major rotation world_from_camera."""
    def unit(v):
        length = math.sqrt(sum(x * x for x in v))
        return [x / length for x in v]

    z = unit([t - p for p, t in zip(position, target)])
    x = unit([z[1], -z[0], 0.0])
    y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]]
    return list(position), [v for row in zip(x, y, z) for v in row]


def cast(origin, direction):
    """Object, colour and shade of what a ray from inside the room meets first."""
    best, found = math.inf, None
    for axis in range(3):  # the room's sides, from inside
        if abs(direction[axis]) < 1e-9:
            continue
        t = ((HIGH if direction[axis] > 0 else LOW)[axis] - origin[axis]) / direction[axis]
        if t < best:
            which = (0 if direction[2] < 0 else 1) if axis == 2 else 2 if axis == 0 else 3
            best, found = t, (which, SIDES[which], 0.78 + 0.22 * (axis == 2) - 0.1 * (axis == 1))
    for which, low, high, color in BOXES:
        near, far, side = 1e-6, best, -1
        for axis in range(3):
            d = direction[axis] if abs(direction[axis]) > 1e-9 else 1e-9
            a, b = sorted(((low[axis] - origin[axis]) / d, (high[axis] - origin[axis]) / d))
            if a > near:
                near, side = a, axis
            far = min(far, b)
        if side >= 0 and near < far:
            best, found = near, (which, color, (0.82, 0.68, 1.0)[side])
    which, centre, radius, color = BALL
    to = [c - o for c, o in zip(centre, origin)]
    along = sum(a * b for a, b in zip(to, direction))
    apart = sum(v * v for v in to) - along * along
    if apart < radius * radius and 0 < along - math.sqrt(radius * radius - apart) < best:
        best = along - math.sqrt(radius * radius - apart)
        found = (which, color, 0.6 + 0.4 * math.sqrt(1 - apart / (radius * radius)))
    return best, found


def ray(camera, width, height, x, y):
    """Origin and unit direction of the ray through a point of the image."""
    rotation, focal = camera["rotation"], width / 2 / math.tan(math.radians(camera["fov_deg"]) / 2)
    u, v = (x - width / 2) / focal, (y - height / 2) / focal
    length = math.sqrt(u * u + v * v + 1)
    return list(camera["position"]), [(rotation[3 * k] * u + rotation[3 * k + 1] * v + rotation[3 * k + 2]) / length for k in range(3)]


def pixel_of(camera, width, height, place):
    """Where the camera has a place in its image, or None."""
    rotation, focal = camera["rotation"], width / 2 / math.tan(math.radians(camera["fov_deg"]) / 2)
    away = [p - o for p, o in zip(place, camera["position"])]
    x, y, z = (sum(rotation[3 * k + c] * away[k] for k in range(3)) for c in range(3))
    at = [focal * x / z + width / 2, focal * y / z + height / 2] if z > 1e-6 else [-1, -1]
    return at if 0 <= at[0] < width and 0 <= at[1] < height else None


def is_seen(camera, place):
    """Nothing lies between the camera and the place."""
    away = [p - o for p, o in zip(place, camera["position"])]
    length = math.sqrt(sum(v * v for v in away))
    return abs(cast(list(camera["position"]), [v / length for v in away])[0] - length) < 0.03 * length


def photo(k, count, width, height, scale, is_turned=False):
    """The photograph of view k as PNG, `scale` times as large: then with lines that are one of its pixels wide, 8 of a small one's apart."""
    rows = rendered(k, count, width, height)[0][::-1 if is_turned else 1]
    if scale == 1:
        return png(width, height, rows, 2)
    large = []
    for row in rows:
        wide = bytearray(b"".join(row[3 * i:3 * i + 3] * scale for i in range(width)))
        for x in range(0, width * scale, 8 * scale):
            wide[3 * x:3 * x + 3] = b"\xff\xff\xff"
        large += [bytes(wide)] * scale
    return png(width * scale, height * scale, large, 2)


def render(camera, width, height):
    """(rgb rows, objects [height][width]) of a camera {"position", "rotation", "fov_deg"}."""
    rotation, origin = camera["rotation"], camera["position"]
    focal = width / 2 / math.tan(math.radians(camera["fov_deg"]) / 2)
    rows, objects = [], []
    for j in range(height):
        v = (j + 0.5 - height / 2) / focal
        row, line = bytearray(), bytearray()
        for i in range(width):
            u = (i + 0.5 - width / 2) / focal
            length = math.sqrt(u * u + v * v + 1)
            d = [(rotation[3 * k] * u + rotation[3 * k + 1] * v + rotation[3 * k + 2]) / length for k in range(3)]
            t, (which, color, shade) = cast(origin, d)
            if which == 0 and (math.floor(2 * (origin[0] + t * d[0])) + math.floor(2 * (origin[1] + t * d[1]))) % 2:
                shade *= 0.9
            if which == 3 and math.floor(6 * (origin[0] + t * d[0])) % 2:
                shade *= 0.94
            shade *= 1.12 - 0.07 * t + ((i * 7 + j * 13 + i * j) % 5) * 0.006
            row += bytes(min(255, int(c * shade)) for c in color)
            line.append(which)
        rows.append(bytes(row))
        objects.append(bytes(line))
    return rows, objects


LOCK = threading.Lock()


def rendered(k, count, width, height):
    """View k of `count`; cast once."""
    with LOCK:
        return cast_view(k, count, width, height)


@functools.lru_cache(maxsize=None)
def cast_view(k, count, width, height):
    return render(cameras(count)[k], width, height)


def cameras(count):
    """`count` places on a ring in the room that look across it."""
    out = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        place = (1.7 * math.cos(angle), 1.3 * math.sin(angle), 1.55)
        position, rotation = look(place, (-1.4 * math.cos(angle), -1.2 * math.sin(angle), 0.75))
        out.append({"position": position, "rotation": rotation, "fov_deg": 78.0})
    return out
