"""What a run hands over to other programs, its splats next to its field, and the page of `semfield view`."""
import base64
import json
import math
import pathlib
import signal
import subprocess
import sys
import time

from . import common

sys.path[1:1] = [str(common.ROOT / "tests" / name) for name in ("handover", "page")]
import browser  # noqa: E402
import firefox  # noqa: E402
import numpy as np  # noqa: E402
import other_programs  # noqa: E402

NPM_PACKAGES = ("gltf-validator@2.0.0-dev.3.10", "copc@0.0.8")
PROTOCOLS = ("semantic_nerf", "panoptic_lifting", "scannet20", "nyu40")
# Of each program its function in tests/handover/other_programs.py: the column that holds the class, and the files.
LABELS = {"cloudcompare": ("label", ("coarse_points.ply", "coarse.ply")),
          "meshlab": ("quality", ("coarse_points.ply", "coarse.ply")),
          "open3d": ("label", ("coarse_points.ply",)), "pcl": ("label", ("coarse.pcd",))}
FORMATS = {"html_mb": ".3f", "html_opens": "", "firefox_opens": "", "splat_psnr_loss": ".3f",
           **{f"{name}_labels": ".3f" for name in LABELS}, "gltf_errors": "d", "las_points_equal": ".3f",
           "octomap_cells_equal": ".3f", "view_ready_s": ".3f", "measured_error": ".3f", "protocols": ""}
MOST = {"html_mb": 25, "splat_psnr_loss": 2, "gltf_errors": 0, "view_ready_s": 3, "measured_error": 0.02}
# A reference renderer of 3D Gaussians by NumPy.
LOW_PASS = 0.3  # square pixels that every footprint is widened by [Kerbl23]
LEAST_ALPHA = 1 / 255
NEAR = 0.05
HARMONIC = 0.28209479177387814
EDGE, TOP = 1.24, (3.72, 2.5, 0.745)  # metres; a place on the table's top, off the lamp above the middle
COLORS = """
    const canvas = document.getElementById("view"), small = document.createElement("canvas").getContext("2d");
    small.drawImage(canvas, 0, 0, 64, 48);
    return new Set(new Uint32Array(small.getImageData(0, 0, 64, 48).data.buffer)).size;"""
MEASURE = """
    const [top, edge, side] = arguments, page = semfield;
    Object.assign(page.camera, {yaw: 0, pitch: 1.45});
    page.camera.look_at(top, 0.6 * edge);
    page.camera.reach = 2.2;
    const clip = page.camera.matrices().clip;
    const at = (x) => {
      const p = moved(clip, [x, top[1], top[2]]);
      const found = page.read((p[0] + 1) / 2 * canvas.clientWidth, (1 - p[1]) / 2 * canvas.clientHeight);
      if (found === null || page.facts.classes[found.label]?.name !== "table") return null;
      return Math.abs(found.place[2] - top[2]) < 0.04 ? found.place : null;
    };
    let inside = 0, outside = 0.75 * edge, last = at(top[0]);
    while (last !== null && outside - inside > 0.004) {  // where the table ends
      const middle = (inside + outside) / 2, place = at(top[0] + side * middle);
      if (place === null) outside = middle; else [inside, last] = [middle, place];
    }
    return last;"""
DRAW = """
    const {drawing, layers, camera} = semfield, pixel = new Uint8Array(4), calls = drawing.calls;
    const picture = (light) => {
      drawing.draw(layers, 0, camera.matrices(), 0.5, light);
      drawing.gl.readPixels(0, 0, 1, 1, drawing.gl.RGBA, drawing.gl.UNSIGNED_BYTE, pixel);
    };
    picture(false);
    return [drawing.calls - calls, ...[false, true].map((light) => {
      picture(light);
      const begin = performance.now();
      for (let k = 0; k < 10; ++k) picture(light);
      return (performance.now() - begin) / 10;
    })];"""


def view_figures(program, run):
    """How soon the page shows the run, how well it measures the table, and how long a picture takes."""
    if not browser.programs():
        raise other_programs.Absent("no chromium and chromium-driver here: apt-get install chromium chromium-driver")
    with common.work_folder() as folder:
        common.run(program, "export", run, "--to", folder / "room.html", "-q")
        megabytes = (folder / "room.html").stat().st_size * 1e-6
    with browser.Driver() as driver:
        page, begin = driver.browser(), time.monotonic()
        viewed = subprocess.Popen([program, "view", run, "--json", "-q"], stdout=subprocess.PIPE, text=True)
        try:
            page.open(json.loads(viewed.stdout.readline())["url"])
            page.wait("document.body.dataset.state === 'ready'", "no picture", 60)
            ready = time.monotonic() - begin
            page.wait("document.body.dataset.mesh === '1 of 1 fine'", "no fine mesh", 300)
            page.call("POST", "/timeouts", {"script": 300_000})  # a CPU draws the whole mesh for every point
            ends = [page.run(MEASURE, TOP, EDGE, side) for side in (-1, 1)]
            calls, frame, turn = page.run(DRAW)
        finally:
            viewed.send_signal(signal.SIGINT)
            viewed.wait()
    if not all(ends):
        raise common.Failed("the table is not seen: the run is none of the shipped room, or was trained too briefly")
    length = math.dist(*ends)
    common.say(f"table: {length:.3f} m, true {EDGE} m")
    return {"view_ready_s": ready, "measured_error": abs(length - EDGE) / EDGE, "html_mb": megabytes,
            "draw_calls": calls, "frame_ms": frame, "turn_ms": turn}


def view(words):
    """Measures how soon `semfield view` shows a run of the shipped room, and the long edge of the dining table as a
person does, by points read in headless Chromium: the last ones of the table's top on the line from end to end.

The last line has view_ready_s (from start to the first picture), measured_error (share of the edge), html_mb (of
`semfield export --to`), draw_calls (of one picture), frame_ms (one picture of the fine mesh at 1280 x 720, drawn by
the CPU where there is no GPU) and turn_ms (of the lighter mesh that is drawn while the camera moves, where the fine
one is slow)."""
    parser = common.parser_of(view)
    parser.add_argument("run", metavar="RUN", help="run folder")
    common.add_build(parser)
    options = parser.parse_args(words)
    common.print_line("view", view_figures(options.build / "bin" / "semfield", options.run),
                      {"view_ready_s": ".1f", "measured_error": ".3f", "html_mb": ".1f", "draw_calls": "d",
                       "frame_ms": ".0f", "turn_ms": ".0f"})
    return 0


def opened(run):
    """Whether the page drew something: its picture has many colours."""
    for _ in range(300):
        if run("return document.body.dataset.state") != "loading" and run(COLORS) > 100:
            return True
        time.sleep(0.2)
    return False


def mesh_picture(words):
    """Draws a mesh from outside, in the colours of the page that shows it, side by side: a picture for a page of the
documents. It needs chromium and chromium-driver."""
    parser = common.parser_of(mesh_picture)
    parser.add_argument("page", type=pathlib.Path, metavar="PAGE.html", help="of `semfield mesh RUN --out PAGE.html`")
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.png")
    parser.add_argument("--modes", default="photo", help="of photo, class, object, with commas (default: %(default)s)")
    parser.add_argument("--size", nargs=2, type=int, default=(560, 440), metavar="PX",
                        help="width and height (560 440)")
    options = parser.parse_args(words)
    with browser.Driver() as driver, common.work_folder() as folder:
        page = driver.browser(*options.size)
        page.open(options.page.resolve().as_uri())
        page.wait("document.body.dataset.state === 'ready'", "no picture", 60)
        inputs = []
        for mode in options.modes.split(","):
            data = page.run("semfield.set_mode(arguments[0]); semfield.draw(); return canvas.toDataURL();", mode)
            inputs += ["-i", folder / f"{mode}.png"]
            inputs[-1].write_bytes(base64.b64decode(data.partition(",")[2]))
        joined = ["-filter_complex", f"hstack=inputs={len(inputs) // 2}"] if len(inputs) > 2 else []
        common.run("ffmpeg", "-v", "error", "-y", *inputs, *joined, options.out)
    return 0


def read_splats(path):
    head, _, body = pathlib.Path(path).read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    kinds = {"float": "<f4", "int": "<i4"}
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    rows = np.frombuffer(body, [(name, kinds[kind]) for kind, name in fields])
    stack = lambda *names: np.stack([rows[name].astype(np.float64) for name in names], 1)
    offset = next(line for line in lines if line.startswith("comment")).split()[-3:]
    return {
        "place": stack("x", "y", "z") + np.array(offset, float),
        "color": np.clip(0.5 + HARMONIC * stack("f_dc_0", "f_dc_1", "f_dc_2"), 0, 1),
        "opacity": 1 / (1 + np.exp(-rows["opacity"].astype(np.float64))),
        "axes": (rotations(stack(*(f"rot_{k}" for k in range(4))))
                 * np.exp(stack(*(f"scale_{k}" for k in range(3))))[:, None, :]),
    }


def rotations(quaternions):
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                     2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)


def footprints(splats, camera, pose):
    """What lies before the camera, the nearest first: middle in pixels, inverse covariance, radius, opacity, colour."""
    place = (splats["place"] - pose[:3, 3]) @ pose[:3, :3]
    z = np.where(place[:, 2] > NEAR, place[:, 2], 1)
    u, v = camera.fx * place[:, 0] / z + camera.cx, camera.fy * place[:, 1] / z + camera.cy
    margin = 0.3 * max(camera.width, camera.height)
    kept = np.flatnonzero((place[:, 2] > NEAR) & (u > -margin) & (v > -margin) & (u < camera.width + margin)
                          & (v < camera.height + margin))
    kept = kept[np.argsort(z[kept], kind="stable")]
    x, y, z = place[kept].T
    zero = np.zeros_like(z)
    slope = np.stack([camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2], 1)
    flat = slope.reshape(-1, 2, 3) @ (pose[:3, :3].T @ splats["axes"][kept])
    cover = flat @ flat.transpose(0, 2, 1)
    a, b, c = cover[:, 0, 0] + LOW_PASS, cover[:, 0, 1], cover[:, 1, 1] + LOW_PASS
    det = a * c - b * b
    largest = 0.5 * (a + c) + np.sqrt(np.maximum(0.25 * (a - c) ** 2 + b * b, 0))
    radius = np.ceil(3 * np.sqrt(largest)).astype(int)
    return u[kept], v[kept], (c / det, -b / det, a / det), radius, splats["opacity"][kept], splats["color"][kept]


def draw(splats, camera, pose):
    """[H, W, 3] by elliptical weighted averages [Zwicker01] from front to back; what is left of the light is black."""
    u, v, inverse, radius, opacity, color = footprints(splats, camera, pose)
    width, height = camera.width, camera.height
    found = []  # pixel, rank from the front, alpha
    for r in np.unique(radius):
        of, steps = np.flatnonzero(radius == r), np.arange(-r, r + 1)
        for some in np.array_split(of, max(1, len(of) * len(steps) ** 2 // 4_000_000)):
            column = lambda values: values[some][:, None, None]
            px, py = np.floor(column(u)).astype(int) + steps, np.floor(column(v)).astype(int) + steps[:, None]
            dx, dy = px + 0.5 - column(u), py + 0.5 - column(v)
            ia, ib, ic = map(column, inverse)
            alpha = np.minimum(column(opacity) * np.exp(-0.5 * (ia * dx**2 + 2 * ib * dx * dy + ic * dy**2)), 0.99)
            which = np.nonzero((alpha >= LEAST_ALPHA) & (px >= 0) & (px < width) & (py >= 0) & (py < height))
            found.append(((py * width + px)[which].astype(np.int32), some[which[0]].astype(np.int32), alpha[which]))
    pixel, rank, alpha = map(np.concatenate, zip(*found))
    order = np.lexsort((rank, pixel))
    pixel, rank, alpha = pixel[order], rank[order], alpha[order]
    through = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha))])[:-1]  # what lies before, of all pixels so far
    first = np.flatnonzero(np.concatenate([[True], pixel[1:] != pixel[:-1]]))
    start = np.repeat(through[first], np.diff(np.concatenate([first, [len(pixel)]])))
    weight = alpha * np.exp(through - start)
    planes = [np.bincount(pixel, weight * color[rank, k], width * height) for k in range(3)]
    return np.stack(planes, 1).reshape(height, width, 3)


def compare(build, run, path, every):
    """PSNR of the field and of its splats at every n-th held-out view, and how many views and splats those are."""
    sys.path.insert(0, str(build / "python"))
    import semfield

    loaded, splats = semfield.load(str(run)), read_splats(path)
    frames = [frame for frame in loaded.frames if frame.split == "test"][::every]
    squared = {"field": [], "splats": []}
    for frame in frames:
        truth = loaded.pixels(frame.name).rgb / 255
        drawn = draw(splats, frame.camera, np.asarray(frame.pose))
        for what, image in ("field", loaded.render(frame=frame.name).rgb), ("splats", drawn):
            squared[what].append(np.mean((np.asarray(image, dtype=np.float64) - truth) ** 2))
    psnr = {what: -10 * np.log10(np.mean(values)) for what, values in squared.items()}
    return {**psnr, "frames": len(frames), "splats_count": len(splats["place"])}


def splats(words):
    """Draws the splats of a PLY [Kerbl23] at held-out views of the run that they came from, and scores them and the
field.

The last line is `splats: field=... splats=... frames=... splats_count=...`, the first two as PSNR in dB."""
    parser = common.parser_of(splats)
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("splats", metavar="SPLATS.ply", help="of `semfield mesh RUN --format splats.ply`")
    parser.add_argument("every", type=int, nargs="?", default=1, metavar="N", help="every N-th view (default: 1)")
    common.add_build(parser)
    options = parser.parse_args(words)
    found = compare(options.build, options.run, options.splats, options.every)
    common.print_line("splats", found, {"field": ".2f", "splats": ".2f", "frames": "d", "splats_count": "d"})
    return 0


def share_equal(found, meant):
    return sum(a == b for a, b in zip(found, meant)) / max(len(found), len(meant))


class HandOver:
    """Each part adds figures; Absent where a program is not on this machine."""

    def __init__(self, build, run, folder):
        self.build, self.program, self.run, self.folder = build, build / "bin" / "semfield", run, folder
        self.figures = {}

    def write(self, steps):
        if self.run is None:
            self.run = self.folder / "run"
            common.say(f"training the shipped room for {steps} steps")
            common.run(self.program, "train", common.QUICKSTART, "--steps", steps, "--out", self.run, "--quiet")
            common.run(self.program, "objects", self.run, "--quiet")
        mesh = [self.program, "mesh", self.run, "--quiet"]
        common.run(*mesh, "--format", "html,splats.ply", "--out", self.folder / "room")
        common.run(*mesh, "--voxel", "0.05", "--format", "ply,glb,las,pcd,npz,bt,ot", "--points", "--color", "photo",
                   "--out", self.folder / "coarse")
        self.points, self.mesh = (other_programs.ply_columns(self.folder / name) for name in
                                  ("coarse_points.ply", "coarse.ply"))

    def page(self):
        self.figures["html_mb"] = (self.folder / "room.html").stat().st_size * 1e-6
        if not browser.programs():
            raise other_programs.Absent("apt-get install chromium chromium-driver")
        with browser.Driver() as driver:
            window = driver.browser()
            window.open((self.folder / "room.html").as_uri())
            self.figures["html_opens"] = "yes" if opened(window.run) and not window.complaints() else "no"

    def firefox(self):
        if firefox.missing():
            raise other_programs.Absent("apt-get install " + " ".join(firefox.missing()))
        with firefox.Firefox() as window:
            window.open((self.folder / "room.html").as_uri())
            self.figures["firefox_opens"] = "yes" if opened(window.run) else "no"

    def view(self):
        found = view_figures(self.program, self.run)
        self.figures.update({name: found[name] for name in ("view_ready_s", "measured_error")})

    def splats(self):
        try:
            found = compare(self.build, self.run, self.folder / "room.splats.ply", 3)
        except ModuleNotFoundError as missing:
            raise other_programs.Absent(f"no Python module {missing.name} here: build semfield's") from None
        common.say(f"{found['splats_count']} splats have {found['splats']:.2f} dB on {found['frames']} held-out views, "
                   f"the field {found['field']:.2f} dB")
        self.figures["splat_psnr_loss"] = found["field"] - found["splats"]

    def labels(self, name):
        column, files = LABELS[name]
        read = getattr(other_programs, name)
        meant = {"coarse.ply": self.mesh}  # the others hold the points
        self.figures[f"{name}_labels"] = min(
            share_equal(read(self.folder / file)[column], meant.get(file, self.points)["label"]) for file in files)

    def gltf(self):
        issues = other_programs.gltf(self.folder / "coarse.glb")
        self.figures["gltf_errors"] = issues["numErrors"]
        for message in issues["messages"][:5]:
            common.say(f"coarse.glb: {message['code']}: {message['message']} at {message.get('pointer', '')}")

    def las(self):
        found, meant = other_programs.las(self.folder / "coarse.las"), self.points
        rows = zip(*(meant[name] for name in ("x", "y", "z", "label", "red")),
                   *(found[name] for name in ("X", "Y", "Z", "label", "Classification", "Red")))
        equal = sum(max(abs(x - X), abs(y - Y), abs(z - Z)) <= 5.1e-5 and label == extra == kind and Red == 257 * red
                    for x, y, z, label, red, X, Y, Z, extra, kind, Red in rows)
        self.figures["las_points_equal"] = equal / max(len(meant["x"]), len(found["X"]))

    def octomap(self):
        with np.load(self.folder / "coarse.npz") as grid:
            states, first = grid["occupancy"], np.rint(grid["origin"] / grid["edge"]).astype(int)
        # 1 occupied or 0 free of every cube that is known, by its place in edges.
        meant = {tuple((first + at).tolist()): int(states[tuple(at)] == 100) for at in np.argwhere(states >= 0)}
        shares = []
        for name in ("coarse.bt", "coarse.ot"):
            found = other_programs.octomap(self.folder / name)
            shares.append(sum(found.get(key) == state for key, state in meant.items()) / max(len(meant), len(found)))
        self.figures["octomap_cells_equal"] = min(shares)

    def protocols(self):
        gave = []
        for name in PROTOCOLS:
            try:
                score = common.ask(self.program, "eval", self.run, "--protocol", name)["protocol"]
            except common.Failed as failed:
                common.say(str(failed))
                continue
            if score["miou"] is not None:
                common.say(f"{name}: mIoU {score['miou']:.4f}, {len(score['classes'])} classes, truth {score['truth']}")
                gave.append(name)
        self.figures["protocols"] = ",".join(gave) or "none"


def install_npm(folder):
    """Into the build tree, where tests find them too."""
    if not (folder / "node_modules").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        try:
            options = ("--no-audit", "--no-fund", "--ignore-scripts", "--prefix", folder)
            common.run("npm", "install", *options, *NPM_PACKAGES)
        except (OSError, common.Failed) as failed:
            common.say(f"the packages of npm cannot be had: {failed}")


def hand_over(words):
    """Checks what a finished run hands over to other programs. The page, surfaces, points, splats and maps of
`semfield mesh` are written, and each is opened by a program that nobody here wrote: CloudCompare, MeshLab, Open3D,
PCL, OctoMap (of Debian), the Khronos validator and the LAS reader of `copc` (of npm), headless Chromium, and Firefox.
What they read is compared with what was written. Splats are drawn by NumPy at every third held-out view and scored
next to the field.

The last line is `hand_over: html_mb=... ... protocols=...`. *_labels are shares of points whose class came through,
*_equal shares of points (place, colour and class) and of cubes (state). splat_psnr_loss are dB that splats lie below
the field. protocols are those of `semfield eval --protocol` that gave a figure. What was not measured is n/a, and a
line says why. Exit code 1 where a page is over 25 MB or does not open, splats lose over 2 dB, a share is below 1, the
validator finds an error, or a view takes over 3 s or measures over 2 % wrong."""
    parser = common.parser_of(hand_over)
    parser.add_argument("run", nargs="?", metavar="RUN", help="of a room; without one the shipped room is trained")
    parser.add_argument("--steps", type=int, default=3000, help="of that training (default: %(default)s)")
    parser.add_argument("--keep", metavar="FOLDER", help="leave run and files there")
    common.add_build(parser)
    options = parser.parse_args(words)
    failed = False
    with common.work_folder(options.keep) as folder:
        check = HandOver(options.build.resolve(), options.run, folder)
        check.write(options.steps)
        install_npm(other_programs.NODE_MODULES.parent)
        parts = "page firefox view splats gltf las octomap protocols".split()
        for name in [*LABELS, *parts]:
            try:
                if name in LABELS:
                    check.labels(name)
                else:
                    getattr(check, name)()
            except other_programs.Absent as absent:
                common.say(f"{name} is not measured: {absent}")
            except (RuntimeError, OSError, KeyError, AssertionError, subprocess.SubprocessError) as error:
                common.say(f"{name}: {type(error).__name__}: {error}")
                failed = True
    figures = check.figures
    common.print_line("hand_over", figures, FORMATS)
    failed |= any(figures.get(key, 0) > most for key, most in MOST.items())
    failed |= any(figures[key] < 1 for key in figures if key.endswith(("_labels", "_equal")))
    failed |= "no" in (figures.get("html_opens"), figures.get("firefox_opens"))
    return int(failed)
