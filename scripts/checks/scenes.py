"""What `semfield prepare` finds from photographs alone, and what it makes of cameras that are wrong."""
import json
import math
import pathlib
import random
import shutil
import struct
import subprocess
import sys
import time

import numpy as np

from . import common

sys.path.insert(1, str(common.ROOT / "tests" / "scripts"))
from broken_scenes import OPENGL, Scene, drill, shipped_room  # noqa: E402, F401

PHOTOGRAPHS = {"studio": "studio_room", "bonsai": "bonsai360"}
MOST_PHOTOGRAPHS, KILLED_PHOTOGRAPHS = 80, 12
WRONG_DEG, WRONG_SHARE = 5, 0.05


def rotations(quaternions):
    """[n, 3, 3] of w, x, y, z of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                     2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)


def turn(axis, degrees):
    """The rotation about an axis of any length."""
    half = math.radians(degrees) / 2
    return rotations(np.array([[math.cos(half), *(math.sin(half) * np.asarray(axis) / np.linalg.norm(axis))]]))[0]


def given_poses(folder):
    """Of the file of each photograph: camera to world with OpenCV axes."""
    frames = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]
    return {frame["file_path"]: np.array(frame["transform_matrix"]) * OPENGL for frame in frames}


def found_poses(path):
    """The same of COLMAP's images.bin."""
    data, at, out = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from("<I7dI", data, at)
        name = data[at + 64:data.index(b"\0", at + 64)]
        points, = struct.unpack_from("<Q", data, at + 65 + len(name))
        at += 73 + len(name) + 24 * points
        pose = np.eye(4)
        pose[:3, :3] = rotations(np.array([values[1:5]]))[0].T
        pose[:3, 3] = -pose[:3, :3] @ values[5:8]
        out[name.decode()] = pose
    return out


def similarity(of, to):
    """Scale, rotation and shift for which `to` = scale rotation of + shift, by least squares [Umeyama91]."""
    a, b = of.mean(0), to.mean(0)
    u, values, vt = np.linalg.svd((to - b).T @ (of - a))
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u * signs @ vt
    scale = (values * signs).sum() / ((of - a) ** 2).sum()
    return scale, rotation, b - scale * rotation @ a


def pose_errors(found, given):
    """Degrees, and shares of the extent, of the photographs that have a pose. One at a wrong place would turn all
    others with it: those off by five times the median take no part in laying the poses over each other, and count."""
    of, to = (np.array([poses[name] for name in sorted(found)]) for poses in (found, given))
    fitted = np.full(len(of), True)
    for _ in range(10):
        scale, rotation, shift = similarity(of[fitted, :3, 3], to[fitted, :3, 3])
        off = np.linalg.norm(scale * of[:, :3, 3] @ rotation.T + shift - to[:, :3, 3], axis=1)
        fitted = off <= 5 * np.sort(off)[len(off) // 2]
    turns = rotation @ of[:, :3, :3] @ to[:, :3, :3].transpose(0, 2, 1)
    # The sine keeps small angles that the cosine's rounding loses.
    sine = 0.5 * np.linalg.norm([turns[:, i, j] - turns[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=0)
    degrees = np.degrees(np.arctan2(sine, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1)))
    return degrees, off / np.linalg.norm(np.ptp([pose[:3, 3] for pose in given.values()], axis=0))


def fresh(folder):
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def photographs_of(scene, names, out):
    fresh(out).mkdir()
    for file in names:
        shutil.copy(scene / file, out)
    return out


def prepare_alone(program, source, folder, short, figures):
    """Figures of a scene's photographs without their poses."""
    out, given = fresh(folder / f"{short}_scene"), given_poses(source)
    figures[f"{short}_registered"] = 0
    names = sorted(given)[::math.ceil(len(given) / MOST_PHOTOGRAPHS)]
    photographs, begin = photographs_of(source, names, folder / f"{short}_photographs"), time.monotonic()
    found = common.ask(program, "prepare", photographs, "--out", out)
    seconds = time.monotonic() - begin
    degrees, shares = pose_errors(found_poses(out / "sparse" / "0" / "images.bin"),
                                  {pathlib.Path(name).name: given[name] for name in names})
    wrong = np.count_nonzero((degrees > WRONG_DEG) | (shares > WRONG_SHARE))
    spread = lambda of: f"{of.mean():.3f} (median {np.sort(of)[len(of) // 2]:.3f}, at most {of.max():.3f})"
    print(f"{source.name}: {found['registered']} of {found['photographs']} registered in {seconds:.0f} s and "
          f"{found['attempts']} attempts, reprojection {found['error_px']:.2f} px; {spread(degrees)} degrees, "
          f"{spread(100 * shares)} % of the extent; {wrong} photographs at a wrong place", flush=True)
    figures[f"{short}_registered"] = found["registered"] / found["photographs"]
    for key, values in (("pose_error_deg", degrees), ("pose_error_share", shares)):
        figures[key] = max(figures.get(key, 0), values.mean())


def prepare_killed(program, source, folder, figures):
    if not source.is_dir():
        raise common.Failed(f"killed_lost: there is no {source.name} in the folder")
    photographs = photographs_of(source, sorted(given_poses(source))[:KILLED_PHOTOGRAPHS], folder / "few_photographs")
    whole, ended = fresh(folder / "few_scene"), fresh(folder / "killed_scene")
    registered = common.ask(program, "prepare", photographs, "--out", whole)["registered"]
    running = subprocess.Popen([program, "prepare", photographs, "--out", ended, "--quiet"],
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while running.poll() is None and not (ended / "prepare" / "log" / "matches_quick.txt").exists():
        time.sleep(0.05)
    running.kill()
    running.wait()
    if (ended / "sparse").exists():
        raise common.Failed("killed_lost: prepare ended before it could be killed")
    again = common.ask(program, "prepare", photographs, "--out", ended)["registered"]
    common.say(f"prepare registered {registered} of {KILLED_PHOTOGRAPHS}, and {again} after it was killed")
    figures["killed_lost"] = max(0, registered - again)


def capture(folder: "of the scenes", *, scenes: "some of them" = tuple(PHOTOGRAPHS.values()), build=common.BUILD,
            keep=None):
    """Measures what `semfield prepare` finds from photographs alone. FOLDER holds studio_room and bonsai360,
each with a transforms.json of poses and their photographs, of which at most 80 are copied without their poses and
prepared; the poses found are laid over the given ones by a similarity of least squares and compared.

*_registered is the share of photographs that got a pose. pose_error_* are means over a scene's photographs, of the
worst scene: the angle of a camera, and the distance of its centre as a share of the diagonal of the box of all given
centres. killed_lost counts photographs of studio_room that lose their pose when `prepare` is killed while it matches
and called again."""
    program, figures = build.resolve() / "bin" / "semfield", {}
    with common.work_folder(keep) as work:
        for short, name in PHOTOGRAPHS.items():
            if name in scenes:
                common.attempt(lambda: prepare_alone(program, folder / name, work, short, figures))
        common.attempt(lambda: prepare_killed(program, folder / PHOTOGRAPHS["studio"], work, figures))
    return figures


DEPTH_SHIFT_M, DEPTH_TURN_DEG = 0.024, 0.9


def shaken(poses):
    """Every pose turned and shifted by the noise, about and along random axes."""
    draw, out = random.Random(1), poses.copy()
    for pose in out:
        axis, shift = (np.array([draw.gauss(0, 1) for _ in range(3)]) for _ in range(2))
        pose[:3, :3] = pose[:3, :3] @ turn(axis, 1)
        pose[:3, 3] += 0.02 * shift / np.linalg.norm(shift)
    return out


def move_depth(scene):
    """Depth as a camera next to the colours' sees it, with the colours' lens: nearest points by z."""
    w, h = scene.width, scene.height
    fx, fy, cx, cy = scene.lens[2:]
    rotation = turn((0.2, 1, 0.1), DEPTH_TURN_DEG)
    # Every pixel as 2 x 2 points, so that no gaps open.
    v, u = (np.mgrid[0:2 * h, 0:2 * w] + 0.5) / 2
    for path in (scene.folder / "depth").iterdir():
        z = np.frombuffer(common.read_pictures(path, "gray16le"), "<u2").reshape(h, w) / 1000
        z = np.kron(z, np.ones((2, 2)))
        p = np.stack([(u - 0.5 - cx) / fx * z, (v - 0.5 - cy) / fy * z, z], -1) @ rotation.T + [DEPTH_SHIFT_M, 0, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (np.rint(p[..., k] / p[..., 2] * f + c) for k, f, c in ((0, fx, cx), (1, fy, cy)))
        seen = (x >= 0) & (y >= 0) & (x < w) & (y < h) & (z > 0)
        far = np.full(h * w, np.inf)
        np.minimum.at(far, (y * w + x)[seen].astype(int), p[..., 2][seen])
        far[~np.isfinite(far)] = 0
        common.write_pictures(path, np.rint(1000 * far).astype("<u2").tobytes(), w, h, "gray16le")


# What is wrong with poses, and with the lens: width, height, focal lengths, centre.
WRONG_POSES = {"noise": shaken, "delay": lambda poses: np.concatenate([poses[1:], poses[-1:]]),
               "axes": lambda poses: poses * OPENGL}
WRONG_LENS = {"focal": lambda lens: lens * [1, 1, 1.1, 1.1, 1, 1], "centre": lambda lens: lens + [0, 0, 0, 0, 30, 0]}
WRONG = ("noise", "focal", "centre", "delay", "axes", "depth_camera")
RIGHT = ("studio_room", "bonsai360", "fern", "lego", "replica_apartment0")
# Of each real scene its name, settings of its trainings, and figures by keys of their scores.
REAL = {
    "kitchen": ("kinect_kitchen", (), {"kitchen_mended_db": "psnr", "kitchen_absrel": "absrel"}),
    "hololens": ("hololens_room", (), {"hololens_colors_db": "psnr_fitted_colors"}),
    "door": ("record3d_door", ("--set", "scene.load.downscale=4"), {"door_db": "psnr"}),
}


class Cameras:
    """Scenes and runs in a folder; `figures` are those of the last line."""

    def __init__(self, program, folder, work, gpu):
        self.program, self.folder, self.work, self.figures = program, folder, work, {}
        self.device = ("--set", "runtime.device=cuda") if gpu else ()

    def room(self, wrong=None):
        """The room at 640 x 480, whose index states the cameras, wrong in one way of WRONG."""
        if not (self.work / "room").is_dir():
            shipped_room(self.program, self.work / "room", 104, 8, 640)
        scene = Scene(self.work / "room", fresh(self.work / (wrong or "right")))
        for name in ("traj_w_c.txt", "intrinsics.txt"):
            (scene.folder / name).unlink()
        if wrong == "depth_camera":
            move_depth(scene)
        lens = WRONG_LENS.get(wrong, lambda lens: lens)(scene.lens)
        names = ("w", "h", "fl_x", "fl_y", "cx", "cy")
        scene.intrinsics = dict(zip(names, [scene.width, scene.height, *lens[2:].tolist()]))
        scene.write(WRONG_POSES.get(wrong, lambda poses: poses)(scene.poses) * scene.axes)
        return scene.folder

    def fixed(self, scene):
        """The scene that `prepare` makes of one with poses, and how many minutes it took."""
        out, begin = fresh(self.work / f"{scene.name}_fixed"), time.monotonic()
        found = common.ask(self.program, "prepare", scene, "--out", out)
        minutes = (time.monotonic() - begin) / 60
        common.say(f"{out.name}: {found['given_px']:.2f} -> {found['fixed_px']:.2f} pixels, kept {found['kept']}, "
                   f"{'; '.join(found['changes'])}, {minutes:.1f} min")
        return out, minutes

    def trained(self, scene, *training):
        """Scores of a field of the scene."""
        config, run = self.work / f"{scene.name}.yaml", fresh(self.work / f"{scene.name}_run")
        common.run(self.program, "init", scene, "--out", config, "--replace", "--quiet")
        common.run(self.program, "train", config, "--out", run, "--quiet", *self.device, *training)
        found = common.ask(self.program, "eval", run, "--fit-colors")
        shown = [f"{key} {value:.4g}" for key, value in found.items() if isinstance(value, float)]
        common.say(f"{scene.name}: " + ", ".join(shown))
        return found

    def modelled(self, steps):
        size = ("--steps", steps, "--set", "scene.load.downscale=4", "--set", "train.cameras.poses=given")
        right = self.trained(self.room(), *size)
        for name, key in ((None, "right"), ("noise", "noise"), ("focal", "focal"), ("depth_camera", "depthcam")):
            found = self.trained(self.fixed(self.room(name))[0], *size)
            self.figures[f"{key}_psnr_loss"] = right["psnr"] - found["psnr"]
            if name == "noise":
                self.figures["noise_miou_loss"] = right["miou_present"] - found["miou_present"]

    def real(self, part, seconds):
        name, settings, figures = REAL[part]
        if not (self.folder / name).is_dir():
            raise common.Failed(f"there is no {name} in the folder: its figures are n/a")
        training = ("--time", f"{seconds:g}", *settings)
        if part == "kitchen":
            self.figures["kitchen_given_db"] = self.trained(self.folder / name, *training)["psnr"]
        out, minutes = self.fixed(self.folder / name)
        if part == "kitchen":
            self.figures["minutes"] = minutes
        found = self.trained(out, *training)
        self.figures.update({figure: found[key] for figure, key in figures.items()})

    def is_right(self, scene):
        """Whether `inspect` finds no fault with the cameras."""
        try:
            found = common.ask(self.program, "inspect", scene)
        except common.Failed:
            return False
        return found["cameras_fit"] is not False and "do not agree" not in found["geometry"]

    def inspect(self):
        right = [self.room(), *filter(pathlib.Path.is_dir, (self.folder / name for name in RIGHT))]
        missed = [name for name in WRONG if self.is_right(self.room(name))]
        false = [scene.name for scene in right if not self.is_right(scene)]
        common.say(f"inspect missed {missed}, was wrong about {false}")
        self.figures.update(inspect_named=f"{len(WRONG) - len(missed)}/{len(WRONG)}", inspect_false=len(false))


def cameras(folder: "of the scenes", *, parts: "some of them" = ("inspect", "modelled", *REAL),
            steps: "of trainings of the shipped room" = 2000, seconds: "of trainings of real rooms" = 60.0,
            gpu: "train on the first GPU" = False, build=common.BUILD, keep=None):
    """Measures what `semfield prepare SCENE` makes of scenes whose cameras are wrong. FOLDER may hold kinect_kitchen,
hololens_room and record3d_door; the shipped room at 640 x 480 is made wrong here, in six ways: all poses off by 1
degree and 2 cm, focal lengths by 10 %, the centre by 30 pixels, a delay of a frame, axes, and depth of a camera 24 mm
and 0.9 degrees away. `inspect` has to name all six, and neither the room nor the scenes of FOLDER that are right.

Losses are of the room after `prepare` against the room with its true cameras, at 160 x 120; right: nothing is wrong."""
    with common.work_folder(keep) as work:
        check = Cameras(build.resolve() / "bin" / "semfield", folder.resolve(), work, gpu)
        of_part = {"inspect": check.inspect, "modelled": lambda: check.modelled(steps)}
        common.attempt(*(of_part.get(part) or (lambda part=part: check.real(part, seconds)) for part in parts))
    return check.figures
