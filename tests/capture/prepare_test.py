#!/usr/bin/env python3
"""`semfield prepare` with the true ffmpeg, where it is installed, and a program that stands for COLMAP and finds nothing. With one that
stands for ffmpeg too: tests/bad_files/capture.cases."""

import shutil

from program import *


def flat(path, value, width=80, height=40):
    png(path, width, height, 2, 8, [bytes([value]) * (3 * width)] * height)


class PrepareCase(ProgramCase):
    def setUp(self):
        super().setUp()
        self.bin = self.dir / "bin"
        self.write("bin/colmap", "#!/bin/sh\necho 'ERROR: failed to create sparse model'\n[ \"$1\" != mapper ]\n").chmod(0o700)

    def refused(self, words, code, *said, path=":/usr/bin:/bin"):
        return self.ended(self.semfield(f"prepare {words}", env={"PATH": f"{self.bin}{path}"}), code, *said)


class Programs(PrepareCase):
    def test_a_missing_program_names_the_command_that_installs_it(self):
        (self.bin / "colmap").unlink()
        (self.dir / "photographs").mkdir()
        for i in range(3):
            flat(self.dir / f"photographs/{i}.png", 60 * i + 40)
        self.refused("photographs --out scene", 69, "[capture.program.missing]", "colmap", "sudo apt install colmap",
                     path="")
        self.assertFalse((self.dir / "scene").exists())


class Heic(PrepareCase):
    def test_photographs_become_png(self):
        (self.dir / "photographs").mkdir()
        for i in range(3):
            shutil.copy(pathlib.Path(__file__).parent / "gradient.heic", self.dir / f"photographs/IMG_{i}.HEIC")
        r = self.semfield("prepare photographs --out scene", env={"PATH": f"{self.bin}:/usr/bin:/bin"})
        if "libheif-plugin" in r.err:
            self.skipTest("libheif has no decoder here")
        self.ended(r, 65, "[capture.poses.none]")
        pixels = png_bytes(self.dir / "scene/images/IMG_1.png")
        self.assertEqual(len(pixels), 3 * 64 * 48)
        for x, y in ((5, 5), (40, 20), (60, 45)):  # made with red 4 x, green 5 y, blue 128
            at = 3 * (64 * y + x)
            for seen, made in zip(pixels[at:at + 3], (4 * x, 5 * y, 128)):
                self.assertLess(abs(seen - made), 16)


@unittest.skipUnless(shutil.which("ffmpeg") and shutil.which("ffprobe"), "ffmpeg is not installed")
class TrueFfmpeg(PrepareCase):
    def film(self, path):
        subprocess.run(["ffmpeg", "-v", "error", "-f", "lavfi", "-i",
                        "color=gray:size=64x48:rate=12:duration=3,noise=alls=100:allf=t", "-pix_fmt", "yuv420p",
                        f"file:{path}"], check=True, stdin=subprocess.DEVNULL)

    def files(self):
        return {path for path in self.dir.rglob("*") if path.is_file()}

    def test_a_percent_sign_is_a_part_of_a_name(self):
        for name in ("50%off", "a%06d", "%%", "%d", "%5"):
            folder = self.dir / name
            folder.mkdir()
            self.film(folder / f"{name}.mp4")
            before = self.files()
            self.refused(f"'{name}/{name}.mp4' --out '{name}/scene' --frames 6", 65, "[capture.poses.none]")
            new = self.files() - before
            self.assertEqual({path for path in new if folder / "scene" not in path.parents}, set(), name)
            images = [path for path in new if path.parent == folder / "scene/images" and "frame_" in path.name]
            self.assertEqual(len(images), 6, name)

    def test_a_playlist_is_no_film(self):
        secret = self.dir / "secret.mp4"
        self.film(secret)
        for name, text in (("concat.mp4", f"ffconcat version 1.0\nfile '{secret}'\n"),
                           ("list.mov", f"#EXTM3U\n#EXT-X-TARGETDURATION:3\n#EXTINF:3,\n{secret}\n#EXT-X-ENDLIST\n")):
            self.write(name, text)
            self.refused(f"{name} --out scene_of_{name} --frames 6", 65, "[capture.video.format]", name)
            self.assertFalse((self.dir / f"scene_of_{name}/images").exists())


if __name__ == "__main__":
    main()
