"""Breaks of own data, and what `semfield inspect` says of them: the step `drill` of scripts/release_check, and the test
of that name."""
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

from checks import common

OPENGL = [1, -1, -1, 1]  # what the columns of a pose with OpenCV's camera axes are multiplied by for OpenGL's
KINDS = {"transforms_json": OPENGL, "replica": [1, 1, 1, 1]}  # axes of each format of the shipped room


class Scene:
    """One format of the shipped room in a folder of its own. Poses are OpenCV camera-to-world."""

    def __init__(self, source, folder, kind="transforms_json"):
        self.source, self.folder, self.kind, self.axes = source, folder, kind, KINDS[kind]
        self.config = folder.with_suffix(".yaml")
        shutil.copytree(source, folder)
        self.poses = np.loadtxt(folder / "traj_w_c.txt").reshape(-1, 4, 4)
        self.lens = np.loadtxt(folder / "intrinsics.txt")[:6]
        self.width, self.height = map(int, self.lens[:2])
        self.label_pattern = folder / "semantic_class" / "semantic_class_%d.png"
        self.restore()

    def image(self, i, ending=".png"):
        return self.folder / "rgb" / f"rgb_{i}{ending}"

    def restore(self):
        shutil.copytree(self.source, self.folder, dirs_exist_ok=True)
        self.label_key, self.image_ending, self.settings = "label_path", ".png", ""
        self.intrinsics = {"camera_angle_x": math.pi / 2}
        self.write()

    def write(self, poses=None):
        """The index and the configuration. Poses have the format's axes, or are places and quaternions x, y, z, w."""
        poses = self.poses * self.axes if poses is None else poses
        if self.kind == "replica":
            np.savetxt(self.folder / "traj_w_c.txt", poses.reshape(len(poses), -1), fmt="%.17g")
        else:
            frames = [{"file_path": f"rgb/rgb_{i}{self.image_ending}", "depth_path": f"depth/depth_{i}.png",
                       self.label_key: f"semantic_class/semantic_class_{i}.png",
                       **({"transform_matrix": pose} if len(pose) == 4 else
                          {"translation": pose[:3], "rotation": pose[6:] + pose[3:6]})}
                      for i, pose in enumerate(poses.tolist())]
            index = {**self.intrinsics, "depth_unit_m": 0.001, "classes": "classes.yaml", "frames": frames}
            (self.folder / "transforms.json").write_text(json.dumps(index, indent=1))
        preset = common.ROOT / "configs" / "presets" / "room.yaml"
        self.config.write_text(f"include: {json.dumps(str(preset))}\nscene:\n  type: {self.kind}\n"
                               f"  root: {json.dumps(str(self.folder))}\n{self.settings}")

    def pictures(self, pattern, pixels, channels):
        raw = np.frombuffer(common.read_pictures(pattern, pixels), np.uint8)
        return raw.reshape(-1, self.height, self.width, channels).copy()

    def labels(self):
        return self.pictures(self.label_pattern, "gray", 1)[..., 0]

    def write_labels(self, labels, pixels="gray"):
        height, width = labels.shape[1:3]
        common.write_pictures(self.label_pattern, labels.astype(np.uint8).tobytes(), width, height, pixels)


def missing_image(scene):
    for i in (3, 5):
        scene.image(i).unlink()


def misnamed_key(scene):
    if scene.kind == "replica":
        scene.settings = "  lable_dir: semantic_class\n"
    scene.label_key = "label"
    scene.write()


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


def quaternions(scene):
    scene.write(np.array([[*pose[:3, 3], 0, 0, 0, 1] for pose in scene.poses]))


def one_frame(scene):
    scene.write(scene.poses[:1] * scene.axes)
    for i in range(1, len(scene.poses)):
        scene.image(i).unlink()


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


def rename_key(scene, line):
    wrong, right = re.search(r"unknown key '(\w+)'; did you mean '(\w+)'\?", line).groups()
    scene.settings = scene.settings.replace(wrong, right)
    scene.write()


def state_size(scene, line):
    assert "state the size that they belong to" in line, line
    scene.intrinsics.update(w=2 * scene.intrinsics["cx"], h=2 * scene.intrinsics["cy"])
    scene.write()


# Name, what breaks the scene, what a line has to say; and where the remedy is no setting, what is done, or what the
# line has to say before the data are put right.
BREAKS = [
    ("missing image", missing_image, r"colour image '.*' is missing", None),
    ("misnamed key", misnamed_key, r"key '(label|lable_dir)'.*'label_(path|dir)'", rename_key),
    ("OpenGL axes", lambda scene: scene.write(scene.poses * scene.axes * OPENGL), r"OpenGL|OpenCV", None),
    ("inverse poses", lambda scene: scene.write(np.linalg.inv(scene.poses * scene.axes)), r"world-to-camera", None),
    ("millimetres", millimetres, r"millimetres", None),
    ("other label size", lambda scene: scene.write_labels(scene.labels()[:, ::2, ::2]),
     r"label image '.*' is \d+ x \d+ pixels, the camera \d+ x \d+", None),
    ("RGB labels", rgb_labels, r"label image '.*' has 3 channels: it is a picture in colours", None),
    ("unknown ids", unknown_ids, r"label ids 207 .*213 .* are not in the class table", None),
    ("quaternions", quaternions, r"quaternion", "camera-to-world matri"),
    ("black labels", lambda scene: scene.write_labels(0 * scene.labels()), r"void in every pixel", None),
    ("one frame", one_frame, r"the only frame of the scene", "give two frames at least"),
    ("misnamed extension", misnamed_extension, r"'.*\.png' is missing, but there is '.*\.jpg'", rename_files),
]
# Of the format that states its intrinsics.
BREAKS_OF_INTRINSICS = [
    ("intrinsics of a larger image", intrinsics_of_larger_images, r"the middle of an image 2 times as large",
     state_size),
    ("images turned by EXIF", turned_images, r"turned as the file's EXIF orientation says",
     r"EXIF orientation says \(8\).*mogrify -auto-orient"),
    ("a lens that is not known", unknown_lens, r"camera model 'FISHEYE624' is not supported", "undistort the images"),
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
    if not settings and by_hand is None:
        return False, ["the line names no setting"]
    if not settings and isinstance(by_hand, str):
        assert re.search(by_hand, line), line
        scene.restore()
    elif not settings:
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


def shipped_room(program, out, frames, test_frames, width):
    size = {"frames": frames, "test_frames": test_frames, "width_px": width, "height_px": width * 3 // 4}
    common.run(program, "pack", common.QUICKSTART, "--format", "replica", "--out", out, "--quiet",
               *(f"--set=scene.{key}={value}" for key, value in size.items()))


def drill(*, program: "of the check" = common.BUILD / "bin" / "semfield", quick: "fewer and smaller frames" = False,
          keep=None):
    """Breaks own data in twelve ways in each of two formats, and in three of one, and looks at what `semfield inspect`
says. A break counts as named when one line says what it is, its remedy as right when doing what that line says - a
setting, a renamed file or key - makes inspect pass."""
    program, counts = program.resolve(), collections.Counter()
    with common.work_folder(keep) as folder:
        shipped_room(program, folder / "room", 24 if quick else 60, 0, 80 if quick else 160)
        for kind in KINDS:
            code, problems, lines = inspect(program, Scene(folder / "room", folder / f"{kind}_sound", kind))
            if code != 0 or problems:
                raise common.Failed(f"{kind}: refused before anything is broken:\n" + "\n".join(lines))
            for name, *how in BREAKS + (BREAKS_OF_INTRINSICS if kind == "transforms_json" else []):
                scene = Scene(folder / "room", folder / f"{kind}_{name.replace(' ', '_')}", kind)
                counts.update(play(program, scene, name, *how))
    return counts
