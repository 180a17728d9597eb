#!/usr/bin/env python3
"""`semfield demo`: what it leaves in an empty folder, and what it does to one that is not empty."""

from program import *

SMALL = "--set scene.test_frames=2 --set scene.width_px=40 --set scene.height_px=30"


class Demo(ProgramCase):
    def setUp(self):
        super().setUp()
        self.run_dir = self.dir / "runs/demo"

    def demo(self, words, code=0, *said):
        return self.ended(f"demo {words} --set scene.frames=6 {SMALL} --set passes.0.position.finest_resolution=32",
                          code, *said)

    def test_it_labels_the_shipped_room_in_an_empty_folder(self):
        r = self.demo("--steps 20", 0, f"in {self.run_dir}", "train quickstart ")
        self.assertRegex(r.out, r"\Ademo: miou_present=\S+ total_accuracy=\S+ psnr=\S+ absrel=\S+ train_s=\S+ "
                         r"report=runs/demo/report.html\n\Z")
        for made in ("first_look.png", "report.html", "mesh.ply", "mesh.glb", "render/test"):
            self.assertTrue((self.run_dir / made).exists(), made)
        self.assertEqual(struct.unpack(">II", (self.run_dir / "first_look.png").read_bytes()[16:24]), (84, 64))
        self.has(r.err, "Look at runs/demo/first_look.png first", " eval runs/demo ", "Rendered ", "A surface of ")
        # The next one takes the place of its own run alone, and only when its words are right.
        before = (self.run_dir / "run.yaml").read_text()
        for words in ("--steps x", "--time x"):
            self.ended(f"demo {words}", 2)
        self.assertEqual((self.run_dir / "run.yaml").read_text(), before)
        self.assertEqual(self.demo("--steps 10 --quiet").err, "")
        self.has((self.run_dir / "run.yaml").read_text(), "steps: 10")
        said = json.loads(self.demo("--steps 5 --quiet --json").out)
        self.assertEqual((list(said)[:3], said["verb"], said["step"]), (["semfield", "verb", "run"], "demo", 5))

    def test_it_leaves_folders_of_others_alone(self):
        notes, named = self.write("runs/demo/notes.txt", "mine"), self.write("named/notes.txt", "mine")
        self.ended("demo", 73, "'runs/demo' is there already and is not an earlier demo; name a new folder with --out")
        # A run of somebody's, even of that name.
        self.write("runs/demo/run.yaml", "name: demo\nscene: {root: /elsewhere}\n")
        self.ended("demo", 73)
        self.demo("--out named --steps 5", 73)
        self.assertEqual((notes.read_text(), named.read_text()), ("mine", "mine"))

    def test_a_signal_stops_it_in_order(self):
        def stopped(frames, sign, number):
            """By a signal to it alone, once it has said the sign."""
            demo = self.start(*f"demo --steps 1000000 --set scene.frames={frames} {SMALL}".split(), folder=self.dir)
            self.assertTrue(until(lambda: sign in demo.err()))
            demo.send(number)
            return demo.wait(60)

        # While the scene is read nothing is saved yet; the next demo may have the folder.
        self.ended(stopped(2000, "$ ", signal.SIGINT), 130)
        self.assertFalse((self.run_dir / "run.yaml").exists())
        late = self.ended(stopped(6, "step ", signal.SIGTERM), 143, "resume with `semfield train --resume runs/demo`")
        self.assertTrue((self.run_dir / "checkpoints/latest").exists())
        self.assertEqual(late.out, "")

    def test_it_says_where_it_cannot_write(self):
        self.write("runs", "mine")  # a file
        self.lacks(self.demo("--steps 5", 73, "--out").err, "$ ")  # told before anything is read

    def test_the_script_has_help(self):
        self.has(subprocess.check_output([SOURCE / "scripts/demo", "--help"], text=True), "./scripts/demo [FOLDER]")


if __name__ == "__main__":
    main()
