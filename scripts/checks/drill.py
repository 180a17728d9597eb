"""Breaks of own data. The scene is the shipped room in two formats; pictures are read and written by ffmpeg."""
import collections
import json
import math
import pathlib
import re
import shlex
import shutil
import struct
import subprocess

from . import common


def other_axes(pose):
    """OpenCV to OpenGL camera axes, and back."""
    return [[row[0], -row[1], -row[2], row[3]] for row in pose[:3]] + [pose[3]]


def inverse(pose):
    turn = [[pose[c][r] for c in range(3)] for r in range(3)]
    return [row + [-sum(row[c] * pose[c][3] for c in range(3))] for row in turn] + [pose[3]]


def thousandfold(pose):
    return [row[:3] + [1000 * row[3]] for row in pose[:3]] + [pose[3]]


def quaternion(r):
    """x, y, z, w of a rotation, by its largest component [Shepperd 1978]."""
    squares = [1 + r[0][0] - r[1][1] - r[2][2], 1 - r[0][0] + r[1][1] - r[2][2], 1 - r[0][0] - r[1][1] + r[2][2],
               1 + r[0][0] + r[1][1] + r[2][2]]
    i = max(range(4), key=squares.__getitem__)
    s = 2 * math.sqrt(squares[i])
    if i == 3:
        return [(r[2][1] - r[1][2]) / s, (r[0][2] - r[2][0]) / s, (r[1][0] - r[0][1]) / s, s / 4]
    j, k = (i + 1) % 3, (i + 2) % 3
    out = [0, 0, 0, (r[k][j] - r[j][k]) / s]
    out[i], out[j], out[k] = s / 4, (r[j][i] + r[i][j]) / s, (r[k][i] + r[i][k]) / s
    return out


class Scene:
    """One format of the room in a folder of its own. Poses are OpenCV camera-to-world until they are written."""

    def __init__(self, source, folder):
        self.source, self.folder, self.config = source, folder, folder.with_suffix(".yaml")
        shutil.copytree(source, folder)
        rows = [[float(word) for word in line.split()] for line in (folder / "traj_w_c.txt").read_text().splitlines()]
        self.poses = [[row[4 * i:4 * i + 4] for i in range(4)] for row in rows]
        self.width, self.height = map(int, (folder / "intrinsics.txt").read_text().split()[:2])
        self.label_pattern = folder / "semantic_class" / "semantic_class_%d.png"

    def image(self, i, ending=".png"):
        return self.folder / "rgb" / f"rgb_{i}{ending}"

    def restore(self):
        shutil.copytree(self.source / "rgb", self.folder / "rgb", dirs_exist_ok=True)

    def labels(self):
        return bytearray(common.read_pictures(self.label_pattern, "gray"))

    def write_labels(self, raw, pixels="gray", *filters):
        common.write_pictures(self.label_pattern, raw, self.width, self.height, pixels, *filters)

    def write_config(self, more=""):
        preset = common.ROOT / "configs" / "presets" / "room.yaml"
        self.config.write_text(f"include: {json.dumps(str(preset))}\nscene:\n  type: {self.kind}\n"
                               f"  root: {json.dumps(str(self.folder))}\n{more}")


class Replica(Scene):
    kind = "replica"
    label_setting = ""
    in_own_axes = staticmethod(lambda pose: pose)

    def write_rows(self, rows):
        (self.folder / "traj_w_c.txt").write_text("".join(" ".join(map(repr, row)) + "\n" for row in rows))
        self.write_config(self.label_setting)

    def write(self, poses=None, kept=None):
        self.write_rows(sum(pose, []) for pose in (poses or self.poses)[:kept])
        for i in range(kept or len(self.poses), len(self.poses)):
            self.image(i).unlink()

    def write_quaternions(self):
        self.write_rows([row[3] for row in pose[:3]] + quaternion(pose) for pose in self.poses)

    def misname_key(self):
        self.label_setting = "  lable_dir: semantic_class\n"
        self.write()

    def rename_key(self, line):
        wrong, right = re.search(r"unknown key '(\w+)'; did you mean '(\w+)'\?", line).groups()
        self.label_setting = self.label_setting.replace(wrong, right)
        self.write()


class TransformsJson(Scene):
    kind = "transforms_json"
    label_key, image_ending = "label_path", ".png"
    intrinsics = {"camera_angle_x": math.pi / 2}
    in_own_axes = staticmethod(other_axes)

    def write_frames(self, placed):
        frames = [{"file_path": f"rgb/rgb_{i}{self.image_ending}", "depth_path": f"depth/depth_{i}.png",
                   self.label_key: f"semantic_class/semantic_class_{i}.png", **place} for i, place in enumerate(placed)]
        index = {**self.intrinsics, "depth_unit_m": 0.001, "frames": frames}
        (self.folder / "transforms.json").write_text(json.dumps(index, indent=1))
        self.write_config()

    def write(self, poses=None, kept=None):
        """`poses` in the format's own OpenGL axes."""
        poses = poses or map(other_axes, self.poses)
        self.write_frames([{"transform_matrix": pose} for pose in poses][:kept])

    def write_quaternions(self):
        self.write_frames({"translation": [row[3] for row in pose[:3]], "rotation": [w, x, y, z]}
                          for pose in self.poses for x, y, z, w in [quaternion(pose)])

    def misname_key(self):
        self.label_key = "label"
        self.write()

    def rename_key(self, line):
        raise AssertionError("the remedy is a setting")


def missing_image(scene):
    scene.write()
    for i in (3, 5):
        scene.image(i).unlink()


def wrong_axes(scene):
    scene.write([other_axes(scene.in_own_axes(pose)) for pose in scene.poses])


def inverse_poses(scene):
    scene.write([inverse(scene.in_own_axes(pose)) for pose in scene.poses])


def millimetres(scene):
    scene.write([thousandfold(scene.in_own_axes(pose)) for pose in scene.poses])


def other_size(scene):
    scene.write()
    scene.write_labels(scene.labels(), "gray", "-vf", "scale=iw/2:ih/2:flags=neighbor")


def rgb_labels(scene):
    scene.write()
    table = re.findall(r"id: (\d+),.*color: \[(\d+), (\d+), (\d+)\]", (scene.folder / "classes.yaml").read_text())
    colors = {int(i): bytes(map(int, color)) for i, *color in table}
    scene.write_labels(b"".join(colors[i] for i in scene.labels()), "rgb24")


def unknown_ids(scene):
    scene.write()
    labels = scene.labels()
    for at in range(0, len(labels), scene.width * scene.height):
        labels[at:at + 2] = bytes([213, 207])
    scene.write_labels(labels)


def black_labels(scene):
    scene.write()
    scene.write_labels(bytes(len(scene.labels())))


def misnamed_extension(scene):
    scene.write()
    for i in range(len(scene.poses)):
        scene.image(i).rename(scene.image(i, ".jpg"))


# What is done where the remedy is no setting: what the line says, and nothing else.
def matrices_again(scene, line):
    assert "camera-to-world matri" in line, line
    scene.write()


def frames_again(scene, line):
    assert "give two frames at least" in line, line
    scene.restore()
    scene.write()


def rename_files(scene, line):
    right, wrong = re.search(r"image '(.*?)' is missing, but there is '(.*?)'; rename it", line).groups()
    for i in range(len(scene.poses)):
        scene.image(i, pathlib.Path(wrong).suffix).rename(scene.image(i, pathlib.Path(right).suffix))


def intrinsics_of_larger_images(scene):
    scene.intrinsics = {"fl_x": scene.width, "fl_y": scene.width, "cx": scene.width, "cy": scene.height}
    scene.write()


def state_size(scene, line):
    assert "is the middle of an image 2 times as large" in line and "state the size that they belong to" in line, line
    scene.intrinsics.update(w=2 * scene.intrinsics["cx"], h=2 * scene.intrinsics["cy"])
    scene.write()


def turned_images(scene):
    """Held upright, as the EXIF orientation says, and stored lying."""
    w, h = scene.width, scene.height
    scene.intrinsics = {"fl_x": w / 2, "fl_y": w / 2, "cx": w / 2, "cy": h / 2, "w": w, "h": h}
    scene.image_ending = ".jpg"
    scene.write()
    raw = common.read_pictures(scene.image("%d"), "rgb24")
    common.write_pictures(scene.image("%d", ".jpg"), raw, w, h, "rgb24", "-vf", "transpose=clock")
    entry = struct.pack("<HHHIHHI", 1, 0x112, 3, 1, 8, 0, 0)  # one entry: the orientation, a short, is 8
    exif = b"Exif\0\0II*\0\x08\0\0\0" + entry
    for i in range(len(scene.poses)):
        data = scene.image(i, ".jpg").read_bytes()
        scene.image(i, ".jpg").write_bytes(data[:2] + struct.pack(">2sH", b"\xff\xe1", len(exif) + 2) + exif + data[2:])
        scene.image(i).unlink()


def turn_back(scene, line):
    assert "EXIF orientation says (8)" in line and "mogrify -auto-orient" in line, line
    scene.restore()
    scene.image_ending = ".png"
    scene.write()


def unknown_lens(scene):
    scene.intrinsics = {**scene.intrinsics, "camera_model": "FISHEYE624"}
    scene.write()


def undistorted(scene, line):
    assert "undistort the images" in line, line
    del scene.intrinsics["camera_model"]
    scene.write()


# Name, what breaks the scene, what a line has to say, and what is done where the remedy is no setting.
BREAKS = [
    ("missing image", missing_image, r"colour image '.*' is missing", None),
    ("misnamed key", lambda scene: scene.misname_key(), r"key '(label|lable_dir)'.*'label_(path|dir)'",
     lambda scene, line: scene.rename_key(line)),
    ("OpenGL axes", wrong_axes, r"OpenGL|OpenCV", None),
    ("inverse poses", inverse_poses, r"world-to-camera", None),
    ("millimetres", millimetres, r"millimetres", None),
    ("other label size", other_size, r"label image '.*' is \d+ x \d+ pixels, the camera \d+ x \d+", None),
    ("RGB labels", rgb_labels, r"label image '.*' has 3 channels: it is a picture in colours", None),
    ("unknown ids", unknown_ids, r"label ids 207 .*213 .* are not in the class table", None),
    ("quaternions", lambda scene: scene.write_quaternions(), r"quaternion", matrices_again),
    ("black labels", black_labels, r"void in every pixel", None),
    ("one frame", lambda scene: scene.write(kept=1), r"the only frame of the scene", frames_again),
    ("misnamed extension", misnamed_extension, r"'.*\.png' is missing, but there is '.*\.jpg'", rename_files),
]
# Of the format that states its intrinsics.
BREAKS_OF_INTRINSICS = [
    ("intrinsics of a larger image", intrinsics_of_larger_images, r"middle of an image 2 times as large", state_size),
    ("images turned by EXIF", turned_images, r"turned as the file's EXIF orientation says", turn_back),
    ("a lens that is not known", unknown_lens, r"camera model 'FISHEYE624' is not supported", undistorted),
]


def inspect(program, scene, settings=()):
    """Exit code of `semfield inspect`, its errors and warnings, and all that it prints."""
    words = [program, "inspect", scene.config, *(word for value in settings for word in ("--set", value))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    lines = (done.stdout + done.stderr).splitlines()
    problems = [line for line in lines if re.match(r"(error|warning|semfield:|\S+:\d+:\d+:) ?", line)]
    return done.returncode, problems, lines


def remedied(program, scene, line, by_hand):
    """Does what the line says; whether inspect then passes, and what it said."""
    # Shell words: quoted texts, in which an apostrophe is '\'', or anything without spaces.
    settings = [shlex.split(word)[0] for word in re.findall(r"--set ((?:'[^']*'|\\'|[^\s'])+)", line)]
    if not settings:
        if by_hand is None:
            return False, ["the line names no setting"]
        by_hand(scene, line)
    code, problems, lines = inspect(program, scene, settings)
    remedy = shlex.join(settings).replace(str(scene.folder), "SCENE") or "by hand"
    print(f"  remedy: {remedy} -> inspect ends with {code}")
    return code == 0 and not any(problem.startswith("error") for problem in problems), lines


def play(program, scene, name, spoil, named_by, by_hand):
    """Counts of a break: whether it was named, whether the remedy is right, lines said twice."""
    spoil(scene)
    code, problems, lines = inspect(program, scene)
    print(f"\n{scene.kind}, {name}: inspect ends with {code}")
    for line in problems:
        print("  " + line.replace(str(scene.folder), "SCENE"))
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
            sound = kind(folder / "room", folder / f"{kind.kind}_sound")
            sound.write()
            code, problems, lines = inspect(program, sound)
            if code != 0 or problems:
                raise common.Failed(f"the {kind.kind} scene is refused before anything is broken:\n" + "\n".join(lines))
            for name, *how in BREAKS + (BREAKS_OF_INTRINSICS if kind is TransformsJson else []):
                scene = kind(folder / "room", folder / f"{kind.kind}_{name.replace(' ', '_')}")
                counts.update(play(program, scene, name, *how))
    common.print_line("drill", counts, dict.fromkeys(("breaks", "named", "right_remedy", "repeated_lines"), "d"))
    played = 2 * len(BREAKS) + len(BREAKS_OF_INTRINSICS)
    good = counts["breaks"] == counts["named"] == counts["right_remedy"] == played and counts["repeated_lines"] == 0
    return 0 if good else 1
