"""A reference renderer of 3D Gaussians by NumPy, and how far it stays below the field that they came from."""
import pathlib
import sys

import numpy as np

from . import common

LOW_PASS = 0.3  # square pixels that every footprint is widened by [Kerbl23]
LEAST_ALPHA = 1 / 255
NEAR = 0.05
HARMONIC = 0.28209479177387814


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
