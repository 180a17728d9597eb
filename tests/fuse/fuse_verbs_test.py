#!/usr/bin/env python3
"""`semfield labels fuse` and `semfield labels propagate` as a user runs them: lines, JSON, maps, files that train again, the same
bytes for any threads, refusals."""

from program import *

CLICKS = "--set 'scene.labels.degrade=[{type: propagation}]'"
NPZ = "--set 'scene.labels.from={type: npz, folder: soft/probability, pattern: \"{name}.npy\"}'"


class Verbs(ProgramCase):
    def pack(self, name, word):
        subprocess.run([os.environ["SEMFIELD_ANALYTIC_ROOM"], self.dir / name, word], check=True)

    def json(self, words):
        return json.loads(self.ok(words).out)

    def refused(self, words, code, said):
        self.assertEqual(self.ended(words, code, said).out, "")


class Fuse(Verbs):
    def test_lines_json_and_maps(self):
        self.room()
        lines = self.ok("labels fuse config.yaml --method monocular,bayesian")
        self.has(lines.out, "fuse: method=monocular depth=true miou_present=1.0000 ",
                 "\nfuse: method=bayesian depth=true ")
        self.has(lines.err, "predictions are the scene's own labels")
        fuse = "labels fuse config.yaml --json --set fuse.relative_tolerance=0.03"
        rows = self.json(f"{fuse} --out maps")["scores"]
        self.assertEqual(json.loads((self.dir / "maps/fuse.json").read_text())["scores"], rows)
        self.assertEqual(self.json(f"{fuse} --threads 1")["scores"], rows, "threads change a number")
        self.assertEqual(len(rows), 3)
        for row in rows:
            self.assertGreater(min(row[key] for key in ("miou", "miou_present", "total_accuracy", "average_accuracy")),
                               0.9, row)
            self.assertEqual(len(list((self.dir / "maps" / row["method"]).iterdir())), 18)
        self.assertGreater(rows[1]["visible_views_mean"], 2)

    def test_depth_of_a_run_and_its_own_row(self):
        self.room()
        self.ok("train config.yaml --out run")
        rows = self.json("labels fuse config.yaml --json --depth-from run --set fuse.tolerance=0.2 --out maps")["scores"]
        self.assertEqual((len(rows), rows[3]["method"], rows[3]["visible_views_mean"], rows[1]["depth"]),
                         (4, "field", None, "learned"))
        self.assertGreater(rows[3]["total_accuracy"], 0.6)
        self.assertGreater(rows[1]["total_accuracy"], 0.7)
        self.assertGreater(rows[1]["visible_views_mean"], 1.5)
        self.assertTrue((self.dir / "maps/field").exists())
        self.assertEqual(json.loads((self.dir / "maps/fuse.json").read_text())["depth_from"]["step"], 200)
        # A field of another scene: the same names, other places.
        self.pack("other.sfpack", "10")
        elsewhere = "the camera stands elsewhere in the scene of"
        self.refused("labels fuse config.yaml --set scene.file=other.sfpack --depth-from run", 65, elsewhere)
        # In a room a ten-thousandth as large, cameras a fifth farther out are elsewhere too.
        scaled = lambda by: f"config.yaml --set scene.load.pose_scale={by} --set scene.load.depth_scale={by}"
        self.ok(f"train {scaled('1e-4')} --steps 2 --out small")
        self.ok(f"labels fuse {scaled('1e-4')} --depth-from small")
        self.refused(f"labels fuse {scaled('1.2e-4')} --depth-from small", 65, elsewhere)

    def test_refusals(self):
        self.room()
        self.pack("room.sfpack", "without_depth")
        for words, code, said in (("", 65, "no training frame of the scene has depth"),
                                  ("--depth learned", 2, "name its folder: --depth-from RUN"),
                                  ("--depth true --depth-from x", 2, "exclude each other"),
                                  ("--set fuse.methods=[mean]", 78, "there is no method 'mean'"),
                                  ("--depth-from nowhere", 66, "nowhere"),
                                  ("--set fuse.neighbourhood=2", 78, "a window of 2 pixels has no centre")):
            self.refused(f"labels fuse config.yaml {words}", code, said)


class Propagate(Verbs):
    def manifest(self, name):
        return json.loads((self.dir / name / "manifest.json").read_text())

    def test_clicks_become_labels_that_train_again(self):
        self.room()
        self.ok(f"train config.yaml --out run {CLICKS}")
        line = self.ok("labels propagate run --out soft")
        self.assertTrue(line.out.startswith("propagate: method=surface labelled_share=0.00"), line.out)
        self.has(line.out, "accuracy=1.0000->0.", " folder=soft\n")
        self.has(line.err, "propagate.cell_m is 0.")
        soft = self.manifest("soft")
        self.assertEqual((soft["steps"][1]["type"], soft["total"]["labelled_px"]), ("propagate surface", 9 * 48 * 36))
        self.assertGreater(soft["total"]["accuracy"], 0.6)  # the field has seen 200 steps
        row = self.json("labels propagate run --json --threads 1 --out one")
        self.assertEqual(row["accuracy"], {"before": 1, "after": soft["total"]["accuracy"]})
        self.assertTrue(row["labelled_share"]["before"] < 0.01 and row["labelled_share"]["after"] == 1, row)
        # What was written is what trains: the same labels come back through the reader, and a run goes on with them.
        self.ok(f"labels degrade config.yaml --out again {NPZ}")
        self.assertEqual(self.manifest("again")["total"], soft["total"])
        self.ok(f"train config.yaml --steps 20 --out second {NPZ}")

    def test_refusals(self):
        self.room(5)
        self.ok("train config.yaml --out run")
        for words, code, said in (("run --out run", 73, "holds files already"),
                                  ("nowhere --out soft", 66, "nowhere"),
                                  ("run --out soft --method mean", 78, "surface"),
                                  ("run --out soft --set 'propagate.vote_cells_m=[0.2, 0.1]'", 78,
                                   "the edges do not ascend"),
                                  ("run --out soft --set scene.labels.frames=none", 65,
                                   "no training pixel carries a label")):
            self.refused(f"labels propagate {words}", code, said)
        self.pack("room.sfpack", "without_labels")
        self.ok("train config.yaml --out plain")
        self.refused("labels propagate plain --out soft", 65, "the run's scene has no classes")
        self.assertFalse((self.dir / "soft").exists())


if __name__ == "__main__":
    main()
