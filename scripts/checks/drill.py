"""Breaks of own data. The scene is the shipped room in two formats."""
import collections
import json
import math
import pathlib
import re
import shlex
import shutil
import struct
import subprocess

import numpy as np

from . import common

OPENGL = [1, -1, -1, 1]  # what the columns of a pose with OpenCV's camera axes are multiplied by for OpenGL's


def quaternion(pose):
    """x, y, z, w of a rotation: the eigenvector of the eigenvalue 1 of this matrix [Bar-Itzhack 2000]."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose[:3, :3]
    matrix = np.array([[xx - yy - zz, xy + yx, xz + zx, zy - yz], [xy + yx, yy - xx - zz, yz + zy, xz - zx],
                       [xz + zx, yz + zy, zz - xx - yy, yx - xy], [zy - yz, xz - zx, yx - xy, xx + yy + zz]])
    return np.linalg.eigh(matrix)[1][:, -1].tolist()


class Scene:
    """One format of the room in a folder of its own. Poses are OpenCV camera-to-world."""

    def __init__(self, source, folder):
        self.source, self.folder, self.config = source, folder, folder.with_suffix(".yaml")
        shutil.copytree(source, folder)
        self.poses = np.loadtxt(folder / "traj_w_c.txt").reshape(-1, 4, 4)
        self.width, self.height = map(int, (folder / "intrinsics.txt").read_text().split()[:2])
        self.label_pattern = folder / "semantic_class" / "semantic_class_%d.png"
        self.write()

    def image(self, i, ending=".png"):
        return self.folder / "rgb" / f"rgb_{i}{ending}"

    def restore(self):
        shutil.copytree(self.source / "rgb", self.folder / "rgb", dirs_exist_ok=True)
        self.write()

    def pictures(self, pattern, pixels, channels):
        raw = np.frombuffer(common.read_pictures(pattern, pixels), np.uint8)
        return raw.reshape(-1, self.height, self.width, channels).copy()

    def labels(self):
        return self.pictures(self.label_pattern, "gray", 1)[..., 0]

    def write_labels(self, labels, pixels="gray"):
        height, width = labels.shape[1:3]
        common.write_pictures(self.label_pattern, labels.astype(np.uint8).tobytes(), width, height, pixels)

    def write_config(self, more=""):
        preset = common.ROOT / "configs" / "presets" / "room.yaml"
        self.config.write_text(f"include: {json.dumps(str(preset))}\nscene:\n  type: {self.kind}\n"
                               f"  root: {json.dumps(str(self.folder))}\n{more}")


class Replica(Scene):
    kind = "replica"
    axes = [1, 1, 1, 1]
    label_setting = ""

    def write_rows(self, rows):
        np.savetxt(self.folder / "traj_w_c.txt", rows, fmt="%.17g")
        self.write_config(self.label_setting)

    def write(self, poses=None):
        self.write_rows((self.poses if poses is None else poses).reshape(-1, 16))

    def write_one(self):
        self.write(self.poses[:1])
        for i in range(1, len(self.poses)):
            self.image(i).unlink()

    def write_quaternions(self):
        self.write_rows([pose[:3, 3].tolist() + quaternion(pose) for pose in self.poses])

    def misname_key(self):
        self.label_setting = "  lable_dir: semantic_class\n"
        self.write()

    def rename_key(self, line):
        wrong, right = re.search(r"unknown key '(\w+)'; did you mean '(\w+)'\?", line).groups()
        self.label_setting = self.label_setting.replace(wrong, right)
        self.write()


class TransformsJson(Scene):
    kind = "transforms_json"
    axes = OPENGL
    label_key, image_ending = "label_path", ".png"
    intrinsics = {"camera_angle_x": math.pi / 2}

    def write_frames(self, places):
        frames = [{"file_path": f"rgb/rgb_{i}{self.image_ending}", "depth_path": f"depth/depth_{i}.png",
                   self.label_key: f"semantic_class/semantic_class_{i}.png", **place} for i, place in enumerate(places)]
        index = {**self.intrinsics, "depth_unit_m": 0.001, "frames": frames}
        (self.folder / "transforms.json").write_text(json.dumps(index, indent=1))
        self.write_config()

    def write(self, poses=None):
        poses = self.poses * OPENGL if poses is None else poses
        self.write_frames([{"transform_matrix": pose.tolist()} for pose in poses])

    def write_one(self):
        self.write(self.poses[:1] * OPENGL)

    def write_quaternions(self):
        self.write_frames({"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}
                          for pose in self.poses for x, y, z, w in [quaternion(pose)])

    def misname_key(self):
        self.label_key = "label"
        self.write()

    def rename_key(self, line):
        raise AssertionError("the remedy is a setting")


def missing_image(scene):
    for i in (3, 5):
        scene.image(i).unlink()


def millimetres(scene):
    poses = scene.poses * scene.axes
    poses[:, :3, 3] *= 1000
    scene.write(poses)


def rgb_labels(scene):
    table = re.findall(r"id: (\d+),.*color: \[(\d+), (\d+), (\d+)\]", (scene.folder / "classes.yaml").read_text())
    colors = np.zeros((256, 3))
    for i, *color in table:
        colors[int(i)] = [int(v) for v in color]
    scene.write_labels(colors[scene.labels()], "rgb24")


def unknown_ids(scene):
    labels = scene.labels()
    labels[:, 0, :2] = 213, 207
    scene.write_labels(labels)


def misnamed_extension(scene):
    for i in range(len(scene.poses)):
        scene.image(i).rename(scene.image(i, ".jpg"))


def intrinsics_of_larger_images(scene):
    scene.intrinsics = {"fl_x": scene.width, "fl_y": scene.width, "cx": scene.width, "cy": scene.height}
    scene.write()


def turned_images(scene):
    """Held upright, as the EXIF orientation says, and stored lying."""
    w, h = scene.width, scene.height
    scene.intrinsics = {"fl_x": w / 2, "fl_y": w / 2, "cx": w / 2, "cy": h / 2, "w": w, "h": h}
    scene.image_ending = ".jpg"
    scene.write()
    lying = np.rot90(scene.pictures(scene.image("%d"), "rgb24", 3), -1, (1, 2))
    common.write_pictures(scene.image("%d", ".jpg"), lying.tobytes(), h, w, "rgb24")
    # One entry: the orientation, a short, is 8.
    exif = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x112, 3, 1, 8, 0, 0)
    for i in range(len(scene.poses)):
        data = scene.image(i, ".jpg").read_bytes()
        scene.image(i, ".jpg").write_bytes(data[:2] + struct.pack(">2sH", b"\xff\xe1", len(exif) + 2) + exif + data[2:])
        scene.image(i).unlink()


def unknown_lens(scene):
    scene.intrinsics = {**scene.intrinsics, "camera_model": "FISHEYE624"}
    scene.write()


# What is done where the remedy is no setting: what the line says, and nothing else.
def rename_files(scene, line):
    right, wrong = re.search(r"image '(.*?)' is missing, but there is '(.*?)'; rename it", line).groups()
    for i in range(len(scene.poses)):
        scene.image(i, pathlib.Path(wrong).suffix).rename(scene.image(i, pathlib.Path(right).suffix))


def matrices_again(scene, line):
    assert "camera-to-world matri" in line, line
    scene.write()


def frames_again(scene, line):
    assert "give two frames at least" in line, line
    scene.restore()


def state_size(scene, line):
    assert "state the size that they belong to" in line, line
    scene.intrinsics.update(w=2 * scene.intrinsics["cx"], h=2 * scene.intrinsics["cy"])
    scene.write()


def turn_back(scene, line):
    assert "EXIF orientation says (8)" in line and "mogrify -auto-orient" in line, line
    scene.image_ending = ".png"
    scene.restore()


def undistorted(scene, line):
    assert "undistort the images" in line, line
    del scene.intrinsics["camera_model"]
    scene.write()


# Name, what breaks the scene, what a line has to say, and what is done where the remedy is no setting.
BREAKS = [
    ("missing image", missing_image, r"colour image '.*' is missing", None),
    ("misnamed key", lambda scene: scene.misname_key(), r"key '(label|lable_dir)'.*'label_(path|dir)'",
     lambda scene, line: scene.rename_key(line)),
    ("OpenGL axes", lambda scene: scene.write(scene.poses * scene.axes * OPENGL), r"OpenGL|OpenCV", None),
    ("inverse poses", lambda scene: scene.write(np.linalg.inv(scene.poses * scene.axes)), r"world-to-camera", None),
    ("millimetres", millimetres, r"millimetres", None),
    ("other label size", lambda scene: scene.write_labels(scene.labels()[:, ::2, ::2]),
     r"label image '.*' is \d+ x \d+ pixels, the camera \d+ x \d+", None),
    ("RGB labels", rgb_labels, r"label image '.*' has 3 channels: it is a picture in colours", None),
    ("unknown ids", unknown_ids, r"label ids 207 .*213 .* are not in the class table", None),
    ("quaternions", lambda scene: scene.write_quaternions(), r"quaternion", matrices_again),
    ("black labels", lambda scene: scene.write_labels(0 * scene.labels()), r"void in every pixel", None),
    ("one frame", lambda scene: scene.write_one(), r"the only frame of the scene", frames_again),
    ("misnamed extension", misnamed_extension, r"'.*\.png' is missing, but there is '.*\.jpg'", rename_files),
]
# Of the format that states its intrinsics.
BREAKS_OF_INTRINSICS = [
    ("intrinsics of a larger image", intrinsics_of_larger_images, r"the middle of an image 2 times as large",
     state_size),
    ("images turned by EXIF", turned_images, r"turned as the file's EXIF orientation says", turn_back),
    ("a lens that is not known", unknown_lens, r"camera model 'FISHEYE624' is not supported", undistorted),
]


def inspect(program, scene, settings=()):
    """Exit code of `semfield inspect`, its errors and warnings, and all that it prints."""
    words = [program, "inspect", scene.config, *(word for value in settings for word in ("--set", value))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    lines = (done.stdout + done.stderr).splitlines()
    return done.returncode, [line for line in lines if re.match(r"(error|warning|semfield:|\S+:\d+:\d+:)", line)], lines


def remedied(program, scene, line, by_hand):
    """Does what the line says; whether inspect then passes, and what it said."""
    # Shell words: quoted texts, in which an apostrophe is '\'', or anything without spaces.
    settings = [shlex.split(word)[0] for word in re.findall(r"--set ((?:'[^']*'|\\'|[^\s'])+)", line)]
    if not settings:
        if by_hand is None:
            return False, ["the line names no setting"]
        by_hand(scene, line)
    code, problems, lines = inspect(program, scene, settings)
    print(f"  remedy: {shlex.join(settings) or 'by hand'} -> inspect ends with {code}")
    return code == 0 and not any(problem.startswith("error") for problem in problems), lines


def play(program, scene, name, spoil, named_by, by_hand):
    """Counts of a break: whether it was named, whether the remedy is right, lines said twice."""
    spoil(scene)
    code, problems, lines = inspect(program, scene)
    print(f"\n{scene.kind}, {name}: inspect ends with {code}\n  " + "\n  ".join(problems))
    naming = [line for line in problems if re.search(named_by, line)]
    named = code != 0 and len(naming) > 0
    right, said = remedied(program, scene, naming[0], by_hand) if named else (False, lines)
    if not right:
        print(f"  {'THE REMEDY DOES NOT HELP' if named else 'NOT NAMED'}; inspect said:\n    " + "\n    ".join(said))
    repeated = sum(n - 1 for line, n in collections.Counter(filter(None, lines)).items())
    return {"breaks": 1, "named": named, "right_remedy": right, "repeated_lines": repeated}


def drill(words):
    """Breaks own data in twelve ways in each of two formats, and in three of one, and looks at what `semfield inspect`
says.

A break counts as named when one line says what it is, its remedy as right when doing what that line says - a setting,
a renamed file or key - makes inspect pass. The last line is `drill: breaks=... named=... right_remedy=...
repeated_lines=...`."""
    parser = common.parser_of(drill)
    parser.add_argument("--program", type=pathlib.Path, default=common.BUILD / "bin" / "semfield", metavar="FILE")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller frames")
    parser.add_argument("--keep", metavar="FOLDER", help="leave the scenes there")
    options = parser.parse_args(words)
    program, counts = options.program.resolve(), collections.Counter()
    frames, width = (24, 80) if options.quick else (60, 160)
    with common.work_folder(options.keep) as folder:
        sizes = {"frames": frames, "test_frames": 0, "width_px": width, "height_px": width * 3 // 4}
        common.run(program, "capture", common.QUICKSTART, "--out", folder / "room",
                   *(f"--set=scene.{key}={value}" for key, value in sizes.items()))
        for kind in (TransformsJson, Replica):
            code, problems, lines = inspect(program, kind(folder / "room", folder / f"{kind.kind}_sound"))
            if code != 0 or problems:
                raise common.Failed(f"{kind.kind}: refused before anything is broken:\n" + "\n".join(lines))
            for name, *how in BREAKS + (BREAKS_OF_INTRINSICS if kind is TransformsJson else []):
                scene = kind(folder / "room", folder / f"{kind.kind}_{name.replace(' ', '_')}")
                counts.update(play(program, scene, name, *how))
    common.print_line("drill", counts, dict.fromkeys(("breaks", "named", "right_remedy", "repeated_lines"), "d"))
    played = 2 * len(BREAKS) + len(BREAKS_OF_INTRINSICS)
    good = counts["breaks"] == counts["named"] == counts["right_remedy"] == played and counts["repeated_lines"] == 0
    return 0 if good else 1
