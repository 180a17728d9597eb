#!/usr/bin/env python3
"""The page in headless Chromium against the mock server: what a person does, what is seen, and what happens when things break."""

import sys
import unittest

import browser
import mock_room
import mock_server

SIZE = (120, 90)
RED, BLUE = [230, 75, 70], [70, 150, 240]  # the first colours that the page offers
RING = [255, 213, 74]


class PageTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.driver = browser.Driver()

    @classmethod
    def tearDownClass(cls):
        cls.driver.close()

    def serve(self, **options):
        self.room = mock_server.Room(views=options.pop("views", 6), size=SIZE, **options)
        self.server = mock_server.Server(self.room)
        self.url = self.server.start()
        self.addCleanup(lambda: self.server.http.ended or self.server.stop())

    def open(self, width=1280, height=720):
        page = self.driver.browser(width, height)
        self.addCleanup(self.driver.give_back, page)
        page.open(self.url)
        page.wait("document.getElementById('connection').textContent == 'connected' && document.querySelector('#strip img[src]')", "the page does not start")
        return page

    def page_of(self, page, x, y):
        """Where a pixel of the fitted view lies on the page."""
        box = page.box("#canvas")
        scale = min((box["width"] - 16) / SIZE[0], (box["height"] - 16) / SIZE[1])
        return (box["x"] + (box["width"] - scale * SIZE[0]) / 2 + x * scale, box["y"] + (box["height"] - scale * SIZE[1]) / 2 + y * scale)

    def click(self, page, x, y):
        page.mouse(self.page_of(page, x, y))
        page.hover(5, 715)

    def make_class(self, page, name):
        page.keys("n")
        page.wait("document.getElementById('class-dialog').open")
        page.type(name)
        page.keys("enter")
        page.wait("!document.getElementById('class-dialog').open")

    def wait_saved(self, page, clicks):
        page.wait_for(lambda: sum(e["type"] == "click" for e in self.room.events), clicks, "clicks do not arrive")
        page.wait("document.getElementById('saving').textContent == 'every click is saved'", "not saved")

    def wait_pixel(self, page, x, y, want, why, tolerance=14):
        """Until the page shows about this colour at a pixel of the view."""
        seen = None
        for _ in range(60):
            seen = page.pixels([self.page_of(page, x, y)])[0]
            if max(abs(a - b) for a, b in zip(seen, want)) <= tolerance:
                return
        self.fail(f"{why}: {seen} at {x}, {y}, not {want}")

    def mixed(self, view, x, y, color):
        """The photograph with the overlay at its first opacity."""
        photo = self.room.view(view)[0][int(y)][3 * int(x):3 * int(x) + 3]
        return [0.45 * a + 0.55 * b for a, b in zip(photo, color)]

    def pixel_of(self, view, which):
        """A pixel well inside an object of the room."""
        objects = self.room.view(view)[1]
        inside = [(i + 0.5, j + 0.5) for j in range(8, SIZE[1] - 8) for i in range(8, SIZE[0] - 8)
                  if all(objects[j + dj][i + di] == which for dj in (-5, 0, 5) for di in (-5, 0, 5))]
        return inside[len(inside) // 2]

    def test_what_a_person_does(self):
        self.serve()
        page = self.open()
        self.assertIn("Name the first class", page.text("#welcome"))
        self.room.faults.add("overlay")  # nothing is learned yet: what is seen is painted by the page
        sofa, floor = self.pixel_of(0, 4), self.pixel_of(0, 0)
        self.click(page, *sofa)  # without a class: the dialog opens, and the click is made with the new class
        page.wait("document.getElementById('class-dialog').open")
        page.type("sofa")
        page.keys("enter")
        self.wait_saved(page, 1)
        event = next(e for e in self.room.events if e["type"] == "click")
        self.assertEqual((event["class"], event["frame"], event["size"]), ("sofa", "rgb_00", list(SIZE)))
        self.assertLess(max(abs(a - b) for a, b in zip(event["points"][0], sofa)), 0.3)
        beside = (sofa[0] + 2, sofa[1])  # inside the brush, beside the mark
        self.wait_pixel(page, *beside, self.mixed(0, *beside, RED), "a click is not painted at once")

        self.room.faults.clear()
        self.room.learn()
        far = (sofa[0] + 5, sofa[1])
        self.wait_pixel(page, *far, self.mixed(0, *far, RED), "the overlay that was learned is not shown")
        page.keys("right")
        page.wait("document.querySelector('#strip [aria-current=true]').dataset.view == 1")
        there = self.pixel_of(1, 4)
        self.wait_pixel(page, *there, self.mixed(1, *there, RED), "another view has no labels")
        page.keys("left")

        self.make_class(page, "floor")  # the floor was taken for the sofa: click again with the right class
        self.click(page, *floor)
        self.wait_saved(page, 2)
        other = (floor[0] + 9, floor[1])
        self.wait_pixel(page, *other, self.mixed(0, *other, BLUE), "a correction is not shown")
        page.keys("1")
        page.mouse(self.page_of(page, *sofa), self.page_of(page, sofa[0] - 4, sofa[1] + 2), self.page_of(page, sofa[0] - 8, sofa[1]))
        self.wait_saved(page, 3)
        self.assertGreater(len(self.room.events[-1]["points"]), 2)

        page.wait("document.getElementById('proposal-text').textContent.startsWith('Click proposed')")
        proposal = self.room.state(0)["proposal"]
        page.keys("end")
        page.wait("document.querySelector('#strip [aria-current=true]').dataset.view == 5")
        page.keys("space")
        page.wait(f"document.querySelector('#strip [aria-current=true]').dataset.view == {proposal['view']}")
        x, y = self.page_of(page, *proposal["at"])
        ring = [page.pixels([(x + dx, y + dy)])[0] for dx, dy in ((16, 0), (-16, 0), (0, 16), (0, -16))]
        self.assertTrue(all(max(abs(a - b) for a, b in zip(pixel, RING)) < 60 for pixel in ring), f"no ring: {ring}")
        page.keys("2", "space")
        self.wait_saved(page, 4)
        self.assertEqual((self.room.events[-1]["class"], self.room.events[-1]["points"][0]), ("floor", proposal["at"]))
        page.wait("document.getElementById('proposal-text').textContent.startsWith('Click proposed')")
        before = self.room.state(0)["proposal"]["id"]
        page.keys("s")
        page.wait_for(lambda: self.room.events[-1]["type"], "skip", "no skip arrives")
        self.assertNotEqual(self.room.state(0)["proposal"]["id"], before)

        page.keys("home", "e")
        page.wait("!document.getElementById('legend').hidden")
        yellow = page.run("return import('./colors.js').then(({kEntropyColors}) => [kEntropyColors[40], kEntropyColors[220]])")
        wall = self.pixel_of(0, 2)
        self.wait_pixel(page, *far, self.mixed(0, *far, yellow[0]), "no entropy of what is known")
        self.wait_pixel(page, *wall, self.mixed(0, *wall, yellow[1]), "no entropy of what is unknown")
        page.keys("e")

        page.click("[data-what=labels]")
        page.wait("document.querySelectorAll('#export-list a').length == 6")
        self.assertEqual(page.run("return fetch(document.querySelector('#export-list a').href).then((a) => a.text())"), "exported")
        page.click("[data-what=mesh]")
        page.wait("document.getElementById('export-list').textContent.includes('Train for a minute')")
        self.assertEqual(page.complaints(), [])

    def test_free_camera(self):
        self.serve(classes=("sofa",))
        page = self.open()
        page.keys("f")
        page.wait("/\\d+ x \\d+, \\d+ ms/.test(document.getElementById('readout').textContent)", "no picture of the free camera")
        page.wait_for(lambda: [size for size, full in self.room.flights if full][-2:], [320, 640], "no full pictures when it stands still")
        self.assertFalse(self.room.flights[0][1], "the first picture is no quick one")
        middle = [self.page_of(page, SIZE[0] * k / 8, SIZE[1] / 2) for k in range(1, 8)]
        before = page.pixels(middle)
        page.run("window.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}))")
        page.mouse(self.page_of(page, 60, 45), self.page_of(page, 20, 45))
        for _ in range(60):
            seen = page.pixels(middle)
            if any(max(abs(a - b) for a, b in zip(p, q)) > 20 for p, q in zip(before, seen)):
                break
        else:
            self.fail("looking around changes nothing")
        self.assertFalse(all(full for _, full in self.room.flights[3:]), "no quick picture while it moves")
        self.assertFalse(self.room.events, "a drag of the free camera labels")
        page.keys("escape")
        page.wait("document.getElementById('fly').getAttribute('aria-pressed') == 'false'")
        here = self.pixel_of(0, 2)
        self.wait_pixel(page, *here, self.mixed(0, *here, self.room.view(0)[0][int(here[1])][3 * int(here[0]):][:3]), "the view does not come back")

    def test_keyboard_alone(self):
        self.serve()
        page = self.open()
        page.keys("n")
        page.wait("document.getElementById('class-dialog').open")
        page.keys("enter")
        self.assertIn("needs a name", page.text("#class-problem"))
        page.type("lamp")
        page.keys("tab", "right", "enter")
        page.wait("!document.getElementById('class-dialog').open || document.activeElement.closest('#swatches')")
        if page.run("return document.getElementById('class-dialog').open"):
            page.click("#class-ok")
        page.keys(*["shift+right"] * 4, "shift+down", "enter")
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertEqual([event["class"], event["points"]], ["lamp", [[SIZE[0] / 2 + 8.5, SIZE[1] / 2 + 2.5]]])
        self.assertEqual(self.room.events[0]["color"], BLUE)
        page.keys("z")
        page.wait("document.querySelectorAll('#classes [aria-checked=true] .clicks')[0].textContent == ''")
        page.keys("shift+z")
        page.wait("document.querySelectorAll('#classes [aria-checked=true] .clicks')[0].textContent == '1'")
        page.wait_for(lambda: [e["type"] for e in self.room.events], ["class", "click", "undo", "undo"], "undo and redo do not arrive")
        self.assertEqual([e["id"] for e in self.room.alive(self.room.events)], [e["id"] for e in self.room.events[:2]])
        page.keys("f2")
        page.wait("document.getElementById('class-dialog').open")
        page.type("ball")
        page.keys("enter")
        page.wait("document.querySelector('#classes .name').textContent == 'ball' && document.getElementById('saving').textContent == 'every click is saved'")
        page.keys("space")
        page.keys("space")
        self.wait_saved(page, 2)
        self.assertEqual(self.room.events[-1]["class"], "ball")
        page.keys("?")
        page.wait("document.getElementById('help-dialog').open")
        page.keys("escape")
        page.wait("!document.getElementById('help-dialog').open")
        # Tab reaches every control of the page, and each shows the focus.
        page.run("document.activeElement.blur()")
        reached = {}
        for _ in range(40):
            page.keys("tab")
            name, outline = page.run("const e = document.activeElement; return [e.id || e.getAttribute('data-what') || e.getAttribute('aria-label') || e.tagName, getComputedStyle(e).outlineStyle]")
            reached[name] = outline
        for name in ("order", "show-photo", "show-entropy", "opacity", "radius", "fly", "help", "canvas", "proposal-skip", "new-class", "labels", "mesh"):
            self.assertIn(name, reached)
        self.assertEqual([name for name, outline in reached.items() if outline == "none" and name != "BODY"], [])

    def test_an_unsent_click_outlives_a_reload(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.room.faults.add("event")
        self.click(page, 30.5, 40.5)
        page.wait("document.getElementById('saving').textContent == '1 not saved yet'")
        page.wait("document.querySelector('#messages .error')?.textContent.includes('no space left on the disk. Make room')")
        page.reload()
        page.wait("document.getElementById('saving').textContent == '1 not saved yet'", "a reload loses a click")
        self.assertFalse(self.room.events)
        self.wait_pixel(page, 32.5, 40.5, self.mixed(0, 32.5, 40.5, [200, 60, 60]), "the unsent click is not shown")
        self.room.faults.clear()
        self.wait_saved(page, 1)
        page.wait("!document.querySelector('#messages .error')", "a message stays when all is saved")
        page.reload()
        self.wait_saved(page, 1)
        page.keys("z")  # the tab remembers what it did
        page.wait("document.querySelector('#messages').textContent.includes('Undone: click')")
        page.wait("document.getElementById('saving').textContent == ''")
        self.assertEqual(self.room.state(0)["marks"], [])

    def test_an_answer_that_is_lost(self):
        self.serve(classes=("sofa",))
        page = self.open()
        for clicks, fault in ((1, "drop"), (2, "lost")):  # stored, but the answer never comes; or not even that
            self.room.faults.add(fault)
            self.click(page, 30.5 * clicks, 40.5)
            self.wait_saved(page, clicks)
        ids = [event["id"] for event in self.room.events]
        self.assertEqual(self.room.received, [ids[0], ids[0], ids[1], ids[1]])

    def test_a_refused_click_is_taken_back(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.room.faults.add("refuse")
        self.click(page, 30.5, 40.5)
        page.wait("document.querySelector('#messages .error')?.textContent.includes('held out for tests label another view')")
        page.wait("document.getElementById('saving').textContent == '' && document.querySelector('#classes .clicks').textContent == ''")
        self.room.faults.clear()
        self.click(page, 60.5, 40.5)
        self.wait_saved(page, 1)

    def test_a_lost_connection(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        page.keys("1")
        self.click(page, 30.5, 40.5)
        self.wait_saved(page, 1)
        self.server.stop()
        page.wait("document.getElementById('connection').textContent == 'Connection lost, trying again; nothing is lost.'")
        page.keys("2")
        self.click(page, 60.5, 70.5)
        page.wait("document.getElementById('saving').textContent == '1 not saved yet'")
        self.room.revision = 0  # another process counts anew
        self.server.start()
        page.wait("document.getElementById('connection').textContent == 'connected'", "the page does not come back")
        self.wait_saved(page, 2)
        self.assertEqual(self.room.events[-1]["class"], "floor")
        page.wait("document.querySelectorAll('#classes .clicks')[1].textContent == '1'")

    def test_an_acknowledged_event_of_an_ended_process(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.click(page, 30.5, 40.5)
        self.wait_saved(page, 1)
        self.room.faults.add("silent")  # the answer comes, a new state does not
        self.room.revision += 1000
        page.keys("z")
        page.wait("document.querySelector('#classes .clicks').textContent == '' && document.getElementById('saving').textContent == ''")
        page.wait_for(lambda: self.room.events[-1]["type"], "undo", "no undo arrives")
        self.server.stop()
        page.wait("document.getElementById('connection').textContent.startsWith('Connection lost')")
        self.room.faults.clear()
        self.room.revision = 1  # another process counts anew
        self.server.start()
        page.wait("document.getElementById('connection').textContent == 'connected'")
        self.room.apply({"id": "somebody-1", "type": "undo", "of": self.room.events[-1]["id"]})
        page.wait("document.querySelector('#classes .clicks').textContent == '1'", "an undo that is stored hides for ever")

    def test_two_browsers(self):
        self.serve()
        one, two = self.open(), self.open()
        self.make_class(one, "sofa")
        self.room.faults.add("overlay")
        self.click(one, 30.5, 40.5)
        two.wait("document.querySelector('#classes .clicks')?.textContent == '1'", "the other browser sees no click")
        self.wait_pixel(two, 32.5, 40.5, self.mixed(0, 32.5, 40.5, RED), "the other browser shows no click")
        two.keys("z")
        two.wait("document.querySelector('#messages').textContent.includes('nothing to undo')", "a browser undoes another's click")
        self.click(two, 60.5, 70.5)
        one.wait("document.querySelector('#classes .clicks')?.textContent == '2'")
        one.keys("z")
        two.wait("document.querySelector('#classes .clicks')?.textContent == '1'")
        self.assertEqual([m["points"][0][0] > 50 for m in self.room.state(0)["marks"]], [True])

    def test_one_picture_at_a_time(self):
        self.serve(classes=("sofa",))
        page = self.open()
        self.click(page, *self.pixel_of(0, 4))
        self.wait_saved(page, 1)
        self.room.faults.add("picture")
        self.room.most_pictures = 0
        page.keys(*["right"] * 5)
        there = self.pixel_of(5, 4)
        self.wait_pixel(page, *there, self.mixed(5, *there, [200, 60, 60]), "the last view has no labels")
        self.assertEqual(self.room.most_pictures, 1)

    def test_fingers(self):
        self.serve(classes=("sofa",))
        page = self.open(820, 1180)
        self.room.faults.add("overlay")
        at = self.page_of(page, 60, 45)
        page.fingers([at])
        self.wait_saved(page, 1)
        page.fingers([at, (at[0] + 40, at[1]), (at[0] + 80, at[1] + 10)])
        self.wait_saved(page, 2)
        self.assertGreater(len(self.room.events[-1]["points"]), 1)
        corner = self.page_of(page, 2, 2)
        before = page.pixels([corner])
        page.fingers([(at[0] - 40, at[1]), (at[0] - 200, at[1])], [(at[0] + 40, at[1]), (at[0] + 200, at[1])])
        self.assertEqual(len(self.room.events), 2, "a pinch labels")
        x = 60 - 40 / ((min(page.box("#canvas")["width"] - 16, (page.box("#canvas")["height"] - 16) * 4 / 3)) / SIZE[0])
        photo, label = self.room.view(0)[0][45][3 * int(x):3 * int(x) + 3], self.mixed(0, x, 45, [200, 60, 60])
        seen = page.pixels([(at[0] - 200, at[1])])[0]
        apart = [sum(abs(a - b) for a, b in zip(seen, other)) for other in (photo, label)]
        self.assertLess(*apart, "the first finger of a pinch leaves a stroke")
        page.fingers([at])
        self.wait_saved(page, 3)
        x, y = self.room.events[-1]["points"][0]
        self.assertLess(abs(x - 60) + abs(y - 45), 1, "a pinch does not zoom about its middle")
        page.fingers([corner])
        self.wait_saved(page, 4)
        self.assertGreater(self.room.events[-1]["points"][0][0], 20, f"a pinch does not zoom: {before}")

    def test_wheel_and_drag(self):
        self.serve(classes=("sofa",))
        page = self.open()
        at = self.page_of(page, 90, 60)
        page.wheel(*at, -240)
        page.mouse(at)
        self.wait_saved(page, 1)
        x, y = self.room.events[-1]["points"][0]
        self.assertLess(abs(x - 90) + abs(y - 60), 0.5, "the point under the pointer moves")
        page.mouse(at, (at[0] - 100, at[1]), button=2)
        page.mouse(at)
        self.wait_saved(page, 2)
        scale = 100 / (self.room.events[-1]["points"][0][0] - x)
        box = page.box("#canvas")
        fitted = min((box["width"] - 16) / SIZE[0], (box["height"] - 16) / SIZE[1])
        self.assertGreater(scale, 1.5 * fitted, "the wheel does not zoom")

    def test_layout(self):
        self.serve(views=6, classes=("floor", "wall", "a class with a name that is rather long"))
        for width, height, touch in ((1280, 720, False), (820, 1180, False), (820, 1180, True)):
            page = self.open(width, height)
            page.touch(touch)
            self.addCleanup(page.touch, False)
            self.click(page, 60.5, 40.5)
            page.keys("1")
            self.click(page, 60.5, 40.5)
            page.click("[data-what=labels]")
            page.wait("document.querySelector('#export-list a')")
            faults = page.run("""
                const faults = [];
                const root = document.documentElement;
                if (root.scrollWidth > innerWidth || root.scrollHeight > innerHeight) faults.push('the page scrolls');
                const parts = ['#views', 'main', 'aside', 'footer'].map((s) => [s, document.querySelector(s).getBoundingClientRect()]);
                const controls = [...document.querySelectorAll('#tools button, #tools input, #proposal button, #exports .row button, #new-class, #order')]
                  .filter((e) => e.offsetParent).map((e) => [e.id || e.textContent, e.getBoundingClientRect()]);
                for (const list of [parts, controls]) {
                  list.forEach(([a, p], i) => {
                    if (p.width < 1 || p.height < 1 || p.left < 0 || p.top < 0 || p.right > innerWidth + 0.5 || p.bottom > innerHeight + 0.5) faults.push(a + ' is not in sight');
                    for (const [b, q] of list.slice(i + 1)) {
                      if (p.left < q.right - 1.5 && q.left < p.right - 1.5 && p.top < q.bottom - 0.5 && q.top < p.bottom - 0.5) faults.push(a + ' lies over ' + b);
                    }
                  });
                }
                for (const s of ['#tools', '#proposal', '#run-part', '#classes', '#strip', 'footer']) {
                  const e = document.querySelector(s);
                  const sideways = s === '#strip' && innerWidth < 1000;
                  if (e.scrollWidth > e.clientWidth && !sideways) faults.push(s + ' is too narrow');
                  if (e.scrollHeight > e.clientHeight && s !== '#strip') faults.push(s + ' is too low');
                }
                const canvas = document.querySelector('#canvas').getBoundingClientRect();
                if (canvas.width * canvas.height < 0.4 * innerWidth * innerHeight) faults.push('the view is small');
                return faults;""")
            self.assertEqual(faults, [], f"{width}x{height}, touch: {touch}")
            page.keys("f")
            page.wait("document.getElementById('fly').getAttribute('aria-pressed') == 'true'")
            self.assertEqual(page.run("return document.getElementById('pad').offsetParent !== null"), touch, "buttons to fly with")
            page.keys("f")

    def test_what_the_program_tells(self):
        self.serve(views=1, classes=("sofa",))
        page = self.open()
        page.wait("document.getElementById('welcome').textContent.startsWith('Click on something that is \"sofa\"')")
        self.room.failure = "the loss is not finite at step 120"
        self.room.most = 1
        self.room.touch()
        page.wait("document.querySelector('#messages .error')?.textContent.startsWith('Training has ended: the loss is not finite at step 120')")
        page.wait("document.getElementById('new-class').disabled")
        page.keys("n")
        page.wait("document.querySelector('#messages').textContent.includes('No name is free')")
        self.server.token = "another"  # a new start
        self.server.http.folder = "/another/"
        self.room.touch()
        page.wait("document.getElementById('connection').textContent.includes('open the address that the program prints')")

    def test_many_views_load_as_they_are_seen(self):
        self.serve(views=230)
        page = self.open()
        page.wait("document.querySelectorAll('#strip img[src]').length > 3")
        self.assertEqual(page.run("return document.querySelectorAll('#strip li').length"), 230)
        self.assertLess(page.run("return document.querySelectorAll('#strip img[src]').length"), 20)
        page.keys("end")
        page.wait("document.querySelector('#strip [data-view=\"229\"] img').getAttribute('src')")

    def test_modules(self):
        self.serve()
        page = self.open()
        said = page.run("""
            return Promise.all(['model', 'viewport', 'colors', 'fly', 'plots', 'events', 'api'].map((name) => import(`./${name}.js`)))
            .then(([model, viewport, colors, fly, plots, events, api]) => {
              const wrong = [];
              const is = (got, want, what) => { if (JSON.stringify(got) !== JSON.stringify(want)) wrong.push(`${what}: ${JSON.stringify(got)}`); };
              const image = {width: 100, height: 50}, screen = {width: 400, height: 400};
              const port = viewport.zoomed(viewport.fitted(image, screen), 3, 150, 200, image, screen);
              const fit = viewport.fitted(image, screen);
              is(viewport.toImage(port, 150, 200).map((v) => v.toFixed(6)), viewport.toImage(fit, 150, 200).map((v) => v.toFixed(6)), 'zoom keeps the point');
              is(viewport.zoomed(port, 0.01, 0, 0, image, screen), fit, 'never smaller than fitted');
              is(model.strokeParts([[0, 0], [0.2, 0], [5, 0.04], [5.1, 0]], 1), [[[0, 0], [5, 0], [5.1, 0]]], 'a stroke is thinned');
              const parts = model.strokeParts(Array.from({length: 10}, (_, i) => [i * 2, 0]), 1, 4);
              is(parts.map((part) => part.length), [4, 4, 4], 'a long stroke has parts');
              is(parts[1][0], parts[0][3], 'that share their ends');
              is([model.duration(59), model.duration(3661), model.short(21500), model.short(950)], ['0:59', '1:01:01', '21.5 k', '950'], 'numbers');
              const state = {classes: [{index: 0, name: 'a', color: [1, 2, 3], clicks: 1}], views: [{frame: 'f'}], marks: [{id: 'x', view: 0, points: [[1, 1]], radius: 0, class: 0}]};
              const undo = {event: {id: 'u', type: 'undo', of: 'x'}};
              const redo = {event: {id: 'v', type: 'undo', of: 'u'}};
              const known = new Map([['x', {id: 'x', type: 'click', frame: 'f', points: [[1, 1]], radius: 0, class: 'a'}]]);
              is(model.combined(state, [undo], known).marks.length, 0, 'an undo hides');
              is(model.combined(state, [undo], known).classes[0].clicks, 0, 'and counts');
              is(model.combined(state, [undo, redo], known).marks.length, 1, 'an undo of it shows again');
              const late = model.combined({...state, marks: []}, [redo], new Map([...known, ['u', undo.event]]));
              is(late.marks.map((mark) => mark.saved), [false], 'also when the first is saved already');
              const renamed = model.combined(state, [{event: {id: 'r', type: 'rename', class: 'a', name: 'b'}}], known);
              is([renamed.classes[0].name, renamed.marks[0].name], ['b', 'b'], 'renaming reaches marks');
              is(model.nameProblem('', []) !== '' && model.nameProblem('a', ['a']) !== '' && model.nameProblem('b', ['a']) === '', true, 'names');
              is(colors.kPalette.includes(colors.freeColor(colors.kPalette.slice(1))), true, 'a free colour');
              is(colors.freeColor(colors.kPalette.slice(1)), colors.kPalette[0], 'the one that is left');
              is(plots.polyline([0, 1, 2], [1, null, 3], false), '0.0,38.0 200.0,2.0', 'a plot with a gap');
              const looks = {position: [0, 0, 0], rotation: [1, 0, 0, 0, 0, 1, 0, -1, 0], fov_deg: 60};  // along y, z is above
              is(fly.upOf([looks]).map(Math.round).map((v) => v + 0), [0, 0, 1], 'up');
              const camera = new fly.FreeCamera(looks, [0, 0, 1]);
              camera.move(0, 0, 2);
              is(camera.position, [0, 2, 0], 'ahead');
              camera.turn(Math.PI / 2, 0);
              camera.move(0, 0, 1);
              is(camera.position.map((v) => Math.round(v * 1e6) / 1e6), [1, 2, 0], 'to the right');
              camera.turn(0, 9);
              const r = camera.value.rotation;
              is(Math.abs(r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6]) + r[2] * (r[3] * r[7] - r[4] * r[6]) - 1) < 1e-9, true, 'a rotation');
              is(camera.forward[2] > 0.99 && camera.forward[2] < 1, true, 'never upside down');
              const sizes = new Uint8Array([2, 0, 0, 0, 123, 125, 1, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 0]);
              is([...api.pictureParts(sizes.buffer).color], [9], 'parts of a picture');
              const births = new model.MarkBirths();
              births.see({overlay: {events: 1}, events: 2, marks: [{id: 'x'}]}, true);
              births.see({overlay: {events: 1}, events: 3, marks: [{id: 'x'}, {id: 'y'}]}, false);
              is([births.isPainted('x', 1), births.isPainted('y', 2), births.isPainted('y', 3)], [true, false, true], 'marks that an overlay knows');
              return wrong;
            });""")
        self.assertEqual(said, [])


if __name__ == "__main__":
    if not browser.programs():
        print("skipped: the page was tried in no browser; install Debian's chromium and chromium-driver")
        sys.exit(77)
    unittest.main(verbosity=2)
