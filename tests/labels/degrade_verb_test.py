#!/usr/bin/env python3
"""`semfield labels degrade` on a tiny room, of which frames 0, 2 and 4 train; what it wrote is read back."""

from program import *


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


class Degrade(ProgramCase):
    def setUp(self):
        super().setUp()
        write_room(self.dir / "room")
        self.out = self.dir / "labels"

    def config(self, labels):
        preset, room = SOURCE / "configs/presets/room.yaml", ROOM.replace("}", f", labels: {labels}}}")
        self.write("room.yaml", f"include: {preset}\nscene: {room}\n")

    def ids(self, path):
        return png_bytes(self.dir / path)

    def manifest(self, name):
        return json.loads((self.dir / name / "manifest.json").read_text())

    def test_ids_previews_classes_and_a_manifest_agree(self):
        self.config("{seed: 3, degrade: [{type: super_resolution, factor: 4, mode: sparse}, {type: pixel_noise}]}")
        r = self.ok("labels degrade room.yaml --out labels")
        self.assertEqual(names_in(self.dir), ["labels", "room", "room.yaml"])
        self.assertEqual(names_in(self.out), ["classes.yaml", "manifest.json", "preview", "semantic_class"])
        self.assertEqual(names_in(self.out / "semantic_class"), [f"semantic_class_{n}.png" for n in (0, 2, 4)])
        made = self.manifest("labels")
        self.assertEqual((made["seed"], made["labels_from"]), (3, "the scene"))
        self.assertEqual([step["type"] for step in made["steps"]], ["super_resolution", "pixel_noise"])
        self.assertEqual(made["steps"][1]["facts"]["pixels drawn"], "1800")
        self.has(made["config"], "pixel_noise")
        # The figures, counted again from the images.
        labelled = changed = right = 0
        for frame in made["frames"]:
            given, truth = self.ids(f"labels/{frame['label']}"), self.ids(f"room/{frame['label']}")
            self.assertEqual((len(given), given), (1200, self.ids(f"labels/{frame['preview']}")))
            at = [p for p, id in enumerate(given) if id]
            self.assertEqual([p for p in at if p % 4 or p // 40 % 4], [])
            self.assertEqual(frame["labelled_px"], len(at))
            labelled += len(at)
            changed += sum(a != b for a, b in zip(given, truth))
            right += sum(given[p] == truth[p] for p in at)
        total = made["total"]
        self.assertEqual((total["labelled_px"], total["changed_px"]), (labelled, changed))
        self.assertAlmostEqual(total["accuracy"], right / labelled, 14)
        self.assertTrue(r.out.startswith(f"degrade: frames=3 labelled_px={labelled} accuracy=0."), r.out)

    def test_written_labels_come_back_through_the_readers(self):
        self.config("{frames: 2, degrade: [{type: simulated_predictions, strength: 2}]}")
        self.ok("labels degrade room.yaml --out first")
        files = lambda folder: {path.name: path.read_bytes() for path in (self.dir / folder).iterdir()}
        images = files("first/semantic_class")
        self.assertEqual(len(images), 2)
        for kind, words in (("images", "folder: first/semantic_class, pattern: 'semantic_class_{number}.png'"),
                            ("npz", "folder: first/probability, pattern: '{name}.npy'")):
            self.config(f"{{from: {{type: {kind}, {words}}}}}")
            self.ok(f"labels degrade room.yaml --out {kind}")
            self.assertEqual(files(f"{kind}/semantic_class"), images)
            self.assertEqual((self.manifest(kind)["total"], self.manifest(kind)["labels_from"]),
                             (self.manifest("first")["total"], kind))
        self.assertEqual(files("npz/probability"), files("first/probability"))

    def test_a_table_without_void_gets_an_id_for_it(self):
        self.config("{degrade: [{type: propagation}]}")
        table = self.dir / "room/classes.yaml"
        table.write_text("".join(table.read_text().splitlines(True)[1:]))
        self.out.mkdir()  # an empty folder may be there
        self.ok("labels degrade room.yaml --out labels")
        written = (self.out / "classes.yaml").read_text()
        self.assertEqual((written.count("id: "), written.count("ignore: true")), (7, 1), written)
        self.assertRegex(written, r"id: 0\b.*ignore: true")
        self.assertGreater(self.ids("labels/semantic_class/semantic_class_2.png").count(0), 1190)
        total = self.manifest("labels")["total"]  # figures are real numbers, whole or not
        self.assertEqual((total["accuracy"], type(total["accuracy"])), (1, float), total)

    def test_a_used_folder_and_problems_leave_nothing_behind(self):
        self.config("{degrade: [{type: region_noise, instances: [77]}]}")
        self.write("full/mine.txt", "keep")
        self.ended("labels degrade room.yaml --out full", 73, "holds files already")
        self.ended("labels degrade room.yaml --out new", 65, "no labelled training frame sees instance 77")
        self.ended("labels degrade room.yaml --out new --set scene.labels.frames=none --set 'scene.labels.degrade=[]'", 65,
                   "no training frame keeps labels")
        self.write("room/semantic_class/semantic_class_2.png", "no image")
        self.ended("labels degrade room.yaml --out new", 65, "semantic_class_2.png")
        self.assertEqual(names_in(self.dir / "full"), ["mine.txt"])
        self.assertEqual(names_in(self.dir), ["full", "room", "room.yaml"])

    def test_an_error_while_writing_removes_what_was_written(self):
        self.config("{degrade: [{type: simulated_predictions}]}")
        # Files may have 8 KiB at most: images fit, probabilities do not.
        self.ended(self.limited("-f 16", ["labels", "degrade", self.dir / "room.yaml", "--out", self.out]), 74, "probability")
        self.assertEqual(names_in(self.dir), ["room", "room.yaml"])


if __name__ == "__main__":
    main()
