#!/usr/bin/env python3
"""`mesh`, `render` and `eval` of one short run as a user runs them, read back by other programs."""

import shutil

from program import *

HAS_FFMPEG = shutil.which("ffmpeg") is not None and shutil.which("ffprobe") is not None
needs_ffmpeg = unittest.skipIf(not HAS_FFMPEG, "no ffmpeg here: no video was written")


def npy(path):
    """Shape and numbers of an array of 32 bits."""
    data = path.read_bytes()
    begin = 10 + struct.unpack_from("<H", data, 8)[0]
    shape = eval(data[10:begin])["shape"]
    return shape, struct.unpack(f"<{(len(data) - begin) // 4}f", data[begin:])


def probe(file, entries):
    return subprocess.run(["ffprobe", "-v", "error", "-count_frames", "-show_entries", f"stream={entries}", "-of",
                           "csv=p=0",
                           f"file:{file}"], capture_output=True, text=True).stdout.strip()


class VerbCase(ProgramCase):
    @classmethod
    def setUpClass(cls):
        made = tempfile.TemporaryDirectory(prefix="semfield_test_")
        cls.addClassCleanup(made.cleanup)
        cls.shared = pathlib.Path(made.name)
        cls.run_dir = cls.shared / "run"
        case = cls("ok")
        case.ok(["train", case.room(folder=cls.shared), "--out", cls.run_dir], folder=cls.shared)

    def trained(self, name, *words, scene=None):
        """Another run in this test's folder; `scene` in place of the shared one's."""
        text = (self.shared / "config.yaml").read_text()
        shared = f"{{type: packed, file: {self.shared}/room.sfpack}}"
        config = self.write(f"{name}.yaml", text.replace("{type: packed, file: room.sfpack}", scene or shared))
        self.ok(["train", config, "--out", self.dir / name, *words])
        return self.dir / name

    def mesh(self, *words, of=None):
        """What `semfield mesh RUN ... --json` says."""
        return json.loads(self.ok(["mesh", of or self.run_dir, "--json", *words]).out)

    def render(self, *words, **more):
        return self.semfield(["render", self.run_dir, *words], **more)


class Mesh(VerbCase):
    def test_every_format_is_written_and_named(self):
        stem = self.dir / "out/room.v2"
        r = self.ok(["mesh", self.run_dir, "--resolution", 48, "--format", "ply,obj,glb", "--points", "--out", stem,
                     "--json",
                     "--faces", 3000, "--close-holes", 0.5])
        said = json.loads(r.out)
        self.assertGreater(said["vertices"], 500)
        self.assertTrue(1000 < said["faces"] <= 3000 and said["holes_closed"] > 0 and said["components"] >= 1, said)
        self.assertGreater(said["points"], 100)
        files = [f"{stem}{part}" for colors in ("", "_classes")
                 for part in (f"{colors}.ply", f"{colors}.obj", f"{colors}.glb", f"_points{colors}.ply")]
        self.assertEqual(said["files"], files)
        self.assertGreater(min(os.path.getsize(file) for file in files), 1000)
        self.assertEqual(said["up"], [0, 0, 1])
        self.has(r.err, "files show +z upright")
        self.assertIn(b"KHR_materials_unlit", pathlib.Path(f"{stem}.glb").read_bytes())
        self.assertNotIn(b"KHR_materials_unlit", pathlib.Path(f"{stem}_classes.glb").read_bytes())
        self.assertTrue(pathlib.Path(f"{stem}.mtl").exists())
        head = pathlib.Path(f"{stem}.ply").read_bytes()[:400].decode(errors="replace")
        self.has(head, f"element vertex {said['vertices']}\n", "property int label\n")

    def test_it_is_the_same_for_any_number_of_threads_and_its_defaults_stand_in_the_run(self):
        first = self.ok(["mesh", self.run_dir, "--resolution", 32])
        self.has(first.out, "A surface of ", " was found in the depth of the training views.\nmesh: vertices=",
                 f" file={self.run_dir}/mesh.ply,{self.run_dir}/mesh_classes.ply\n")
        self.mesh("--resolution", 32, "--set", "runtime.threads=1", "--out", self.dir / "one.ply")
        self.assertEqual((self.run_dir / "mesh.ply").read_bytes(), (self.dir / "one.ply").read_bytes())

    def test_colors_are_those_asked_for(self):
        out, both = self.dir / "c.ply", self.dir / "c_classes.ply"
        files = lambda *words, of=None: self.mesh("--resolution", 24, *words, of=of)["files"]
        self.assertEqual(files("--color", "photo", "--out", out), [str(out)])
        photo = out.read_bytes()
        self.assertEqual(files("--color", "class", "--out", out), [str(out)])
        classes = out.read_bytes()
        self.assertEqual(len(classes), len(photo))
        self.assertNotEqual(classes, photo)
        self.assertEqual(files("--color", "both", "--out", out), [str(out), str(both)])
        self.assertEqual((out.read_bytes(), both.read_bytes()), (photo, classes))
        # Without labels there is one colouring.
        scene = f"{{type: packed, file: {self.shared}/room.sfpack, labels: {{frames: none}}}}"
        plain = self.trained("plain", scene=scene)
        # So short a training may leave a fog around the cameras, of which none of them sees a face.
        self.assertEqual(files("--keep-unseen", of=plain), [f"{plain}/mesh.ply"])
        for color in ("class", "both"):
            self.ended(["mesh", plain, "--color", color], 65,
                       "has no semantics; train with labels, or leave --color out")

    def test_what_no_camera_sees_is_left_out_unless_told(self):
        def faces(*words):
            r = self.ok(["mesh", self.run_dir, "--resolution", 48, "--keep-components", 0, "--json", "--out",
                         self.dir / "seen.ply", *words])
            said = json.loads(r.out)
            self.assertEqual(" faces that no training camera sees are left out; --keep-unseen keeps them" in r.err,
                             said["unseen_faces"] > 0)
            return said["faces"], said["unseen_faces"]
        (total, none), (seen, unseen) = faces("--keep-unseen"), faces("--surface", "density")
        self.assertTrue(none == 0 < unseen, (total, none, seen, unseen))
        self.assertAlmostEqual(seen + unseen, total, delta=0.05 * total)  # borders of classes are cut in what is left

    def test_it_is_of_depth_where_rays_end_in_a_background(self):
        """Of a room it is fused from depth, unless something asks for the density."""
        out = ("--resolution", 40, "--out", self.dir / "which.ply")
        depth, density = self.mesh(*out), self.mesh(*out, "--level", 3)
        self.assertEqual((depth["surface"], "level" in depth), ("depth", False))
        self.assertEqual((density["surface"], density["level"]), ("density", 3))

    def test_it_is_scored_against_depth_images(self):
        """As the fused depth images are, and without touching what is written."""
        scored, plain = self.dir / "scored.ply", self.dir / "plain.ply"
        words = ["mesh", self.run_dir, "--resolution", 64, "--keep-components", 0, "--out"]
        self.lacks(self.ok([*words, plain]).out, "complete")
        self.has(self.ok([*words, scored, "--score"]).out, "mesh: complete ", "sensor: complete ", "\n  accurate ",
                 "\nmesh: vertices=")
        self.assertEqual(scored.read_bytes(), plain.read_bytes())
        of_run = json.loads(self.ok([*words, scored, "--score", "--json"]).out)["score"]
        self.assertEqual(of_run["distances"], [0.02, 0.05, 0.1])
        self.assertTrue(of_run["points"] > of_run["held_out_points"] > 1000, of_run)
        for what in ("complete", "complete_of_held_out", "accurate", "f"):
            for of in ("mesh", "sensor"):
                shares = of_run[of][what]
                self.assertEqual(shares, sorted(shares))
                self.assertTrue(len(shares) == 3 and 0 <= shares[0] and shares[2] <= 1, of_run)
            self.assertGreater(of_run["sensor"][what][2], 0.95)  # walls on the bounds are there
            self.assertGreater(of_run["sensor"][what][1], of_run["mesh"][what][1])
        of_sensor = json.loads(self.ok([*words, scored, "--surface", "sensor", "--score", "--json"]).out)
        self.assertEqual(of_sensor["surface"], "sensor")
        shares = [[share for what in ("complete", "complete_of_held_out", "accurate", "f") for share in score[what]]
                  for score in (of_sensor["score"]["mesh"], of_run["sensor"])]
        for own, other in zip(*shares):  # the same surface, but that borders of classes are cut
            self.assertAlmostEqual(own, other, delta=0.001)
        self.assertIsNone(of_sensor["score"]["sensor"])

    def test_lengths_that_nobody_names_are_shares_of_a_large_scene(self):
        """A scene of another unit: what is a length without being asked for is a share of its longest side."""
        large = self.trained("large", "--set", "scene.load.pose_scale=300", "--set", "scene.load.depth_scale=300")
        score = self.mesh("--resolution", 48, "--score", "--out", self.dir / "l.ply", of=large)["score"]
        metre = score["distances"][2] / 0.1
        self.assertTrue(150 < metre < 600, metre)  # a fifth of the room's longest side
        self.assertAlmostEqual(score["distances"][0] / metre, 0.02, 9)
        self.assertGreater(score["sensor"]["complete"][2], 0.9)  # the distances are those that are counted within
        self.has(self.ok(["mesh", large, "--format", "pgm", "--out", self.dir / "l.pgm"]).err,
                 f"has what lies {0.1 * metre:.3g} to {metre:.3g} above it")

    def test_a_scene_without_depth_has_no_score(self):
        subprocess.run([os.environ["SEMFIELD_ANALYTIC_ROOM"], self.dir / "flat.sfpack", "without_depth"], check=True)
        flat = self.trained("flat", "--steps", 20, scene="{type: packed, file: flat.sfpack}")
        for more in ("--score", "--surface=sensor"):
            self.ended(["mesh", flat, more, "--out", self.dir / "none.ply"], 65, "[mesh.depth.none]", str(flat))
            self.assertFalse((self.dir / "none.ply").exists())

    def test_into_a_folder_it_is_written_in_it(self):
        (self.dir / "meshes").mkdir()
        for out in ("meshes", "new/"):
            self.mesh("--resolution", 24, "--out", f"{self.dir}/{out}")
            self.assertTrue((self.dir / out / "mesh.ply").exists())
        self.assertFalse((self.dir / "meshes.ply").exists())

    def test_what_makes_no_sense_is_refused(self):
        for words, code, said in (("--format gbl", 2, "did you mean glb?"),
                                  ("--out mesh.stl", 2, "unknown mesh format 'stl'"),
                                  ("--resolution 8 --voxel 0.1", 2, "excludes"),
                                  ("--voxel 1e-7", 2, "choose a larger --voxel"),
                                  ("--surface depth --level 3", 2, "--level belongs to the surface of the density"),
                                  ("--surface depth --keep-unseen", 2,
                                   "--keep-unseen belongs to the surface of the density"),
                                  ("--band 1,0.1 --out x.pgm", 2, "--band 1,0.1: not two heights"),
                                  ("--up w", 2, "[usage.value.invalid]"),
                                  ("--resolution 8 --out /proc/none/x.ply", 73,
                                   "/proc/none: cannot create the folder")):
            self.ended(f"mesh {shlex.quote(str(self.run_dir))} {words}", code, said)

    def test_files_for_other_programs(self):
        stem = self.dir / "other/room"
        r = self.ok(["mesh", self.run_dir, "--resolution", 32, "--format", "las,bt,pgm", "--band",
                     "0.1,0.8", "--out",
                     stem, "--json"])
        said = json.loads(r.out)
        self.assertNotIn("faces", said)  # no surface is made for points
        self.assertEqual(said["files"], [f"{stem}{ending}" for ending in (".las", ".bt", ".pgm", ".yaml")])
        self.has(r.err, "the floor is at ", " along +z")
        self.assertEqual(len(json.loads(pathlib.Path(f"{stem}.json").read_text())["files"]), len(said["files"]))
        # The ending alone says so, and a page alone has no sidecar.
        one = self.dir / "one.pcd"
        self.assertRegex(self.ok(["mesh", self.run_dir, "--resolution", 24, "--out", one]).out,
                         rf"\Amesh: points=\d+ file={one}\n\Z")
        self.mesh("--resolution", 24, "--out", self.dir / "alone.html")
        self.assertFalse((self.dir / "alone.json").exists())

    def test_eval_scores_by_a_protocol(self):
        said = json.loads(self.ok(["eval", self.run_dir, "--protocol", "semantic_nerf", "--json"]).out)
        of = said["protocol"]
        self.assertEqual([of["miou"], of["total_accuracy"], len(of["frames"]), len(of["truth"])],
                         [said["miou_present"], said["total_accuracy"], said["frames"], 8])
        shown = self.ok(["eval", self.run_dir, "--protocol", "panoptic_lifting"]).out
        self.has(shown, "protocol: name=panoptic_lifting miou=", f" truth={of['truth']}")
        self.ended(["eval", self.run_dir, "--protocol", "semantic_nerf", "--split", "train"], 2,
                   "[eval.protocol.split]", "--split")


class Video(VerbCase):
    @needs_ffmpeg
    def test_it_is_decoded_by_another_program(self):
        file = self.dir / "a video: 1.mp4"
        r = self.ok(self.render("--trajectory", "smooth", "--frames", 7, "--video", "--fps", 10, "--out", file))
        self.has(r.out, "render: frames=7 ", f"file={file}")
        # Four panels of 48 x 36 pixels.
        self.assertEqual(probe(file, "width,height,nb_read_frames,r_frame_rate"), "192,36,10/1,7")
        self.assertEqual([path.name for path in self.dir.iterdir() if ".part" in path.name], [])
        for words, size in ((("--panels", "rgb"), "48,36"), (("--width", 24, "--panels", "rgb,depth"), "48,18")):
            r = self.ok(self.render("--split", "test", "--video", *words, "--out", self.dir / "t.mkv"))
            self.has(r.out, f" size={size.replace(',', 'x')} ")
            self.assertEqual(probe(self.dir / "t.mkv", "width,height"), size)

    def test_without_ffmpeg_the_remedy_is_named(self):
        self.ended(self.render("--video", env={"PATH": str(self.dir)}), 69, "ffmpeg is not in PATH; install it")

    def test_it_survives_an_ffmpeg_that_dies(self):
        """One that ends at once, and one that reads all and then fails: neither hangs, kills us or leaves a file."""
        for n, script in enumerate(("exit 3", "/bin/cat >/dev/null\nexit 3")):
            ffmpeg = self.write(f"bin{n}/ffmpeg", f"#!/bin/sh\n{script}\n")
            ffmpeg.chmod(0o700)
            out = ffmpeg.parent / "out.mp4"
            self.ended(self.render("--trajectory", "smooth", "--frames", 40, "--video", "--out", out,
                                   env={"PATH": str(ffmpeg.parent)}), 74, "(exit code 3)")
            self.assertFalse(out.exists())

    @needs_ffmpeg
    def test_a_full_disk_keeps_the_old_film(self):
        """Disks of several sizes, so that it is full in the middle and at the end of the film."""
        (self.dir / "disk").mkdir()
        if subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", self.dir / "disk"],
                          capture_output=True).returncode:
            self.skipTest("this system lets nobody mount a tmpfs in a namespace of its own")
        script = self.write("full.sh", f"""mount -t tmpfs -o size=512k tmpfs disk || exit 99
printf 'an old film' >disk/room.mp4
for free in 0 4 8 12 400; do
  rm -f disk/other
  dd if=/dev/zero of=disk/other bs=1k count=$((508 - free)) 2>/dev/null
  {shlex.quote(PROGRAM)} render {shlex.quote(str(self.run_dir))} --trajectory smooth --frames 30 --video --out disk/room.mp4 >said 2>err
  echo "$free code $? $(grep -c 'an old film' disk/room.mp4) $(ls -A disk | wc -l)" \\
    "$(grep -c 'disk full: need .* have .*free some space or choose another disk' err)"
done
""")
        said = subprocess.run(["unshare", "-rm", "sh", script], cwd=self.dir, capture_output=True, text=True)
        # Exit code, the old film is there, two files in the folder, the cause is reported.
        full = [f"{free} code 74 1 2 1" for free in (0, 4, 8, 12)]
        self.assertEqual(said.stdout.splitlines(), [*full, "400 code 0 0 2 0"], said.stderr)

    @needs_ffmpeg
    def test_it_follows_no_link(self):
        """Whoever may write in the folder could put links where a temporary file is expected."""
        precious = self.write("precious.txt", "mine")
        film = self.dir / "links/room.mp4"
        film.parent.mkdir()
        for name in (".room.part.mp4", ".room.mp4.0.tmp", "room.mp4"):
            (film.parent / name).symlink_to(precious)
        self.ok(self.render("--trajectory", "smooth", "--frames", 3, "--video", "--out", film))
        self.assertEqual(precious.read_text(), "mine")
        self.assertFalse(film.is_symlink())
        self.assertGreater(film.stat().st_size, 500)

    @needs_ffmpeg
    def test_unknown_panels_counts_and_what_it_cannot_hold_are_refused(self):
        for words, said in (("--video --panels rgb,normals", ("usage.value.invalid", "'normals'", "entropy")),
                            ("--video --out room.mpx", ("'.mpx' is no extension of a video file", "known: .mp4, ",
                                                        "room.mp4")),
                            ("--trajectory smooth --frames 0", ()), ("--video --fps 0", ())):
            self.ended(f"render {shlex.quote(str(self.run_dir))} {words}", 2, *said)

    def test_arrays_are_no_film(self):
        for flag in ("--npy", "--probability"):
            self.ended(self.render("--video", flag), 2)


class Render(VerbCase):
    def test_pictures_have_the_width_that_is_asked_for_and_ones_for_the_eye(self):
        r = self.ok(self.render("--split", "test", "--width", 24, "--out", self.dir / "narrow"))
        self.has(r.out, " size=24x18 ")
        pictures = sorted((self.dir / "narrow").glob("*.png"))
        for picture in pictures:
            self.assertEqual(struct.unpack(">II", picture.read_bytes()[16:24]), (24, 18), picture)
        kinds = {kind: sum(picture.stem.endswith(f"_{kind}") for picture in pictures)
                 for kind in ("rgb", "depth", "depth_vis", "label", "label_vis", "entropy", "entropy_vis")}
        self.assertEqual(len(set(kinds.values())), 1, kinds)
        self.assertGreater(kinds["rgb"], 1)

    def test_cameras_of_a_render_render_the_same_again(self):
        first, again, edited = self.dir / "first", self.dir / "again", self.dir / "edited"
        self.ok(self.render("--npy", "--out", first))
        self.ok(self.render("--npy", "--trajectory", first / "cameras.json", "--out", again))
        files_of = lambda folder: {path.name: path.read_bytes() for path in folder.iterdir()}
        self.assertGreater(len(files_of(first)), 7)
        self.assertEqual(files_of(first), files_of(again))
        # A view of its own: another size, and rays that end before they meet anything.
        cameras = json.loads((first / "cameras.json").read_text())
        cameras["cameras"][1].update(name="own", width=24, cx=12, near=1e-4, far=2e-4)
        self.ok(self.render("--npy", "--trajectory", self.write("edited.json", json.dumps(cameras)), "--out", edited))
        shape, depth = npy(edited / "own_depth.npy")
        self.assertEqual(shape[1], 24)
        self.assertLessEqual(max(depth), 2.0001e-4)

    def test_probabilities_of_views_are_labels_that_train(self):
        out = self.dir / "probable"
        self.ok(self.render("--split", "train", "--probability", "--out", out))
        classes = len(json.loads((out / "classes.json").read_text()))
        for camera in json.loads((out / "cameras.json").read_text())["cameras"]:
            shape, p = npy(out / f"{camera['name']}_probability.npy")
            self.assertEqual(shape, (camera["height"], camera["width"], classes))
            for i in range(0, len(p), classes):
                self.assertAlmostEqual(sum(p[i:i + classes]), 1, 5)
        self.trained("soft", "--steps", 2, scene=f"{{type: packed, file: {self.shared}/room.sfpack, labels: "
                     '{from: {type: npz, folder: probable, pattern: "{name}_probability.npy"}}}')

    def test_probabilities_tell_their_size_before_they_are_rendered(self):
        def said_for(side):
            camera = {"name": "wide", "width": side, "height": side, "fx": 900, "fy": 900, "cx": 9, "cy": 9,
                      "world_from_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
            file = self.write("wide.json", json.dumps({"format": "semfield-cameras-1", "cameras": [camera]}))
            return self.ended(self.render("--probability", "--trajectory", file, "--out", "/proc/none/images"), 73).err
        # Four bytes for each of five classes.
        self.lacks(said_for(1000), "probabilities of")
        self.has(said_for(16000), "probabilities of 1 view and 5 classes take 5.1 GB of disk")

    def test_a_smooth_path_renders_images_too(self):
        self.ok(self.render("--trajectory", "smooth", "--frames", 2))
        self.assertTrue((self.run_dir / "render/smooth/00001_rgb.png").exists())


if __name__ == "__main__":
    main()
