"""What `semfield prepare SCENE` makes of cameras that are wrong: `scripts/capture_check cameras FOLDER`, which says what its figures are."""
import json
import math
import os
import random
import shutil
import subprocess
import time

import numpy as np
from PIL import Image

REPOSITORY = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
NOISE_DEG, NOISE_M, FOCAL, CENTRE_PX = 1, 0.02, 1.1, 30
DEPTH_SHIFT_M, DEPTH_TURN_DEG = 0.024, 0.9
RIGHT = ("studio_room", "bonsai360", "fern", "lego", "replica_apartment0")


def turn(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


class Cameras:
    def __init__(self, options, folder, say):
        self.options, self.folder, self.say = options, folder, say
        self.program = os.path.join(os.path.abspath(options.build), "bin", "semfield")
        self.figures = {}

    def call(self, *words):
        ended = subprocess.run([self.program, *words], capture_output=True, text=True)
        if ended.returncode:
            raise RuntimeError(f"semfield {' '.join(words)}: {ended.stderr.strip()[-400:]}")
        return ended.stdout

    def path(self, name):
        return os.path.join(self.folder, name)

    # A room whose cameras are known, and copies whose cameras are wrong.
    def room(self):
        room = self.path("room")
        if not os.path.isdir(room):
            self.call("capture", os.path.join(REPOSITORY, "configs", "quickstart.yaml"), "--out", room, "--quiet", "--set", "scene.frames=104",
                      "--set", "scene.test_frames=8", "--set", "scene.width_px=640", "--set", "scene.height_px=480")
        self.poses = np.loadtxt(os.path.join(room, "traj_w_c.txt")).reshape(-1, 4, 4)
        self.lens = np.loadtxt(os.path.join(room, "intrinsics.txt"))
        self.write(room, self.poses, self.lens)
        return room

    # The captured files under an index that states the cameras.
    @staticmethod
    def write(folder, poses, lens):
        frames = [{"file_path": f"rgb/rgb_{i}.png", "depth_path": f"depth/depth_{i}.png", "label_path": f"semantic_class/semantic_class_{i}.png",
                   "transform_matrix": (m * [1, -1, -1, 1]).tolist()} for i, m in enumerate(poses)]
        w, h, fx, fy, cx, cy = lens[:6]
        with open(os.path.join(folder, "transforms.json"), "w", encoding="utf-8") as file:
            json.dump({"w": int(w), "h": int(h), "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "depth_unit_m": 0.001, "classes": "classes.yaml", "frames": frames}, file)
        for name in ("traj_w_c.txt", "intrinsics.txt"):
            if os.path.basename(folder) != "room":
                os.remove(os.path.join(folder, name))

    def wrong(self, name, poses=None, lens=None):
        out = self.path(name)
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(self.path("room"), out)
        self.write(out, self.poses if poses is None else poses, self.lens if lens is None else lens)
        return out

    def noise(self):
        draw = random.Random(1)
        poses = self.poses.copy()
        for m in poses:
            m[:3, :3] = m[:3, :3] @ turn([draw.gauss(0, 1) for _ in range(3)], math.radians(NOISE_DEG))
            shift = np.array([draw.gauss(0, 1) for _ in range(3)])
            m[:3, 3] += NOISE_M * shift / np.linalg.norm(shift)
        return self.wrong("noise", poses)

    def focal(self):
        lens = self.lens.copy()
        lens[2:4] *= FOCAL
        return self.wrong("focal", lens=lens)

    def centre(self):
        lens = self.lens.copy()
        lens[4] += CENTRE_PX
        return self.wrong("centre", lens=lens)

    def delay(self):
        return self.wrong("delay", np.concatenate([self.poses[1:], self.poses[-1:]]))

    def axes(self):
        poses = self.poses.copy()
        poses[:, :, 1:3] *= -1
        return self.wrong("axes", poses)

    def depth_camera(self):
        """Depth as a camera beside the colours' sees it, with the colours' lens: nearest points by z."""
        out = self.wrong("depth_camera")
        fx, fy, cx, cy = self.lens[2:6]
        r, t = turn((0.2, 1, 0.1), math.radians(DEPTH_TURN_DEG)), np.array([DEPTH_SHIFT_M, 0, 0])
        for name in os.listdir(os.path.join(out, "depth")):
            path = os.path.join(out, "depth", name)
            z = np.asarray(Image.open(path)).astype(float) / 1000
            h, w = z.shape
            # Every pixel as 2 x 2 points, so that no gaps open.
            v, u = (np.mgrid[0:2 * h, 0:2 * w] + 0.5) / 2
            z = np.kron(z, np.ones((2, 2)))
            p = np.stack([(u - 0.5 - cx) / fx * z, (v - 0.5 - cy) / fy * z, z], -1) @ r.T + t
            x, y = np.rint(p[..., 0] / p[..., 2] * fx + cx).astype(int), np.rint(p[..., 1] / p[..., 2] * fy + cy).astype(int)
            seen = (x >= 0) & (y >= 0) & (x < w) & (y < h) & (z > 0)
            far = np.full(h * w, np.inf)
            np.minimum.at(far, (y * w + x)[seen], p[..., 2][seen])
            far[~np.isfinite(far)] = 0
            Image.fromarray(np.rint(1000 * far).reshape(h, w).astype(np.uint16)).save(path)
        return out

    def fixed(self, scene, name):
        out = self.path(name)
        begin = time.monotonic()
        found = json.loads(self.call("prepare", scene, "--out", out, "--json", "--quiet"))
        self.say(f"{name}: {found['given_px']:.2f} -> {found['fixed_px']:.2f} pixels, kept {found['kept']}, {'; '.join(found['changes'])}, {time.monotonic() - begin:.0f} s")
        return out, (time.monotonic() - begin) / 60

    def trained(self, scene, name, *more):
        config, run = self.path(name + ".yaml"), self.path("run_" + name)
        shutil.rmtree(run, ignore_errors=True)
        self.call("init", scene, "--out", config, "--replace", "--quiet")
        self.call("train", config, "--out", run, "--quiet", *self.options.device, *more)
        found = json.loads(self.call("eval", run, "--fit-colors", "--json", "--quiet"))
        self.say(f"{name}: " + ", ".join(f"{k} {found[k]:.4g}" for k in ("psnr", "psnr_fitted_colors", "absrel", "miou_present") if isinstance(found.get(k), float)))
        return found

    def modelled(self):
        size = ("--steps", str(self.options.steps), "--set", "scene.load.downscale=4", "--set", "train.cameras.poses=given")
        right = self.trained(self.room(), "right", *size)
        for name, key in (("room", "right"), ("noise", "noise"), ("focal", "focal"), ("depth_camera", "depthcam")):
            scene = self.path("room") if name == "room" else getattr(self, name)()
            found = self.trained(self.fixed(scene, name + "_fixed")[0], name + "_fixed", *size)
            self.figures[key + "_psnr_loss"] = right["psnr"] - found["psnr"]
            if key == "noise":
                self.figures["noise_miou_loss"] = right["miou_present"] - found["miou_present"]

    def kitchen(self, scene):
        seconds = ("--time", str(self.options.seconds))
        self.figures["kitchen_given_db"] = self.trained(scene, "kitchen_given", *seconds)["psnr"]
        out, self.figures["minutes"] = self.fixed(scene, "kitchen_fixed")
        found = self.trained(out, "kitchen_fixed", *seconds)
        self.figures.update(kitchen_mended_db=found["psnr"], kitchen_absrel=found["absrel"])

    def hololens(self, scene):
        found = self.trained(self.fixed(scene, "hololens_fixed")[0], "hololens_fixed", "--time", str(self.options.seconds))
        self.figures["hololens_colors_db"] = found["psnr_fitted_colors"]

    def door(self, scene):
        found = self.trained(self.fixed(scene, "door_fixed")[0], "door_fixed", "--time", str(self.options.seconds), "--set", "scene.load.downscale=4")
        self.figures["door_db"] = found["psnr"]

    def is_right(self, scene):
        ended = subprocess.run([self.program, "inspect", scene, "--json", "--quiet"], capture_output=True, text=True)
        if ended.returncode:
            return False
        found = json.loads(ended.stdout)
        return found["cameras_fit"] is not False and "do not agree" not in found["geometry"]

    def inspect(self):
        self.room()
        wrong = [getattr(self, name)() for name in ("noise", "focal", "centre", "delay", "axes", "depth_camera")]
        right = [self.path("room"), *(os.path.join(self.options.folder, name) for name in RIGHT)]
        missed = [os.path.basename(scene) for scene in wrong if self.is_right(scene)]
        false = [os.path.basename(scene) for scene in right if os.path.isdir(scene) and not self.is_right(scene)]
        self.say(f"inspect missed {missed}, was wrong about {false}")
        self.figures["inspect_named"], self.figures["inspect_false"] = f"{len(wrong) - len(missed)}/{len(wrong)}", len(false)

    def run(self):
        parts = [("inspect", self.inspect), ("modelled", self.modelled)]
        for name, part in (("kinect_kitchen", self.kitchen), ("hololens_room", self.hololens), ("record3d_door", self.door)):
            scene = os.path.join(self.options.folder, name)
            if os.path.isdir(scene):
                parts.append((part.__name__, lambda part=part, scene=scene: part(scene)))
            else:
                self.say(f"there is no {name} in the folder: its figures are n/a")
        for name, part in parts:
            if self.options.parts and name not in self.options.parts.split(","):
                continue
            try:
                part()
            except RuntimeError as failed:
                self.say(str(failed))
        shown = []
        for key, form in (("kitchen_given_db", ".2f"), ("kitchen_mended_db", ".2f"), ("kitchen_absrel", ".4f"), ("minutes", ".1f"), ("hololens_colors_db", ".2f"),
                          ("noise_psnr_loss", ".2f"), ("noise_miou_loss", ".3f"), ("focal_psnr_loss", ".2f"), ("depthcam_psnr_loss", ".2f"), ("door_db", ".2f"),
                          ("right_psnr_loss", ".2f"), ("inspect_named", ""), ("inspect_false", "d")):
            shown.append(f"{key}={self.figures[key]:{form}}" if key in self.figures else f"{key}=n/a")
        print("cameras: " + " ".join(shown))
