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
        raise common.Failed("no chromium and chromium-driver here: apt-get install chromium chromium-driver")
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
one is slow). It fails beyond 3 s and 2 %."""
    parser = common.parser_of(view)
    parser.add_argument("run", metavar="RUN", help="run folder")
    common.add_build(parser)
    options = parser.parse_args(words)
    found = view_figures(options.build / "bin" / "semfield", options.run)
    common.print_line("view", found, {"view_ready_s": ".1f", "measured_error": ".3f", "html_mb": ".1f",
                                      "draw_calls": "d", "frame_ms": ".0f", "turn_ms": ".0f"})
    return int(found["view_ready_s"] > 3 or found["measured_error"] > 0.02)


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

The last line is `splats: field=... splats=... frames=... splats_count=...`, the first two as PSNR in dB. It fails where splats lose more than 2 dB."""
    parser = common.parser_of(splats)
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("splats", metavar="SPLATS.ply", help="of `semfield mesh RUN --format splats.ply`")
    parser.add_argument("every", type=int, nargs="?", default=1, metavar="N", help="every N-th view (default: 1)")
    common.add_build(parser)
    options = parser.parse_args(words)
    found = compare(options.build, options.run, options.splats, options.every)
    common.print_line("splats", found, {"field": ".2f", "splats": ".2f", "frames": "d", "splats_count": "d"})
    return int(found["field"] - found["splats"] > 2)


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
    """Checks what the suite cannot of what a run hands over: its page in headless Chromium and in Firefox. It installs
the packages of npm too, with which the suite reads glTF and LAS; without them, and without CloudCompare, MeshLab,
Open3D, PCL and OctoMap, handover_test leaves those out.

The last line is `hand_over: html_mb=... html_opens=... firefox_opens=...`. What was not measured is n/a, and a line
says why. Exit code 1 where the page is over 25 MB or does not open."""
    parser = common.parser_of(hand_over)
    parser.add_argument("run", metavar="RUN", help="run folder")
    common.add_build(parser)
    options = parser.parse_args(words)
    install_npm(other_programs.NODE_MODULES.parent)
    figures = {}
    with common.work_folder() as folder:
        page = folder / "room.html"
        common.run(options.build / "bin" / "semfield", "export", options.run, "--to", page, "-q")
        figures["html_mb"] = page.stat().st_size * 1e-6
        if not browser.programs():
            common.say("html_opens: apt-get install chromium chromium-driver")
        else:
            with browser.Driver() as driver:
                window = driver.browser()
                window.open(page.as_uri())
                figures["html_opens"] = "yes" if opened(window.run) and not window.complaints() else "no"
        if firefox.missing():
            common.say("firefox_opens: apt-get install " + " ".join(firefox.missing()))
        else:
            with firefox.Firefox() as window:
                window.open(page.as_uri())
                figures["firefox_opens"] = "yes" if opened(window.run) else "no"
    common.print_line("hand_over", figures, {"html_mb": ".3f", "html_opens": "", "firefox_opens": ""})
    return int(figures["html_mb"] > 25 or "no" in figures.values())
