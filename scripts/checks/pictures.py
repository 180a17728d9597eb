"""Pictures of the documents: meshes from above, and the film of clicks, by NumPy and ffmpeg."""
import colorsys
import json
import math
import pathlib
import re
import struct
import subprocess
import time
import urllib.request

import numpy as np

from . import common

SAMPLES = 2  # a pixel's side in samples
CUT = (0.1, 0.1, 0.2)  # shares of the box that are cut off at near walls and under the ceiling
TYPES = {"double": "<f8", "float": "<f4", "uchar": "u1", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
CAPTURED = ("--set", "scene.width_px=320", "--set", "scene.height_px=240")


def read_ply(path):
    """The vertices as records, and the corners of the faces."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode(errors="replace").split("\n")
    if "format binary_little_endian 1.0" not in lines:
        raise common.Failed(f"{path}: not a binary little-endian PLY; `semfield mesh RUN` writes one")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element ")}
    first = next(i for i, line in enumerate(lines) if line.startswith("element face"))
    columns = [line.split()[1:] for line in lines[:first] if line.startswith("property ")]
    vertices = np.frombuffer(body, [(name, TYPES[kind]) for kind, name in columns], counts["vertex"])
    faces = np.frombuffer(body, [("count", "u1"), ("corners", "<i4", 3)], counts["face"], vertices.nbytes)
    return vertices, faces["corners"]


def upright(vertices, names, axis):
    """[N, 3] places or normals, turned so that `axis` is +z."""
    x, y, z = (vertices[name].astype(float) for name in names)
    turned = {"z": (x, y, z), "-z": (x, -y, -z), "y": (x, -z, y), "-y": (x, z, -y), "x": (y, z, x), "-x": (z, y, -x)}
    return np.stack(turned[axis], 1)


def object_color(number):
    """Grey for none; hues by the golden ratio, so that neighbours in any run of numbers differ."""
    if number < 1:
        return (205, 205, 205)
    strength, value = (0.55, 0.85, 0.7)[number % 3], (0.95, 0.7, 0.82)[number // 3 % 3]
    return tuple(255 * v for v in colorsys.hsv_to_rgb(number * 0.618034 % 1, strength, value))


def axes_of(azimuth, elevation):
    """Right, up and back of a camera."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([[-math.sin(a), math.cos(a), 0],
                     [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)],
                     [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]])


def visible(places, faces, axes, width, height):
    """[height, width] of the vertex that each sample sees, -1 for none: the nearest corner of the nearest face that
    looks at a camera outside the box, which looks at a point below its middle. Cut-off parts are left out."""
    low, high = places.min(0), places.max(0)
    eye = (low + high) / 2 - [0, 0, 0.12 * (high[2] - low[2])] + 1.9 * math.dist(low, high) * axes[2]
    rays = (places - eye) @ axes.T
    points, depth = rays[:, :2] / rays[:, 2:] * [-1, 1], -rays[:, 2]
    cut, near = (high - low) * CUT, axes[2] > 0
    kept = ((places >= low + cut * ~near) & (places <= high - cut * near)).all(1)
    faces = faces[kept[faces].all(1)]
    (ax, ay), (bx, by), (cx, cy) = points[faces].transpose(1, 2, 0)
    faces = faces[(bx - ax) * (cy - ay) < (by - ay) * (cx - ax)]
    size, shown = np.array([width, height]), points[faces]
    scale = 0.98 * min(size / np.ptp(shown, axis=(0, 1)))
    points = size / 2 + scale * (points - (shown.min((0, 1)) + shown.max((0, 1))) / 2)
    first = np.maximum(np.ceil(points[faces].min(1)), 0).astype(int)
    last = np.minimum(np.floor(points[faces].max(1)), size - 1).astype(int)
    owner, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    for i in np.flatnonzero((first <= last).all(1)):
        face, (x0, y0), (x1, y1) = faces[i], first[i], last[i]
        (ax, ay), (bx, by), (cx, cy) = points[face]
        x, y = np.arange(x0, x1 + 1), np.arange(y0, y1 + 1)[:, None]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
        shares = np.stack([1 - b - c, b, c])
        z = np.tensordot(depth[face], shares, 1)
        here = (slice(y0, y1 + 1), slice(x0, x1 + 1))
        front = (shares >= 0).all(0) & (z < nearest[here])
        nearest[here][front] = z[front]
        owner[here][front] = face[shares.argmax(0)][front]
    return owner


def mesh_picture(words):
    """Draws a mesh from above, in its colours and with --classes and --objects by class and by object, side by side.
Faces that look away from the camera are left out, and so is what lies at the near walls and under the ceiling: the view
into the room is open."""
    parser = common.parser_of(mesh_picture)
    parser.add_argument("mesh", type=pathlib.Path, metavar="MESH.ply", help="of `semfield mesh RUN`")
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.png")
    parser.add_argument("--classes", type=pathlib.Path, metavar="CLASSES.yaml", help="colours of classes")
    parser.add_argument("--objects", action="store_true", help="also by object")
    parser.add_argument("--up", default="z", choices=("z", "-z", "y", "-y", "x", "-x"),
                        help="upright axis (default: z); scenes of COLMAP mostly have -y")
    parser.add_argument("--view", nargs=2, type=float, default=(312, 38), metavar="DEG", help="azimuth and elevation")
    parser.add_argument("--size", nargs=2, type=int, default=(560, 440), metavar="PX", help="width and height")
    options = parser.parse_args(words)
    width, height = options.size
    vertices, faces = read_ply(options.mesh)
    axes = axes_of(*options.view)
    light = np.array([0.15, 0.6, 0.6]) @ axes
    normals = upright(vertices, ("nx", "ny", "nz"), options.up) @ light / np.linalg.norm(light)
    shade = 0.7 + 0.35 * np.maximum(0, normals)[:, None]
    panels = [np.stack([vertices[name] for name in ("red", "green", "blue")], 1)]
    if options.classes and "label" in vertices.dtype.names:
        rows = re.findall(r"id: (\d+),.*?color: \[(\d+), (\d+), (\d+)\]", options.classes.read_text(encoding="utf-8"))
        table = {int(i): tuple(map(int, color)) for i, *color in rows}
        panels.append(shade * [table.get(label, (0, 0, 0)) for label in vertices["label"].tolist()])
    if options.objects and "instance" not in vertices.dtype.names:
        raise common.Failed(f"{options.mesh} has no objects; find them with `semfield objects RUN` and write it again")
    if options.objects:
        panels.append(shade * [object_color(number) for number in vertices["instance"].tolist()])
    places = upright(vertices, ("x", "y", "z"), options.up)
    owner = visible(places, faces, axes, width * SAMPLES, height * SAMPLES)
    picture = np.concatenate([np.concatenate([np.minimum(colors, 255), [[255] * 3]])[owner] for colors in panels], 1)
    # Means of the samples over white. Six bits a channel: the file is half the size, and nothing of it is seen.
    picture = picture.astype(int).reshape(height, SAMPLES, -1, SAMPLES, 3).sum((1, 3)) // SAMPLES**2
    picture = (picture & 0xFC | picture >> 6).astype(np.uint8)
    common.write_pictures(options.out, picture.tobytes(), picture.shape[1], height, "rgb24")
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
