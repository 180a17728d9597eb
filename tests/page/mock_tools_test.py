#!/usr/bin/env python3
"""The page's tools in headless Chromium against the mock server: polygons, deletion, classes that end, what is ignored, test frames, flight."""

import mock_room
import page_case
from mock_page_case import BLUE, RED, SIZE, MockPageCase


class ToolsTest(MockPageCase):
    def message(self, page, text):
        page.wait(f"document.getElementById('messages').textContent.includes({text!r})", f"no message {text!r}: {page.text('#messages')!r}")

    def test_a_polygon(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        self.room.faults.add("overlay")
        page.keys("1", "p")
        page.wait("document.getElementById('tool-polygon').getAttribute('aria-pressed') == 'true'")
        corners = [(30, 20), (70, 22), (80, 60), (35, 70)]
        for corner in corners:
            self.click(page, *corner)
        page.wait("document.getElementById('readout').textContent.includes('4 corners')")
        page.keys("backspace")
        page.wait("document.getElementById('readout').textContent.includes('3 corners')")
        self.click(page, *corners[3])
        self.assertFalse(self.room.events, "a polygon that is open labels")
        page.keys("enter")
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertEqual((event["fill"], event["class"], event["radius"], len(event["points"])), (True, "sofa", 0, 4))
        self.assertLess(max(abs(a - b) for p, q in zip(event["points"], corners) for a, b in zip(p, q)), 0.3)
        self.wait_pixel(page, 50, 45, self.mixed(0, 50, 45, [200, 60, 60]), "the polygon is not painted at once")
        photo = self.room.view(0)[0][15][3 * 20:3 * 20 + 3]
        self.wait_pixel(page, 20, 15, photo, "the polygon is painted outside")
        page.keys("2")
        for corner in ((90, 20), (110, 20), (110, 40)):  # closed by its first corner
            self.click(page, *corner)
        self.click(page, 90, 20)
        self.wait_saved(page, 2)
        page.mouse(*(self.page_of(page, x, y) for x, y in ((90, 60), (100, 60), (110, 65), (105, 80), (92, 75))))  # along the edge
        page.keys("enter")
        self.wait_saved(page, 3)
        self.assertGreater(len(self.room.events[-1]["points"]), 3)
        self.click(page, 10, 10)
        page.keys("enter")
        self.message(page, "A polygon needs three corners")
        page.keys("escape")
        self.message(page, "The polygon is dropped")
        page.keys("z")
        self.message(page, "Undone: polygon \"floor\"")
        page.keys("b")
        self.assertEqual(page.complaints(), [])

    def test_one_click_is_deleted(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        page.keys("1")
        for k, at in enumerate(((30, 40), (60, 40), (90, 40))):
            self.click(page, *at)
            self.wait_saved(page, k + 1)
        self.click(page, 60, 40)  # its own class: it is selected, not clicked again
        page.wait("!document.getElementById('selection').hidden")
        self.assertEqual(page.text("#selection-text"), 'Selected: click "sofa"')
        page.keys("delete")
        page.wait_for(lambda: [m["points"][0][0] > 45 and m["points"][0][0] < 75 for m in self.room.state(0)["marks"]], [False, False], "the click is not deleted")
        page.wait("document.getElementById('selection').hidden")
        self.message(page, "Deleted: click \"sofa\"")
        page.keys("z")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 3, "undo does not bring the click back")
        page.keys("shift+z")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 2, "redo does not delete it again")
        page.hover(*self.page_of(page, 90, 40))  # no selection: what is under the pointer
        page.wait("document.getElementById('readout').textContent.includes('Delete removes it')")
        page.keys("delete")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 1, "the click under the pointer is not deleted")
        page.keys("2")
        self.click(page, 30, 40)  # another class: a correction
        self.wait_saved(page, 4)
        self.assertTrue(page.run("return document.getElementById('selection').hidden"))
        page.hover(5, 715)
        page.keys("delete")
        self.message(page, "Point at a click")

    def test_the_eraser(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.click(page, 30, 40)
        page.mouse(self.page_of(page, 50, 30), self.page_of(page, 80, 30), self.page_of(page, 85, 50))
        self.wait_saved(page, 2)
        page.keys("x")
        page.mouse(self.page_of(page, 70, 70))
        self.message(page, "No click of this view is there")
        page.mouse(self.page_of(page, 20, 40), self.page_of(page, 40, 40), self.page_of(page, 70, 40), self.page_of(page, 70, 28))
        page.wait_for(lambda: self.room.state(0)["marks"], [], "the eraser leaves something")
        self.message(page, "Deleted: 2 clicks")
        page.keys("z", "z")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 2, "undo does not bring them back")
        self.assertEqual(self.clicks(), 2, "the eraser labels")

    def test_classes_end(self):
        self.serve(classes=("sofa",))
        page = self.open()
        for name, at in (("stool", (30, 40)), ("chair", (60, 40))):
            self.make_class(page, name)
            self.click(page, *at)
        self.wait_saved(page, 2)
        names = "[...document.querySelectorAll('#classes .name')].map((e) => e.textContent).join()"
        page.keys("2", "f2")
        page.wait("document.getElementById('class-dialog').open")
        page.run("document.getElementById('merge-into').value = 'chair'")
        page.click("#class-merge")
        page.wait(f"{names} == 'sofa,chair'")
        page.wait("[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '2'", "the clicks are not the other's")
        page.wait_for(lambda: self.room.events[-1].get("into"), "chair", "no merge arrives")
        self.message(page, "\"stool\" is merged into \"chair\", which got its 1 click.")
        page.keys("z")
        page.wait(f"{names} == 'sofa,stool,chair'", "a merge is not undone")
        page.wait("[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '1'", "the click does not come back")
        page.keys("3", "f2")
        page.wait("document.getElementById('class-dialog').open")
        page.click("#class-delete")
        page.wait("document.getElementById('question').open")
        self.assertIn("Its 1 click go with it", page.text("#question-text"))
        page.keys("enter")  # the careful answer has the focus
        self.message(page, "\"chair\" stays")
        page.keys("f2")
        page.wait("document.getElementById('class-dialog').open")
        page.click("#class-delete")
        page.wait("document.getElementById('question').open")
        page.click("#question-yes")
        page.wait(f"{names} == 'sofa,stool'")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 1, "the clicks stay")
        page.keys("z")
        page.wait(f"{names} == 'sofa,stool,chair'")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 2, "the clicks do not come back")
        page.keys("1", "f2")  # the scene's own: its colour alone
        page.wait("document.getElementById('class-dialog').open")
        self.assertEqual(page.run("return [document.getElementById('class-name').disabled, document.getElementById('class-end').hidden]"), [True, True])
        page.click("#class-cancel")

    def test_what_is_ignored(self):
        self.serve(classes=("sofa",))
        page = self.open()
        sofa = self.pixel_of(0, 4)
        self.click(page, *sofa)
        self.wait_saved(page, 1)
        far = (sofa[0] + 9, sofa[1])
        self.wait_pixel(page, *far, self.mixed(0, *far, [200, 60, 60]), "nothing is learned")
        page.keys("i")
        page.wait("document.getElementById('ignore').getAttribute('aria-pressed') == 'true'")
        page.keys("]", "]", "]")
        page.mouse(self.page_of(page, far[0] - 2, far[1]), self.page_of(page, far[0] + 2, far[1]))
        self.wait_saved(page, 2)
        self.assertEqual(self.room.events[-1]["class"], "void")
        page.wait("document.querySelector('#ignore .clicks').textContent == '1'")
        x, y = self.page_of(page, far[0], far[1] + 3)
        near = page.pixels([(x + dx, y) for dx in range(16)])
        self.assertTrue(all(max(p) - min(p) < 60 for p in near), f"they are not grey: {near}")
        self.assertGreater(max(map(sum, near)) - min(map(sum, near)), 3 * 60, f"no stripes: {near}")
        self.assertEqual(page.run("return [...document.querySelectorAll('#classes .clicks')].map((e) => e.textContent)"), ["1"])

    def test_test_frames_are_looked_at(self):
        self.serve(classes=("sofa",), held_out=2)
        page = self.open()
        self.click(page, *self.pixel_of(0, 4))
        self.wait_saved(page, 1)
        page.keys("end")
        page.wait("document.querySelector('#strip [aria-current=true]').dataset.view == 5")
        self.assertEqual(page.text("#strip [aria-current=true] .badge"), "test")
        there = self.pixel_of(5, 4)
        self.wait_pixel(page, *there, self.mixed(5, *there, [200, 60, 60]), "a test frame has no labels")
        page.wait("document.getElementById('readout').textContent.includes('Held out for tests')")
        self.click(page, *there)
        self.message(page, "rgb_05 is held out for tests")
        page.keys("p")
        self.click(page, *there)
        self.message(page, "rgb_05 is held out for tests")
        page.keys("enter")
        self.assertEqual((len(self.room.events), len(self.room.received)), (1, 1), "a label of a test frame was sent")

    def test_clicks_of_other_views_are_shown(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.click(page, *self.pixel_of(0, 4))
        self.wait_saved(page, 1)
        place = self.room.place(0, self.room.events[0]["points"][0])
        view = next(k for k in range(1, 6) if mock_room.is_seen(self.room.cameras[k], place) and mock_room.pixel_of(self.room.cameras[k], *SIZE, place))
        page.run(f"document.querySelector('#strip [data-view=\"{view}\"]').click()")
        at = mock_room.pixel_of(self.room.cameras[view], *SIZE, place)
        x, y = self.page_of(page, *at)
        around = ((1, 0), (-1, 0), (0, 1), (0, -1))
        for _ in range(60):  # a light ring
            ring, far = ([page.pixels([(x + r * dx, y + r * dy)])[0] for dx, dy in around] for r in (3.5, 9))
            if sum(map(sum, ring)) > sum(map(sum, far)) + 120:
                break
        else:
            self.fail(f"the click of another view is not shown: {ring} in {far}")
        page.hover(x, y)
        page.wait("document.getElementById('readout').textContent.includes('(clicked as sofa in rgb_00)')")

    def test_a_click_in_flight_labels(self):
        self.serve(classes=("sofa",), held_out=1)
        page = self.open()
        page.keys("f")
        page.wait("/\\d+ x \\d+, \\d+ ms/.test(document.getElementById('readout').textContent)", "no picture of the free camera")
        middle = self.page_of(page, SIZE[0] / 2, SIZE[1] / 2)
        page.mouse(middle)
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertNotEqual(event["frame"], "rgb_05")
        self.message(page, f"Clicked as \"sofa\" in {event['frame']}, which shows this place best")
        seen = self.room.view(self.room.frames.index(event["frame"]))[1][int(event["points"][0][1])][int(event["points"][0][0])]
        self.assertEqual(seen, self.room.view(0)[1][SIZE[1] // 2][SIZE[0] // 2], "something else was labelled")
        self.room.faults.add("hidden")
        page.mouse((middle[0] + 60, middle[1]))
        page.wait("document.querySelector('#messages .error')?.textContent.includes('no surface here to label. Fly nearer')")
        self.assertEqual(self.clicks(), 1)
        page.keys("v")
        page.wait("document.getElementById('fly').getAttribute('aria-pressed') == 'false'", "v does not land")
        self.message(page, "is the nearest photograph")

    def test_a_photograph_is_sharp(self):
        self.serve(classes=("sofa",), photo_scale=16)  # 1920 x 1440
        page = self.open()
        page.keys("o")
        page.wait_for(lambda: (0, 1024) in self.room.photos, True, "a larger photograph is not asked for")
        self.assertIn((0, 120), self.room.photos, "what the program has at hand comes first")
        at = self.page_of(page, 64, 45)
        for _ in range(9):
            page.wheel(*at, -240)
        # It has 1920 pixels: a page that has those asks for no more.
        page.wait_for(lambda: any((0, most) in self.room.photos for most in (2048, 4096, 0)), True, "no full photograph when zoomed in")
        for _ in range(60):  # a line of one of its pixels
            row = page.pixels([(at[0] + dx, at[1]) for dx in range(-12, 13)])
            white = [min(p) > 235 for p in row]
            if any(white):
                break
        else:
            self.fail(f"no line: {row}")
        self.assertLess(sum(white), 24, "the line is as wide as a pixel that trains")
        page.mouse((at[0] + 3, at[1]))
        self.wait_saved(page, 1)
        x = self.room.events[-1]["points"][0][0]
        self.assertNotEqual(round(x, 2), round(x, 1), "a click has no place within a tenth of a pixel that trains")

    def test_every_key_says_something(self):
        self.serve(classes=("sofa",))
        page = self.open()
        for keys, words in (("7", "No class has the key 7"), ("enter", "Move a cross"), ("delete", "Point at a click"), ("c", "no label under the pointer"),
                            ("v", "goes from a flight"), ("left", "This is the first view"), ("x", "Eraser:"), ("p", "Polygon:"), ("b", "Brush:"),
                            ("z", "nothing to undo"), ("shift+z", "nothing to redo"), ("g", "There is no guess")):
            page.hover(5, 715)
            page.keys(keys)
            self.message(page, words)
        page.keys("end", "right")
        self.message(page, "This is the last view")
        box = page.box("#canvas")
        page.mouse((box["x"] + 3, box["y"] + 3))
        self.message(page, "Click into the picture")


if __name__ == "__main__":
    page_case.main()
