#!/usr/bin/env python3
"""Files whose poses keep another convention than their dataset expects: named, with keys that mend them."""

import re

from program import *


def inverted(m):
    turned = [[m[c][r] for c in range(3)] for r in range(3)]
    return [row + [-sum(row[c] * m[c][3] for c in range(3))] for row in turned] + [m[3]]


def other_axes(m):
    """OpenCV to OpenGL, and back."""
    return [[x, -y, -z, t] for x, y, z, t in m[:3]] + [m[3]]


def scaled(m, by):
    return [[*row[:3], by * row[3]] for row in m[:3]] + [m[3]]


BREAKS = {  # how poses are broken: the keys of the remedy, and what is named
    "axes": (other_axes, "flip_camera_axes=true", "OpenGL axes"),
    "inverse": (inverted, "invert_poses=true", "world-to-camera"),
    "inverse of other axes": (lambda m: inverted(other_axes(m)), "flip_camera_axes=true invert_poses=true",
                              "OpenGL axes", "world-to-camera"),
    "millimetres": (lambda m: scaled(m, 1000), "pose_scale=0.001", "millimetres"),
    "kilometres": (lambda m: scaled(m, 0.001), "pose_scale=1000", "1000 times too small"),
    "inverse in millimetres": (lambda m: scaled(inverted(m), 1000), "invert_poses=true pose_scale=0.001",
                               "world-to-camera", "millimetres"),
    "axes in millimetres": (lambda m: scaled(other_axes(m), 1000), "flip_camera_axes=true pose_scale=0.001",
                            "OpenGL axes", "millimetres"),
}


class PoseConventions(ProgramCase):
    def setUp(self):
        super().setUp()
        write_room(self.dir / "room", 12)
        numbers = [[float(v) for v in line.split()] for line in (self.dir / "room/traj_w_c.txt").read_text().splitlines()]
        self.poses = [[row[4 * r:4 * r + 4] for r in range(4)] for row in numbers]

    def replica(self, how):
        self.write("room/traj_w_c.txt",
                   "".join(" ".join(repr(v) for row in how(m) for v in row) + "\n" for m in self.poses))
        return ROOM

    def transforms(self, how):
        frames = [{"file_path": f"rgb/rgb_{i}.png", "depth_path": f"depth/depth_{i}.png",
                   "transform_matrix": how(other_axes(m))} for i, m in enumerate(self.poses)]
        self.write("room/transforms.json", json.dumps({"camera_angle_x": 1.5707963267948966, "depth_unit_m": 0.001,
                                                       "frames": frames}))
        return "{type: transforms_json, root: room}"

    def inspect(self, scene, sets=""):
        self.write("room.yaml", f"include: {SOURCE}/configs/presets/room.yaml\nscene: {scene}\n")
        return self.semfield("inspect room.yaml" + "".join(f" --set scene.load.{word}" for word in sets.split()))

    def test_each_break_is_named_and_its_remedy_restores_the_scene(self):
        bounds = lambda r: re.findall(r"(?m)^(?:bounds|geometry) .*", r.out)
        for write in (self.replica, self.transforms):
            right = self.inspect(write(lambda m: m))
            self.assertEqual(right.code, 0, right.out + right.err)
            self.has(right.out, "poses agree with depth")
            for what, (how, keys, *named) in BREAKS.items():
                with self.subTest(f"{write.__name__}: {what}"):
                    scene = write(how)
                    wrong = self.inspect(scene)
                    errors = re.findall(r"(?m)^error +(.*)", wrong.out)
                    self.assertEqual((wrong.code, len(errors)), (65, 1), wrong.out)  # and no consequence beside it
                    self.has(errors[0], *named)
                    self.assertEqual(sorted(re.findall(r"scene\.load\.(\S+=[\w.]+)", errors[0])), sorted(keys.split()))
                    mended = self.inspect(scene, keys)
                    self.assertEqual((mended.code, bounds(mended)), (0, bounds(right)), mended.out)
                    self.assertEqual(self.inspect(scene, "check_geometry=false").code, 0)


if __name__ == "__main__":
    main()
