#!/usr/bin/env python3
"""`semfield tune` as a program: a race on a tiny room, its file, tables and page, and going on after a kill."""

from program import *

SPACE = "axes:\n  train.rays: [16, 256]\n  rate:\n    slow: {train.adam.learning_rate: 0.0001}\n"


class Tune(ProgramCase):
    def setUp(self):
        super().setUp()
        write_room(self.dir / "room", 18)
        self.write("tiny.yaml", CONFIG.replace("ROOM", ROOM))
        self.write("space.yaml", SPACE)
        self.words = ["tune", "tiny.yaml", "--space", "space.yaml", "--steps", 64, "--time", "10m", "--out", "out"]

    def results(self):
        return {path.parent.name: path.read_text() for path in (self.dir / "out").glob("cells/*/result.json")}

    def test_a_race_writes_a_configuration_tables_and_a_page(self):
        dry = json.loads(self.ok([*self.words, "--dry-run", "--json"]).out)
        self.assertFalse((self.dir / "out").exists())
        r = self.ok(self.words)
        self.assertRegex(r.out, r'\Atune: |\n?.*\ntune: cells=\d+ best=\S+ gain=\S+ time_s=\d+ config=tiny.tuned.yaml\n\Z')
        self.assertLessEqual(len(self.results()), dry["cells"])
        written = (self.dir / "tiny.tuned.yaml").read_text()
        self.assertTrue(written.startswith("# Tuned by `semfield tune tiny.yaml --space space.yaml --steps 64 --time 10m --out out`"), written)
        self.has(written, "include: tiny.yaml")
        self.ok("config check tiny.tuned.yaml")
        self.has((self.dir / "out/tables.md").read_text(), "## Error against run time", "as configured", "rays 256")
        self.has((self.dir / "out/tune.html").read_text(), '"experiments"', '"loose":true')
        # No cell saw the test frames, and each held out training views.
        for cell in (self.dir / "out").glob("cells/*/config.yaml"):
            self.has(cell.read_text(), "hold_out: 8")
        # One process ran them, which loaded the scene once for each set of its settings.
        self.assertEqual(len({lock.read_text() for lock in (self.dir / "out").glob("cells/*/.lock")}), 1)
        # Again: nothing runs, the same file; a file of somebody else is kept.
        before = self.results()
        self.ok(self.words)
        self.assertEqual((self.results(), (self.dir / "tiny.tuned.yaml").read_text()), (before, written))
        self.write("tiny.tuned.yaml", "include: tiny.yaml\n")
        self.ended(self.words, 73, "tune did not write it")
        self.ok([*self.words, "--replace"])
        self.ended([*self.words[:-1], "out", "--seeds", 3, "--replace"], 73, "another configuration, space or plan")
        self.write("space.yaml", SPACE.replace("0.0001", "0.0002"))  # a variant of that name is another one now
        self.ended([*self.words, "--replace"], 73, "another configuration, space or plan")

    def test_a_killed_race_continues_without_loss(self):
        self.words[1:4:2] = [self.dir / "tiny.yaml", self.dir / "space.yaml"]
        self.words[-1] = self.dir / "out"
        race = self.start(*self.words)
        self.assertTrue(until(lambda: len(self.results()) >= 3), race.err())
        race.kill()
        before = self.results()
        self.ok(self.words)
        after = self.results()
        self.assertEqual({cell: after[cell] for cell in before}, before)
        record = json.loads((self.dir / "out/tune.json").read_text())
        self.assertEqual([one["name"] for one in record["rounds"]][:3], ["warm-up", "as configured", "alone"])

    def test_mistakes_are_named(self):
        self.write("space.yaml", "axes:\n  train.rayz: [3]\n")
        self.ended(self.words, 78, "space.yaml:2:", "rayz")
        self.ended(["tune", "tiny.yaml", "--for", "time", "--length", "15s"], 2, "--steps")
        self.ended(["tune", "tiny.yaml", "--time", "soon"], 2, "--time soon")


if __name__ == "__main__":
    main()
