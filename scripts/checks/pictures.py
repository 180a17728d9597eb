"""Pictures of the documents: meshes from above, and the film of clicks. Python's own library and ffmpeg."""
import colorsys
import json
import math
import pathlib
import re
import struct
import subprocess
import time
import urllib.request
import zlib

from . import common

SAMPLES = 2  # a pixel's side in samples
CUT = 0.1  # share of the box that is cut off at near walls; twice that under the ceiling
TYPES = {"double": "d", "float": "f", "uchar": "B", "ushort": "H", "int": "i", "uint": "I"}
TURNS = {"z": ("x", "y", "z"), "-z": ("x", "-y", "-z"), "y": ("x", "-z", "y"), "-y": ("x", "z", "-y"),
         "x": ("y", "z", "x"), "-x": ("z", "y", "-x")}  # of the axis that becomes +z
CAPTURED = ("--set", "scene.width_px=320", "--set", "scene.height_px=240")


def read_ply(path):
    """A dict of the vertices' columns, and the corners of the faces."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode(errors="replace").split("\n")
    if "format binary_little_endian 1.0" not in lines:
        raise common.Failed(f"{path}: not a binary little-endian PLY; `semfield mesh RUN` writes one")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element ")}
    first = next(i for i, line in enumerate(lines) if line.startswith("element face"))
    columns = [line.split()[1:] for line in lines[:first] if line.startswith("property ")]
    row = struct.Struct("<" + "".join(TYPES[kind] for kind, _ in columns))
    end = row.size * counts["vertex"]
    vertices = dict(zip((name for _, name in columns), zip(*row.iter_unpack(body[:end]))))
    return vertices, [face[1:] for face in struct.iter_unpack("<Biii", body[end:end + 13 * counts["face"]])]


def write_png(path, width, rows):
    """RGB rows, filtered by the pixel to the left."""
    raw = b"".join(b"\1" + row[:3] + bytes((a - b) & 255 for a, b in zip(row[3:], row)) for row in rows)
    head = struct.pack(">IIBBBBB", width, len(rows), 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(raw, 9)), (b"IEND", b""))
    pack = struct.Struct(">I").pack
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        pack(len(data)) + kind + data + pack(zlib.crc32(kind + data)) for kind, data in chunks))


def upright(vertices, axis):
    """The vertices turned so that `axis` is +z."""
    turned = dict(vertices)
    for prefix in ("", "n"):
        for to, source in zip("xyz", TURNS[axis]):
            column = vertices[prefix + source[-1]]
            turned[prefix + to] = tuple(-v for v in column) if source[0] == "-" else column
    return turned


def object_color(number):
    """Grey for none; hues by the golden ratio, so that neighbours in any run of numbers differ."""
    if number < 1:
        return (205, 205, 205)
    strength, value = (0.55, 0.85, 0.7)[number % 3], (0.95, 0.7, 0.82)[number // 3 % 3]
    return tuple(255 * v for v in colorsys.hsv_to_rgb(number * 0.618034 % 1, strength, value))


def camera_of(vertices, azimuth, elevation):
    """Eye and axes (right, up, back) of a camera outside the box that looks at a point below its middle."""
    low, high = ([side(vertices[axis]) for axis in "xyz"] for side in (min, max))
    middle = [(a + b) / 2 for a, b in zip(low, high)]
    middle[2] -= 0.12 * (high[2] - low[2])
    a, e = math.radians(azimuth), math.radians(elevation)
    right = (-math.sin(a), math.cos(a), 0)
    up = (-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e))
    back = (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))
    return [m + 1.9 * math.dist(low, high) * b for m, b in zip(middle, back)], right, up, back


def in_front(vertices, faces, back):
    """Faces without those in the cut-off parts of the box."""
    keep = [True] * len(vertices["x"])
    for axis, side, share in zip("xyz", back, (CUT, CUT, 2 * CUT)):
        low, high = min(vertices[axis]), max(vertices[axis])
        cut = share * (high - low)
        low, high = (low, high - cut) if side > 0 else (low + cut, high)
        keep = [k and low <= v <= high for k, v in zip(keep, vertices[axis])]
    return [face for face in faces if all(keep[corner] for corner in face)]


def project(vertices, camera):
    """Of each vertex x to the right and y down, both divided by depth, and depth."""
    eye, right, up, back = camera
    points = []
    for place in zip(vertices["x"], vertices["y"], vertices["z"]):
        ray = [v - e for v, e in zip(place, eye)]
        x, y, z = (sum(a * b for a, b in zip(ray, axis)) for axis in (right, up, back))
        points.append((x / -z, y / z, -z))
    return points


def rasterize(points, faces, width, height):
    """Per sample the vertex that is seen, or -1: the nearest corner of the nearest face that looks at the camera."""
    def area_of(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    faces = [face for face in faces if area_of(*(points[corner] for corner in face)) < 0]
    seen = {corner for face in faces for corner in face}
    (x0, x1), (y0, y1) = ((f(points[i][k] for i in seen) for f in (min, max)) for k in (0, 1))
    scale = 0.98 * min(width / (x1 - x0), height / (y1 - y0))
    ox, oy = width / 2 - scale * (x0 + x1) / 2, height / 2 - scale * (y0 + y1) / 2
    points = [(ox + scale * x, oy + scale * y, z) for x, y, z in points]
    depth, owner = [math.inf] * (width * height), [-1] * (width * height)
    for face in faces:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners = [points[corner] for corner in face]
        area = area_of(*corners)
        for y in range(max(0, math.ceil(min(ay, by, cy))), min(height - 1, math.floor(max(ay, by, cy))) + 1):
            for x in range(max(0, math.ceil(min(ax, bx, cx))), min(width - 1, math.floor(max(ax, bx, cx))) + 1):
                wb = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                wa = 1 - wb - wc
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                z, at = wa * az + wb * bz + wc * cz, y * width + x
                if z < depth[at]:
                    depth[at] = z
                    owner[at] = face[0] if wa >= wb and wa >= wc else face[1] if wb >= wc else face[2]
    return owner


def rows_of(owner, colors, width, height):
    """Rows of RGB bytes: means of SAMPLES x SAMPLES samples over white."""
    colors = [tuple(map(int, color)) for color in colors] + [(255, 255, 255)]
    for top in range(0, height, SAMPLES):
        row = bytearray()
        for left in range(0, width, SAMPLES):
            samples = [colors[owner[(top + y) * width + left + x]] for y in range(SAMPLES) for x in range(SAMPLES)]
            # Six bits a channel: the file is half the size, and nothing of it is seen.
            row += bytes(v & 0xFC | v >> 6 for v in (sum(channel) // SAMPLES**2 for channel in zip(*samples)))
        yield bytes(row)


def mesh_picture(words):
    """Draws a mesh from above, in its colours and with --classes and --objects by class and by object, side by side.
Faces that look away from the camera are left out, and so is what lies at the near walls and under the ceiling: the
view into the room is open."""
    parser = common.parser_of(mesh_picture)
    parser.add_argument("mesh", type=pathlib.Path, metavar="MESH.ply", help="of `semfield mesh RUN`")
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.png")
    parser.add_argument("--classes", type=pathlib.Path, metavar="CLASSES.yaml", help="colours of classes")
    parser.add_argument("--objects", action="store_true", help="also by object")
    parser.add_argument("--up", default="z", choices=TURNS, help="upright axis (z); scenes of COLMAP mostly have -y")
    parser.add_argument("--view", nargs=2, type=float, default=(312, 38), metavar="DEG", help="azimuth and elevation")
    parser.add_argument("--size", nargs=2, type=int, default=(560, 440), metavar="PX", help="width and height")
    options = parser.parse_args(words)
    width, height = (SAMPLES * v for v in options.size)
    vertices, faces = read_ply(options.mesh)
    vertices = upright(vertices, options.up)
    camera = camera_of(vertices, *options.view)
    owner = rasterize(project(vertices, camera), in_front(vertices, faces, camera[3]), width, height)
    light = [0.15 * r + 0.6 * u + 0.6 * b for r, u, b in zip(*camera[1:])]

    def lit(column, color_of):
        for normal, number in zip(zip(vertices["nx"], vertices["ny"], vertices["nz"]), vertices[column]):
            shade = 0.7 + 0.35 * max(0, sum(n * l for n, l in zip(normal, light)) / math.hypot(*light))
            yield [min(255, shade * v) for v in color_of(number)]

    panels = [zip(*(vertices[name] for name in ("red", "green", "blue")))]
    if options.classes and "label" in vertices:
        rows = re.findall(r"id: (\d+),.*?color: \[(\d+), (\d+), (\d+)\]", options.classes.read_text(encoding="utf-8"))
        table = {int(i): tuple(map(int, color)) for i, *color in rows}
        panels.append(lit("label", lambda label: table.get(label, (0, 0, 0))))
    if options.objects and "instance" not in vertices:
        raise common.Failed(f"{options.mesh} has no objects; find them with `semfield objects RUN` and write it again")
    if options.objects:
        panels.append(lit("instance", object_color))
    rows = [b"".join(row) for row in zip(*(rows_of(owner, colors, width, height) for colors in panels))]
    write_png(options.out, len(panels) * width // SAMPLES, rows)
    return 0


class Page:
    """The labelling page, asked by the same requests as a browser's."""

    def __init__(self, program, folder):
        words = [program, "serve", common.QUICKSTART, *CAPTURED, "--set", "scene.labels.frames=none",
                 "--out", folder / "run", "--json", "--quiet"]
        self.server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self.url = json.loads(self.server.stdout.readline())["url"]

    def ask(self, path, body=None):
        request = urllib.request.Request(f"{self.url.rstrip('/')}/{path}", body and json.dumps(body).encode())
        with urllib.request.urlopen(request, timeout=300) as answer:
            return answer.read()

    def state(self, wanted, seconds=600):
        """The state, once it is as wanted."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            state = json.loads(self.ask("state?after=0"))
            if state["failure"]:
                raise common.Failed(f"training failed: {state['failure']}")
            if wanted(state):
                return state
            time.sleep(0.2)
        raise common.Failed(f"the page did not get there in {seconds} s; give it an idle machine")

    def labels(self, view):
        """A view's labels as PNG; empty where there are none yet."""
        body, parts = self.ask("picture", {"client": "film", "view": view, "full": True}), []
        while body:
            size, = struct.unpack_from("<I", body)
            parts.append(body[4:4 + size])
            body = body[4 + size:]
        return parts[2]


def number_of(view):
    """Of a view's frame, as its file of truth has it."""
    return int(re.search("[0-9]+", view["frame"])[0])


def click_through(page, options, folder):
    """Clicks, and pictures after each. How many pictures have no labels yet, and which classes were clicked."""
    table = re.findall(r'id: (\d+), name: "([^"]*)"', (folder / "truth" / "classes.yaml").read_text(encoding="utf-8"))
    names = {int(number): name for number, name in table}
    state = page.state(lambda now: now["run"]["geometry_ready"] and now["run"]["train_s"] >= options.learn)
    numbers = [number_of(view) for view in state["views"]]
    shown = [numbers.index(int(number)) for number in options.frames.split(",")]
    for i, view in enumerate(shown):
        (folder / f"color_{i}.jpg").write_bytes(page.ask(f"photo?view={view}"))
    classes, empty = set(), 0
    for clicks in range(options.clicks + 1):
        pictures = [page.labels(view) for view in shown]
        empty += not all(pictures)
        for i, picture in enumerate(pictures if all(pictures) else []):
            (folder / f"label_{i}_{clicks - empty:03d}.png").write_bytes(picture)
        if clicks == options.clicks:
            return empty, classes
        state = page.state(lambda now: now["proposal"] is not None)
        place = state["proposal"]
        view = state["views"][place["view"]]
        width, height = view["width"], view["height"]
        truth = folder / "truth" / "semantic_class" / f"semantic_class_{number_of(view)}.png"
        x, y = min(int(place["at"][0]), width - 1), min(int(place["at"][1]), height - 1)
        name = names[common.read_pictures(truth, "gray")[y * width + x]]
        page.ask("event", {"id": f"film-{clicks}", "type": "click", "frame": view["frame"], "size": [width, height],
                           "points": [place["at"]], "radius": 1, "class": name})
        classes.add(name)
        page.state(lambda now: now["overlay"]["events"] > clicks and (now["proposal"] or {}).get("id") != place["id"])


def join_film(folder, views, empty, out):
    """Labels over colours, side by side, a moment per click and longer at the end."""
    inputs, chains = [], ""
    for i in range(views):
        inputs += ["-loop", "1", "-framerate", "4", "-i", folder / f"color_{i}.jpg",
                   "-framerate", "4", "-i", folder / f"label_{i}_%03d.png"]
        chains += (f"[{2 * i}]eq=saturation=0.7[gray{i}];"
                   f"[{2 * i + 1}]format=rgba,colorchannelmixer=aa=0.65,tpad=start={empty}:color=black@0[over{i}];"
                   f"[gray{i}][over{i}]overlay=shortest=1[view{i}];")
    chains += "".join(f"[view{i}]" for i in range(views))
    chains += (f"hstack=inputs={views},tpad=stop_mode=clone:stop_duration=3,"
               "split[a][b];[a]palettegen=max_colors=128:stats_mode=full[palette];"
               "[b][palette]paletteuse=dither=none:diff_mode=rectangle")
    common.run("ffmpeg", "-v", "error", "-y", *inputs, "-filter_complex", chains, "-loop", "0", out)


def labelling_film(words):
    """A film of clicks that become a labelled room. `semfield serve` trains the shipped room without labels. A
simulated person answers the page's questions, one click each, with the true class of the pixel, over the same requests
as the page. After each click the labels of the views are fetched; ffmpeg lays them over the photos and makes a film.

The last line is `film: clicks=... classes=... frames=... bytes=...`."""
    parser = common.parser_of(labelling_film)
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.gif")
    parser.add_argument("--clicks", type=int, default=30, help="how many (default: %(default)s)")
    parser.add_argument("--learn", type=float, default=45, help="seconds before the first click (default: %(default)s)")
    parser.add_argument("--frames", default="132,22", help="numbers of those shown (default: %(default)s)")
    common.add_build(parser)
    options = parser.parse_args(words)
    program = options.build / "bin" / "semfield"
    with common.work_folder() as folder:
        common.run(program, "capture", common.QUICKSTART, *CAPTURED, "--set", "scene.labels.frames=all", "--quiet",
                   "--out", folder / "truth")
        page = Page(program, folder)
        try:
            empty, classes = click_through(page, options, folder)
        finally:
            page.server.kill()  # nobody resumes this run
            page.server.wait()
        join_film(folder, len(options.frames.split(",")), empty, options.out)
    print(f"film: clicks={options.clicks} classes={len(classes)} frames={options.clicks + 1} "
          f"bytes={options.out.stat().st_size}")
    return 0
