#!/usr/bin/env python3
"""`semfield objects` as a user runs it: files, figures, segments of a folder, things that a person clicks, refusals."""

import shutil

from program import *

QUICK = "--set objects.steps=150 --set objects.points=3000 --set objects.rays=20000"


class Objects(ProgramCase):
    def trained(self, instances="12"):
        """A run of the analytic room, whose instances are its classes, or which has none."""
        self.room(150, more="losses: [{type: depth, weight: 0.3}]\n")
        subprocess.run([os.environ["SEMFIELD_ANALYTIC_ROOM"], self.dir / "room.sfpack", instances], check=True)
        self.ok("train config.yaml --out run --quiet")

    def views(self):
        """Its classes plus one, a map of 48 x 36 pixels for each view's name."""
        self.ok("pack config.yaml --format replica --out captured")
        return {f"view_{i:02}": self.dir / f"captured/semantic_class/semantic_class_{i}.png" for i in range(12)}

    def read(self, path):
        return json.loads((self.dir / path).read_text())

    def test_files_figures_and_the_same_again(self):
        self.trained("instances")
        said = json.loads(self.ok(f"objects run --score --json {QUICK}").out)
        self.assertGreater(said["score"]["mcov"], 0.3)
        counts = said["score"]["counts"]
        self.assertEqual(sum(count["found"] for count in counts.values()), said["objects"])
        wrong = sum(abs(count["found"] - count["true"]) for count in counts.values())
        self.assertAlmostEqual(said["score"]["miscounted"], wrong / sum(count["true"] for count in counts.values()))
        self.assertEqual(len(self.read("run/objects/objects.json")["objects"]), said["objects"])
        self.assertGreater(said["objects"], 0)
        name = self.read("run/objects/panoptic.json")["images"][0]["file_name"]
        ids = png_bytes(self.dir / "run/objects/instance" / name)
        ids = struct.unpack(f">{len(ids) // 2}H", ids)
        colors = png_bytes(self.dir / "run/objects/panoptic" / name)
        self.assertEqual([colors[3 * i] + 256 * colors[3 * i + 1] for i, id in enumerate(ids) if id],
                         [id for id in ids if id])
        # Found anew, the same objects get the edits that were made of them; others are refused.
        first = (self.dir / "run/objects/objects.csv").read_text()
        ids = sound_tensors(self.dir / "run/objects/found.safetensors", 0)["id"]
        digest = 0xcbf29ce484222325  # FNV-1a of 32 bits a point
        for byte in b"".join(ids[at:at + 4] for at in range(0, len(ids), 8)):
            digest = (digest ^ byte) * 0x100000001b3 % 2**64
        edits = json.dumps({"objects": f"{digest:016x}", "edits": [{"do": "rename", "object": 1, "name": "mine"}]})
        self.write("again/edits.json", edits)
        again = f"objects run --out again {QUICK}"
        self.assertEqual(json.loads(self.ok(f"{again} --json").out)["edits"], 1)
        self.has((self.dir / "again/objects.csv").read_text(), "1,mine,")
        self.has((self.dir / "again/objects.json").read_text(), '"mine"')
        # Files of the surface have the names of the edits.
        own = self.write("run/objects/edits.json", edits)
        self.ok("mesh run --out room.glb --color photo --resolution 32")
        self.assertIn(b'"mine"', (self.dir / "room.glb").read_bytes())
        self.has((self.dir / "room.json").read_text(), '"mine"')
        with open(self.dir / "run/objects/.lock") as alone:
            fcntl.flock(alone, fcntl.LOCK_EX)
            self.ended(f"objects run {QUICK}", 73, "[objects.folder.busy]", "run/objects")
        own.unlink()
        self.ended(f"{again} --set objects.points=2000", 65, "[objects.edits.foreign]", "again/edits.json")
        shutil.rmtree(self.dir / "again")
        self.ok(f"{again} --threads 1")
        self.assertEqual((self.dir / "again/objects.csv").read_text(), first, "threads changed a number")

    def test_segments_of_a_folder_and_settings_of_the_method(self):
        self.trained()
        (self.dir / "segments").mkdir()
        for name, file in self.views().items():
            shutil.copy(file, self.dir / f"segments/{name}.png")
        for method in ("", "--set 'objects.method={type: contrastive, dims: 4}'"):
            self.has(self.ok(f"objects run --segments segments {method} {QUICK}").out, "objects: objects=", "segments=")
        none = self.ok(f"objects run --segments segments --set objects.least_points=100000 {QUICK} --out none")
        self.has(none.out + none.err, "objects=0", "segments became an object", "show on the surface",
                 "objects.least_points")
        self.ended(f"objects run {QUICK}", 65, "[objects.segments.none]", "--segments")
        self.ended(f"objects run --segments segments --score --out scored {QUICK}", 65, "[objects.truth.none]")
        self.assertFalse((self.dir / "scored").exists(), "refused before anything is written")

    def test_things_that_a_person_clicks(self):
        self.trained()
        maps = {name: png_bytes(file) for name, file in self.views().items() if int(name[5:]) % 4 != 3}

        def click(id, name, **more):
            """Into the middle of what is most of a class in a training view."""
            view = max(maps, key=lambda view: maps[view].count(id))
            its = [divmod(p, 48) for p, value in enumerate(maps[view]) if value == id]
            row, column = (sum(at) // len(its) for at in zip(*its))
            return json.dumps({"id": f"c{id}", "type": "click", "frame": view, "size": [48, 36], "radius": 1,
                               "points": [[column + 0.5, row + 0.5]], "class": name, **more}) + "\n"

        self.write("clicks.jsonl", click(1, "wall") + click(5, "crate", object=2) + click(4, "ball"))
        said = json.loads(self.ok(f"objects run --segments clicks.jsonl --json {QUICK}").out)
        self.assertEqual(said["objects"], 2, "a wall is no object")
        table = self.read("run/objects/objects.json")["objects"]
        self.assertEqual([row["class"] for row in table], ["crate", "ball"], "in the order of the clicks")
        self.assertGreater(table[1]["points"], 10)
        self.write("walls.jsonl", click(1, "wall"))
        self.ended(f"objects run --segments walls.jsonl {QUICK}", 65, "[objects.segments.none]", "none of 1 clicks")


if __name__ == "__main__":
    main()
