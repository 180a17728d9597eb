#!/usr/bin/env python3
"""`semfield labels export` and `semfield labels classes` on a tiny room; what was exported is read back and compared with what the
program renders. `render` shows pixels as stored; what is exported for tools, and what degrade writes, is as viewers
show the photographs, which an EXIF orientation turns."""

import shutil

from program import *

TURNS = (1, 3, 6, 8, 5, 7)  # of the room's photographs, 40 x 30 pixels


def set_orientation(path, turn):
    chunk = b"eXIf" + bytes((77, 77, 0, 42, 0, 0, 0, 8, 0, 1, 1, 18, 0, 3, 0, 0, 0, 1, 0, turn, 0, 0))
    data = path.read_bytes()
    path.write_bytes(data[:-12] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) +
                     data[-12:])


def shown(turn, pixels):
    """Pixels turned by hand: 3 by half, 6 to the right, 8 to the left, 5 mirrored about one diagonal, 7 about the
    other."""
    out = bytearray(len(pixels))
    for p, value in enumerate(pixels):
        y, x = divmod(p, 40)
        row, column = {1: (y, x), 3: (29 - y, 39 - x), 6: (x, 29 - y), 8: (39 - x, y), 5: (x, y),
                       7: (39 - x, 29 - y)}[turn]
        out[row * (30 if turn >= 5 else 40) + column] = value
    return bytes(out)


class Labels(ProgramCase):
    def config(self, scene):
        self.write("room.yaml", f"include: {SOURCE}/configs/presets/room.yaml\nscene: {{{scene}}}\n")

    def ids(self, path):
        return png_bytes(self.dir / path)

    def given(self, name):
        """By `degrade`, a map of each photograph."""
        self.ok(f"labels degrade room.yaml --out {name}")
        return [self.ids(f"{name}/semantic_class/semantic_class_{i}.png") for i in range(len(TURNS))]

    def test_exports_are_as_rendered_and_shown(self):
        write_room(self.dir / "room", len(TURNS))
        (self.dir / "labels").mkdir()
        labels = [shown(turn, self.ids(f"room/semantic_class/semantic_class_{i}.png")) for i, turn in enumerate(TURNS)]
        for i, turn in enumerate(TURNS):
            set_orientation(self.dir / f"room/rgb/rgb_{i}.png", turn)
            width = 30 if turn >= 5 else 40
            rows = [labels[i][at:at + width] for at in range(0, 1200, width)]
            png(self.dir / f"labels/{i}.png", width, len(rows), 0, 8, rows)
        for name in ("semantic_class", "semantic_instance"):
            shutil.rmtree(self.dir / "room" / name)
        scene = "type: replica, root: room, train_step: 1, test_step: 0"
        own = "{type: images, folder: labels, pattern: '{number}.png'}"
        self.config(f"{scene}, labels: {{from: {own}}}")
        self.assertEqual(self.given("given"), labels)
        # A packed scene still knows how its photographs are shown.
        self.ok("pack room.yaml --out room.sfpack")
        self.ok("train room.yaml --steps 20 --threads 1 --out run -q")
        self.ok("render run --split train --out rendered -q")
        rendered = [shown(turn, self.ids(f"rendered/rgb_{i}_label.png")) for i, turn in enumerate(TURNS)]
        for form, reader in (("coco", "type: coco, file: coco.x"), ("coco_rle", "type: coco, file: coco_rle.x"),
                             ("labelme", "type: labelme, folder: labelme.x"),
                             ("png", "type: images, folder: png.x, pattern: '{name}_label.png'")):
            self.has(self.ok(f"labels export run --split train --min-area 0 --format {form} --out {form}.x").out,
                     "export: frames=6 ")
            self.config(f"{scene}, labels: {{from: {{{reader}}}}}")
            self.assertEqual(self.given(f"{form}_back"), rendered, form)
        self.config(f"type: packed, file: room.sfpack, labels: {{from: {own}}}")
        self.assertEqual(self.given("packed"), labels)
        # Maps that were rendered, and clicks of the page, are of pixels as stored; clicks in a table are of those shown.
        self.config(f"{scene}, labels: {{from: {{type: images, folder: rendered, pattern: '{{name}}_label.png'}}}}")
        self.assertEqual(self.given("rendered_back"), rendered)
        dot = lambda at: bytes(p == at for p in range(1200))
        self.write("clicks.csv", "".join(f"rgb_{i},2,1,west\n" for i in range(len(TURNS))))
        self.config(f"{scene}, labels: {{from: {{type: clicks, file: clicks.csv}}}}")
        self.assertEqual(self.given("clicked"), [dot(2 + (30 if turn >= 5 else 40)) for turn in TURNS])
        self.write("clicks.jsonl", "".join(
            f'{{"id":"{i}","type":"click","frame":"rgb_{i}","size":[40,30],"points":[[2.5,1.5]],"radius":0,"class":"west"}}\n'
            for i in range(len(TURNS))))
        self.config(f"{scene}, labels: {{from: {{type: clicks, file: clicks.jsonl}}}}")
        self.assertEqual(self.given("clicked_on_the_page"), [shown(turn, dot(42)) for turn in TURNS])
        # Probabilities are written as shown, and read so.
        self.config(f"{scene}, labels: {{from: {own}, degrade: [{{type: simulated_predictions, strength: 0}}]}}")
        self.assertEqual(self.given("soft"), labels)
        self.config(f"{scene}, labels: {{from: {{type: npz, folder: soft/probability, pattern: '{{name}}.npy'}}}}")
        self.assertEqual(self.given("soft_back"), labels)
        # A run that loads its images smaller: labels have the size of the images, unless an option says otherwise.
        for size, width in (("stored", 40), ("trained", 20)):
            self.ok(f"labels export run --split train --set scene.load.downscale=2 --size {size} --out half.json")
            self.assertEqual(json.loads((self.dir / "half.json").read_text())["images"][0]["width"], width)
        # No region of the exported labels is smaller than asked.
        calm = self.ok("labels export run --split train --min-area 90 --format coco --out calm.json")
        self.has(calm.err, " regions of fewer than 90 pixels")
        regions = json.loads((self.dir / "calm.json").read_text())["annotations"]
        self.assertGreaterEqual(min(region["area"] for region in regions), 90)
        self.has(self.semfield("labels export run --format coc --out x.json").err, "coco?", "[usage.value.invalid]")

    def test_probabilities_and_fused_maps_are_as_shown(self):
        """Frame 0 is shown upside down; the room's own label images are drawn over it so."""
        write_room(self.dir / "room")
        set_orientation(self.dir / "room/rgb/rgb_0.png", 3)
        own = "semantic_class/semantic_class_0.png"
        self.config(ROOM[1:-1])
        self.ok("labels fuse room.yaml --method monocular --out maps")
        self.assertEqual(self.ids("maps/monocular/rgb_0_label.png"), self.ids(f"room/{own}"))
        self.config(f"{ROOM[1:-1]}, labels: {{degrade: [{{type: simulated_predictions}}]}}")
        self.ok("labels degrade room.yaml --out given")
        data = (self.dir / "given/probability/rgb_0.npy").read_bytes()
        soft = struct.unpack("<7200f", data[-28800:])
        best = [max(range(6), key=lambda k: soft[p + k]) + 1 for p in range(0, 7200, 6)]
        self.assertEqual(bytes(best), self.ids(f"given/{own}"))

    def test_classes_converts_tables(self):
        nyu = self.ok("labels classes nyu40").out
        self.assertEqual((nyu.count("{id: "), 'id: 5, name: "chair"' in nyu), (41, True), nyu)
        self.ok("labels classes scannet20 --format cvat --out labelmap.txt")
        rows = self.ok("labels classes labelmap.txt --format csv").out.splitlines()
        self.assertEqual((rows[:3], len(rows)), (["class_id,class", "0,void", "1,wall"], 22))
        self.assertNotEqual(self.ok("labels classes nyu13 --colors semfield").out, self.ok("labels classes nyu13").out)
        self.write("l.tsv", "id\traw_category\tnyu40id\n2\toffice chair\t5\n")
        self.has(self.ok("labels classes l.tsv --ids nyu40").out, '{id: 5, name: "chair"')
        self.has(self.ok("labels classes l.tsv").out, '{id: 2, name: "office chair"')
        self.ended("labels classes nyu13 --ids nyu40", 2, "semfield: --ids nyu40", "'nyu13'",
                   "scannetv2-labels.combined.tsv", "[usage.flag.conflict]")


if __name__ == "__main__":
    main()
