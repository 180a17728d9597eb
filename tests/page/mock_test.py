#!/usr/bin/env python3
"""The page in headless Chromium against the mock server: what a person does, its tools, haste on a loaded machine, and what happens when
things break."""

import pathlib

import mock_server
import page_case


SIZE = (120, 90)
FIRST, SECOND = [0, 120, 210], [255, 180, 0]  # the first colours that the page offers


class MockPageCase(page_case.PageCase):
    SIZE = SIZE

    def serve(self, **options):
        self.room = mock_server.Room(views=options.pop("views", 6), size=SIZE, **options)
        self.server = mock_server.Server(self.room)
        self.url = self.server.start()
        self.addCleanup(lambda: self.server.http.ended or self.server.stop())

    def served(self, **options):
        """The page of a room with these options."""
        self.serve(**options)
        return self.open()

    def clicks(self):
        return sum(e["type"] == "click" for e in self.room.events)

    def message(self, page, text):
        page.wait(f"document.getElementById('messages').textContent.includes({text!r})", f"no message {text!r}: {page.text('#messages')!r}")

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
        """A pixel well inside an object of the room, in each view another place of it: marks of other views lie on theirs."""
        objects = self.room.view(view)[1]
        inside = [(i + 0.5, j + 0.5) for j in range(8, SIZE[1] - 8) for i in range(8, SIZE[0] - 8)
                  if all(objects[j + dj][i + di] == which for dj in (-5, 0, 5) for di in (-5, 0, 5))]
        return inside[len(inside) // (2 + view)]


RING = [255, 213, 74]


class PageTest(MockPageCase):
    def test_what_a_person_does(self):
        page = self.served()
        self.assertIn("Name the first class", page.text("#welcome"))
        self.room.faults.add("overlay")  # nothing is learned yet: what is seen is painted by the page
        sofa, floor = self.pixel_of(0, 4), self.pixel_of(0, 0)
        self.click(page, *sofa)  # without a class: the dialog opens, and the click is made with the new class
        self.opened(page)
        page.type("sofa")
        page.keys("enter")
        self.wait_saved(page, 1)
        event = next(e for e in self.room.events if e["type"] == "click")
        self.assertEqual((event["class"], event["frame"], event["size"]), ("sofa", "rgb_00", list(SIZE)))
        self.assertLess(max(abs(a - b) for a, b in zip(event["points"][0], sofa)), 0.3)
        beside = (sofa[0] + 2, sofa[1])  # inside the brush, beside the mark
        self.wait_pixel(page, *beside, self.mixed(0, *beside, FIRST), "a click is not painted at once")

        self.room.faults.clear()
        self.room.learn()
        far = (sofa[0] + 5, sofa[1])
        self.wait_pixel(page, *far, self.mixed(0, *far, FIRST), "the overlay that was learned is not shown")
        page.keys("right")
        page.wait("document.querySelector('#strip [aria-current=true]').dataset.view == 1")
        there = self.pixel_of(1, 4)
        self.wait_pixel(page, *there, self.mixed(1, *there, FIRST), "another view has no labels")
        page.keys("left")

        self.make_class(page, "floor")  # the floor was taken for the sofa: click again with the right class
        self.click(page, *floor, saved=2)
        other = (floor[0] + 9, floor[1])
        self.wait_pixel(page, *other, self.mixed(0, *other, SECOND), "a correction is not shown")
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
        page.wait_for(lambda: self.room.state(0)["proposal"]["id"] != proposal["id"], True, "no other proposal")
        before = self.room.state(0)["proposal"]["id"]
        page.wait(f"document.querySelector('#strip .proposed')?.dataset.view == {self.room.state(0)['proposal']['view']}")
        page.keys("s")
        page.wait_for(lambda: self.room.events[-1]["type"], "skip", "no skip arrives")
        self.assertNotEqual(self.room.state(0)["proposal"]["id"], before)

        page.keys("home", "e")
        page.wait("!document.getElementById('legend').hidden")
        yellow = page.run("return import('./dom.js').then(({kRamp}) => [kRamp[40], kRamp[220]])")
        wall = self.pixel_of(0, 2)
        self.wait_pixel(page, *far, self.mixed(0, *far, yellow[0]), "no entropy of what is known")
        self.wait_pixel(page, *wall, self.mixed(0, *wall, yellow[1]), "no entropy of what is unknown")
        page.keys("e")

        page.click("[data-what=labels]")
        page.wait("document.querySelectorAll('#export-list a').length == 6")
        self.assertEqual(page.run("return fetch(document.querySelector('#export-list a').href).then((a) => a.text())"), "exported")
        page.click("[data-what=mesh]")
        page.wait("document.getElementById('export-list').textContent.includes('Train for a minute')")
        self.room.faults.add("slow export")
        page.click("[data-what=labels]")
        page.wait("document.querySelector('#export-list progress')?.value === 3", "no progress of what is said of it")
        page.click("[data-what=coco]")
        page.wait("document.querySelectorAll('#export-list progress').length == 2", "the second does not run beside the first")
        page.click("#export-list .running button")
        page.wait("document.querySelectorAll('#export-list .canceled').length == 1", "no cancelled export")
        self.assertEqual(page.run("return document.querySelectorAll('#export-list progress').length"), 1)
        self.assertEqual(page.complaints(), [])

    def test_keyboard_alone(self):
        page = self.served()
        self.dialog(page, "n")
        page.keys("enter")
        self.assertIn("needs a name", page.text("#class-problem"))
        page.type("lamp")
        page.keys("tab", "right", "enter")
        page.wait("!document.getElementById('class-dialog').open || document.activeElement.closest('#swatches')")
        if page.run("return document.getElementById('class-dialog').open"):
            page.click("#class-ok")
        page.wait("!document.getElementById('class-dialog').open")
        page.wait("[...document.querySelectorAll('#classes .name')].some((e) => e.textContent == 'lamp')", "the class does not come")
        page.keys(*["shift+right"] * 4, "shift+down", "enter")
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertEqual([event["class"], event["points"]], ["lamp", [[SIZE[0] / 2 + 8.5, SIZE[1] / 2 + 2.5]]])
        self.assertEqual(self.room.events[0]["color"], SECOND)
        page.keys("z")
        page.wait("document.querySelectorAll('#classes [aria-checked=true] .clicks')[0].textContent == ''")
        page.keys("shift+z")
        page.wait("document.querySelectorAll('#classes [aria-checked=true] .clicks')[0].textContent == '1'")
        page.wait_for(lambda: [e["type"] for e in self.room.events], ["class", "click", "undo", "undo"], "undo and redo do not arrive")
        self.assertEqual([e["id"] for e in self.room.alive(self.room.events)], [e["id"] for e in self.room.events[:2]])
        self.dialog(page, "f2")
        page.type("ball")
        page.keys("enter")
        page.wait("document.querySelector('#classes .name').textContent == 'ball' && document.getElementById('saving').textContent == 'every click is saved'")
        here = "document.getElementById('proposal-text').textContent.startsWith('Click proposed here')"
        if not page.run(f"return {here}"):  # space goes there first
            page.keys("space")
            page.wait(here)
        page.keys("space")
        self.wait_saved(page, 2)
        self.assertEqual(self.room.events[-1]["class"], "ball")
        self.assertNotIn("object", self.room.events[-1])
        page.click("#another")
        page.keys("shift+right", "enter")
        self.wait_saved(page, 3)
        page.keys("a", *["shift+right"] * 2, "enter")
        self.wait_saved(page, 4)
        self.assertEqual([event.get("object") for event in self.room.events[-2:]], [1, 2])
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
        for name in ("order", "show-photo", "show-entropy", "opacity", "radius", "help", "canvas", "proposal-skip", "new-class", "labels", "mesh"):
            self.assertIn(name, reached)
        self.assertEqual([name for name, outline in reached.items() if outline == "none" and name != "BODY"], [])

    def test_other_keys(self):
        page = self.served(classes=("floor", "wall", "sofa"))
        chosen = "document.querySelector('#classes [aria-checked=true] .name')?.textContent"
        for key, name in (("2", "wall"), (".", "sofa"), (".", "floor"), (",", "sofa")):
            page.keys(key)
            page.wait(f"{chosen} == '{name}'", f"{key} does not choose {name}")
        page.keys("shift+1")
        page.wait("[...document.querySelectorAll('#classes .key')].map((e) => e.textContent).join() == '2,3,1'", "a class gets no key of its own")
        page.keys("2")
        page.wait(f"{chosen} == 'floor'")
        page.keys("]", "]")
        sofa = self.pixel_of(0, 4)
        page.keys("1")
        self.click(page, *sofa, saved=1)
        self.assertEqual((self.room.events[0]["class"], self.room.events[0]["radius"]), ("sofa", 5))
        far = (sofa[0] + 7, sofa[1])
        self.wait_pixel(page, *far, self.mixed(0, *far, mock_server.COLORS[2]), "the sofa is not learned")
        page.keys("2")
        page.hover(*self.page_of(page, *far))
        page.wait("document.getElementById('readout').textContent.endsWith('sofa')", "the class under the pointer is not told")
        page.keys("c")
        page.wait(f"{chosen} == 'sofa'", "c does not choose what is under the pointer")
        page.keys("o")
        page.hover(5, 715)
        photo = self.room.view(0)[0][int(far[1])][3 * int(far[0]):3 * int(far[0]) + 3]
        self.wait_pixel(page, *far, photo, "o does not hide the overlay")
        page.keys("o", "r")
        page.wait("document.getElementById('show-rendered').getAttribute('aria-pressed') == 'true'")
        page.keys("+", "+", "-", "0")
        self.wait_pixel(page, *far, self.mixed(0, *far, mock_server.COLORS[2]), "0 does not fit the view")
        self.assertEqual(page.complaints(), [])

    def test_an_unsent_click_outlives_a_reload(self):
        page = self.served(classes=("sofa",))
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

    def test_an_unsent_click_stays_with_its_run(self):
        page = self.served(classes=("sofa",))
        self.room.faults.add("event")
        self.click(page, 32.5, 40.5)
        page.wait("document.getElementById('saving').textContent == '1 not saved yet'")
        self.room.run_id = "run-2"  # another run in a folder of the same name, or a copy, at the same address
        self.room.faults.clear()
        page.reload()
        self.wait_start(page)
        page.wait("document.getElementById('saving').textContent == ''", "a click of another run waits here")
        self.assertEqual(self.clicks(), 0)
        self.room.run_id = "run-1"
        page.reload()
        self.wait_start(page)
        self.wait_saved(page, 1)

    def test_a_photograph_that_was_exchanged(self):
        page = self.served(views=2)
        rows = self.room.view(0)[0]
        color = lambda row, x: list(row[3 * x:3 * x + 3])
        x, y = next((x, y) for y in range(8, 40) for x in range(8, SIZE[0] - 8)
                    if max(abs(a - b) for a, b in zip(color(rows[y], x), color(rows[-1 - y], x))) > 60)
        self.wait_pixel(page, x + 0.5, y + 0.5, color(rows[y], x), "the photograph is not shown")
        self.room.turned = 1  # the scene was changed and the program started again: same address, same token
        self.room.touch()
        self.wait_pixel(page, x + 0.5, y + 0.5, color(rows[-1 - y], x), "the photograph of before is shown")
        page.wait("document.querySelector('#strip [data-view=\"0\"] img').getAttribute('src').includes('photo=0-1')")

    def test_an_answer_that_is_lost(self):
        page = self.served(classes=("sofa",))
        for clicks, fault in ((1, "drop"), (2, "lost")):  # stored, but the response never comes; or not even that
            self.room.faults.add(fault)
            self.click(page, 30.5 * clicks, 40.5, saved=clicks)
        ids = [event["id"] for event in self.room.events]
        self.assertEqual(self.room.received, [ids[0], ids[0], ids[1], ids[1]])

    def test_a_refused_click_is_taken_back(self):
        page = self.served(classes=("sofa",))
        self.room.faults.add("refuse")
        self.click(page, 30.5, 40.5)
        page.wait("document.querySelector('#messages .error')?.textContent.includes('is held out for tests. Label another view.')")
        self.assertIn("): frame 'rgb_00'", page.text("#messages .error"))
        page.wait("document.getElementById('saving').textContent == '' && document.querySelector('#classes .clicks').textContent == ''")
        self.room.faults.clear()
        self.click(page, 60.5, 40.5, saved=1)

    def test_a_lost_connection(self):
        page = self.served(classes=("sofa", "floor"))
        page.keys("1")
        self.click(page, 30.5, 40.5, saved=1)
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
        page = self.served(classes=("sofa",))
        self.click(page, 30.5, 40.5, saved=1)
        self.room.faults.add("silent")  # the response comes, a new state does not
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
        self.wait_pixel(two, 32.5, 40.5, self.mixed(0, 32.5, 40.5, FIRST), "the other browser shows no click")
        two.keys("z")
        two.wait("document.querySelector('#messages').textContent.includes('nothing to undo')", "a browser undoes another's click")
        self.click(two, 60.5, 70.5)
        one.wait("document.querySelector('#classes .clicks')?.textContent == '2'")
        one.keys("z")
        two.wait("document.querySelector('#classes .clicks')?.textContent == '1'")
        self.assertEqual([m["points"][0][0] > 50 for m in self.room.state(0)["marks"]], [True])

    def test_a_tab_that_nobody_sees_asks_nothing(self):
        page = self.served(classes=("sofa",))
        page.run("Object.defineProperty(document, 'hidden', {get: () => window.isHidden ?? false}); window.isHidden = true;")
        self.room.touch()  # the response to the request that waits
        page.run("return new Promise((resolve) => setTimeout(resolve, 300))")
        polls = self.room.polls
        self.room.apply({"id": "x-1", "type": "click", "frame": "rgb_00", "size": list(SIZE), "points": [[30.5, 40.5]], "radius": 3, "class": "sofa"})
        page.run("return new Promise((resolve) => setTimeout(resolve, 700))")
        self.assertEqual(self.room.polls, polls)
        page.run("window.isHidden = false; document.dispatchEvent(new Event('visibilitychange'))")
        page.wait("document.querySelector('#classes .clicks').textContent == '1'", "a tab that is seen again does not go on")

    def test_one_picture_at_a_time(self):
        page = self.served(classes=("sofa",))
        self.click(page, *self.pixel_of(0, 4), saved=1)
        self.room.faults.add("picture")
        self.room.most_pictures = 0
        page.keys(*["right"] * 5)
        there = self.pixel_of(5, 4)
        self.wait_pixel(page, *there, self.mixed(5, *there, [200, 60, 60]), "the last view has no labels")
        self.assertEqual(self.room.most_pictures, 1)

    def test_fingers(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open(820, 1180)
        self.room.faults.add("overlay")
        page.keys("1")
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
        x = 60 - 40 / self.scale(page)
        photo, label = self.room.view(0)[0][45][3 * int(x):3 * int(x) + 3], self.mixed(0, x, 45, [200, 60, 60])
        seen = page.pixels([(at[0] - 200, at[1])])[0]
        apart = [sum(abs(a - b) for a, b in zip(seen, other)) for other in (photo, label)]
        self.assertLess(*apart, "the first finger of a pinch leaves a stroke")
        page.keys("2")  # a tap on a click of its own class selects it
        page.fingers([at])
        self.wait_saved(page, 3)
        x, y = self.room.events[-1]["points"][0]
        self.assertLess(abs(x - 60) + abs(y - 45), 1, "a pinch does not zoom about its middle")
        page.fingers([corner])
        self.wait_saved(page, 4)
        self.assertGreater(self.room.events[-1]["points"][0][0], 20, f"a pinch does not zoom: {before}")

    def test_wheel_and_drag(self):
        page = self.served(classes=("sofa",))
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
        self.assertGreater(scale, 1.5 * self.scale(page), "the wheel does not zoom")

    def test_layout(self):
        for width, height, touch in ((1280, 720, False), (820, 1180, False), (820, 1180, True), (390, 844, True)):
            page = self.served(classes=("floor", "wall", "a class with a name that is rather long"))
            page.size(width, height, is_phone=touch)
            page.reload()
            page.wait(f"document.getElementById('welcome').textContent.startsWith('Choose a class, then {'tap' if touch else 'click'}')")
            if width < 600:
                self.assertGreaterEqual(page.box("#welcome")["top"], page.box("#canvas")["bottom"], "a hint lies over the picture")
            self.click(page, 60.5, 40.5)
            page.keys("1")
            self.click(page, 60.5, 40.5)
            page.run("document.querySelector('[data-what=labels]').click()")
            page.wait("document.querySelector('#export-list a')")
            faults = page.run("""
                const faults = [];
                const root = document.documentElement, isPhone = innerWidth < 600;  // which scrolls to the exports
                if (root.scrollWidth > innerWidth || root.scrollHeight > innerHeight) faults.push('the page scrolls');
                const parts = ['#views', 'main', 'aside', 'footer'].map((s) => [s, document.querySelector(s).getBoundingClientRect()]);
                const controls = [...document.querySelectorAll('#tools button, #tools input, #proposal button, #exports .row button, #new-class, #order')]
                  .filter((e) => e.offsetParent && !(isPhone && e.closest('#exports'))).map((e) => [e.id || e.textContent, e.getBoundingClientRect()]);
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
                if (canvas.width * canvas.height < (isPhone ? 0.3 : 0.4) * innerWidth * innerHeight) faults.push('the view is small');
                if (document.querySelector('#classes').clientHeight < 70) faults.push('classes are hidden');
                return faults;""")
            self.assertEqual(faults, [], f"{width}x{height}, touch: {touch}")

    def test_what_the_program_tells(self):
        page = self.served(views=1, classes=("sofa",))
        page.wait("document.getElementById('welcome').textContent.startsWith('Click on something that is \"sofa\"')")
        self.room.trouble = "cannot write 'runs/mock_room/checkpoints': disk full"
        self.room.touch()
        page.wait("document.querySelector('#messages .error')?.textContent.startsWith('Not written: cannot write')")
        self.room.trouble = ""
        self.room.touch()
        page.wait("!document.querySelector('#messages .error')", "it is written again, and the message stays")
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
        page = self.served(views=230)
        page.wait("document.querySelectorAll('#strip img[src]').length > 3")
        self.assertEqual(page.run("return document.querySelectorAll('#strip li').length"), 230)
        self.assertLess(page.run("return document.querySelectorAll('#strip img[src]').length"), 20)
        page.keys("end")
        page.wait("document.querySelector('#strip [data-view=\"229\"] img').getAttribute('src')")

    def test_modules(self):
        page = self.served()
        said = page.run((pathlib.Path(__file__).parent / "modules.js").read_text())
        self.assertEqual(said, [])


# Its tools: polygons, deletion, classes that end, what is ignored, test frames.
class ToolsTest(MockPageCase):
    def test_a_polygon(self):
        page = self.served(classes=("sofa", "floor"))
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
        self.click(page, 90, 20, saved=2)
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

    def test_a_thing(self):
        page = self.served(classes=("sofa", "floor"))
        self.room.faults.add("overlay")
        red = [200, 60, 60]

        def shown(x, y, is_in=True):
            photo = self.room.view(0)[0][y][3 * x:3 * x + 3]
            self.wait_pixel(page, x + 0.5, y + 0.5, [0.6 * a + 0.4 * b for a, b in zip(photo, red)] if is_in else photo, "the mask is another")

        page.keys("1", "m")
        page.wait("document.getElementById('tool-thing').getAttribute('aria-pressed') == 'true'")
        page.hover(*self.page_of(page, 70, 45))  # on the sofa: columns 54 to 101, rows 32 to 67
        shown(98, 40)
        shown(105, 40, False)
        self.assertFalse(self.room.events)
        asked = self.room.things[-1]
        self.assertEqual((asked["view"], asked["level"], asked["not"], len(asked["also"])), (0, 0, [], 1))
        self.click(page, 70, 45)
        self.message(page, "Enter or a click labels it")
        page.keys("]")
        shown(104, 40)
        page.wait_for(lambda: self.room.things[-1]["level"], 1, "it does not grow")
        page.mouse(*(self.page_of(page, x, 45) for x in (76, 80, 86)))  # from inside: it is split off
        page.wait_for(lambda: len(self.room.things[-1]["not"]) >= 2, True, "nothing is split off")
        shown(98, 40, False)
        self.click(page, 30, 45)  # beside: it is added
        shown(40, 45)
        self.assertFalse(self.room.events, "a thing is labelled before it is accepted")
        page.keys("enter")
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertEqual((event["fill"], event["class"], event["object"], len(event["points"])), (True, "sofa", 1, 4))
        self.assertAlmostEqual(min(p[0] for p in event["points"]), 26, delta=0.5)
        page.hover(*self.page_of(page, 10, 80))
        self.click(page, 10, 80)
        self.message(page, "Enter or a click labels it")
        page.keys("escape")
        self.message(page, "The thing is dropped")
        self.click(page, 10, 80)
        self.message(page, "Enter or a click labels it")
        self.click(page, 10, 80, saved=2)
        self.assertEqual(self.room.events[-1]["object"], 2)
        page.keys("z")
        self.message(page, "Undone: polygon \"sofa\"")
        self.assertEqual(page.complaints(), [])

    def test_what_a_click_would_label(self):
        page = self.served(classes=("sofa",))
        page.keys("1")
        page.hover(*self.page_of(page, 70, 45))
        page.wait_for(lambda: len(self.room.things), 1, "a pointer that rests shows nothing")
        page.hover(*self.page_of(page, 10, 80))
        self.click(page, 70, 45, saved=1)
        self.assertEqual(len(self.room.events[-1]["points"]), 1)
        self.assertEqual(page.complaints(), [])

    def test_one_click_is_deleted(self):
        page = self.served(classes=("sofa", "floor"))
        page.keys("1")
        for k, at in enumerate(((30, 40), (60, 40), (90, 40))):
            self.click(page, *at, saved=k + 1)
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
        self.click(page, 30, 40, saved=4)  # another class: a correction
        self.assertTrue(page.run("return document.getElementById('selection').hidden"))
        page.hover(5, 715)
        page.keys("delete")
        self.message(page, "Point at a click")

    def test_the_eraser(self):
        page = self.served(classes=("sofa",))
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
        page = self.served(classes=("sofa",))
        for name, at in (("stool", (30, 40)), ("chair", (60, 40))):
            self.make_class(page, name)
            self.click(page, *at)
        self.wait_saved(page, 2)
        names = "[...document.querySelectorAll('#classes .name')].map((e) => e.textContent).join()"
        self.dialog(page, "2", "f2")
        page.run("document.getElementById('merge-into').value = 'chair'")
        page.click("#class-merge")
        page.wait(f"{names} == 'sofa,chair'")
        page.wait("[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '2'", "the clicks are not the other's")
        page.wait_for(lambda: self.room.events[-1].get("into"), "chair", "no merge arrives")
        self.message(page, "\"stool\" is merged into \"chair\", which got its 1 click.")
        page.keys("z")
        page.wait_for(lambda: self.room.events[-1]["type"], "undo", "the undo does not arrive")
        page.wait(f"{names} == 'sofa,stool,chair'", "a merge is not undone")
        page.wait("[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '1'", "the click does not come back")
        self.dialog(page, "3", "f2")
        page.click("#class-delete")
        page.wait("document.getElementById('question').open")
        self.assertIn("Its click goes with it", page.text("#question-text"))
        page.keys("enter")  # the careful answer has the focus
        self.message(page, "\"chair\" stays")
        self.dialog(page, "f2")
        page.click("#class-delete")
        page.wait("document.getElementById('question').open")
        page.click("#question-yes")
        page.wait(f"{names} == 'sofa,stool'")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 1, "the clicks stay")
        page.keys("z")
        page.wait(f"{names} == 'sofa,stool,chair'")
        page.wait_for(lambda: len(self.room.state(0)["marks"]), 2, "the clicks do not come back")
        page.keys("1", "f2")  # the scene's own: its colour alone
        self.opened(page)
        self.assertEqual(page.run("return [document.getElementById('class-name').disabled, document.getElementById('class-end').hidden]"), [True, True])
        page.click("#class-cancel")

    def test_what_is_ignored(self):
        page = self.served(classes=("sofa",))
        sofa = self.pixel_of(0, 4)
        self.click(page, *sofa, saved=1)
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
        page = self.served(classes=("sofa",), held_out=2)
        self.click(page, *self.pixel_of(0, 4), saved=1)
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
        page = self.served(classes=("sofa",))
        self.click(page, *self.pixel_of(0, 4), saved=1)
        place = self.room.place(0, self.room.events[0]["points"][0])
        page.run("document.querySelector('#strip [data-view=\"2\"]').click()")
        there = self.pixel_of(2, 4)
        self.wait_pixel(page, *there, self.mixed(2, *there, [200, 60, 60]), "the other view is not shown")
        x, y = self.page_of(page, *self.room.pixel_of(2, place))
        around = ((1, 0), (-1, 0), (0, 1), (0, -1))
        for _ in range(60):  # a light ring
            ring, far = ([page.pixels([(x + r * dx, y + r * dy)])[0] for dx, dy in around] for r in (3.5, 9))
            if sum(map(sum, ring)) > sum(map(sum, far)) + 120:
                break
        else:
            self.fail(f"the click of another view is not shown: {ring} in {far}")
        page.hover(x, y)
        page.wait("document.getElementById('readout').textContent.includes('(clicked as sofa in rgb_00)')")

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
        page = self.served(classes=("sofa",))
        for keys, words in (("7", "No class has the key 7"), ("enter", "Move a cross"), ("delete", "Point at a click"), ("c", "no label under the pointer"),
                            ("left", "This is the first view"), ("x", "Eraser:"), ("p", "Polygon:"), ("b", "Brush:"),
                            ("z", "nothing to undo"), ("shift+z", "nothing to redo"), ("g", "There is no guess")):
            page.hover(5, 715)
            page.keys(keys)
            self.message(page, words)
        page.keys("end", "right")
        self.message(page, "This is the last view")
        box = page.box("#canvas")
        page.mouse((box["x"] + 3, box["y"] + 3))
        self.message(page, "Click into the picture")


# What a person does before the page has caught up, as on a loaded machine: a label is of the class, view and proposal that the person
# saw, and what is not stored says so.
# Events of one task: none that the browser itself queues comes between them.
HASTE = """
const byId = (id) => document.getElementById(id);
const pointer = (type, [x, y], pointerId = 1) => byId('canvas').dispatchEvent(
  new PointerEvent(type, {pointerId, pointerType: 'mouse', button: 0, buttons: 1, clientX: x, clientY: y, bubbles: true, cancelable: true}));
const click = (at) => { pointer('pointerdown', at); pointer('pointerup', at); };
const key = (key) => byId('canvas').dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true, cancelable: true}));
const named = (name) => { byId('class-name').value = name; byId('class-dialog').querySelector('form').requestSubmit(byId('class-ok')); };
"""


class HasteTest(MockPageCase):
    def haste(self, page, script, *points, saved=None):
        """`script` with the points of the view as p[0], p[1] ... in pixels of the page."""
        page.run(HASTE + "const p = arguments[0];" + script, [self.page_of(page, *point) for point in points])
        if saved is not None:
            self.wait_saved(page, saved)

    def labels(self):
        return [(e["class"], round(e["points"][0][0])) for e in self.room.events if e["type"] == "click"]

    def test_a_class_that_was_just_named(self):
        page = self.served()
        self.haste(page, "click(p[0]);", (30, 40))  # waits for the first class
        self.opened(page)
        self.haste(page, "named('sofa'); click(p[0]);", (60, 40), saved=2)
        self.dialog(page, "n")
        self.haste(page, "named('floor'); click(p[0]); click(p[1]);", (90, 40), (90, 70), saved=4)
        self.assertEqual(self.labels(), [("sofa", 30), ("sofa", 60), ("floor", 90), ("floor", 90)])
        self.assertEqual([e["name"] for e in self.room.events if e["type"] == "class"], ["sofa", "floor"])
        self.dialog(page, "1", "f2")
        self.haste(page, "named('couch'); click(p[0]);", (50, 60), saved=5)
        self.assertEqual(self.labels()[-1], ("couch", 50))
        self.dialog(page, "f2")
        self.haste(page, "byId('merge-into').value = 'floor'; byId('class-merge').click(); click(p[0]);", (10, 20), saved=6)
        self.assertEqual(self.labels()[-1], ("floor", 10))
        self.dialog(page, "f2")
        self.haste(page, "byId('class-delete').click();")
        self.opened(page, "question")
        self.haste(page, "byId('question-yes').click(); click(p[0]);", (20, 20))  # no class is left: it waits for a new one
        self.opened(page)
        self.haste(page, "named('wall');", saved=7)
        self.assertEqual(self.labels()[-1], ("wall", 20))
        self.assertEqual(page.complaints(), [])

    def test_a_dialog_that_opens_again_at_once(self):
        page = self.served()
        self.dialog(page, "n")
        self.haste(page, "byId('class-cancel').click(); click(p[0]); ", (30, 40))  # its close event comes when the next one is open
        self.opened(page)
        self.haste(page, "named('sofa');", saved=1)
        self.assertEqual(self.labels(), [("sofa", 30)])

    def test_a_stroke_is_of_the_class_that_began_it(self):
        page = self.served(classes=("sofa", "floor"))
        page.keys("1")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); key('2'); key(']'); pointer('pointerup', p[1]);", (30, 40), (60, 40), saved=1)
        event = self.room.events[-1]
        self.assertEqual((event["class"], event["radius"]), ("sofa", 3))
        self.assertEqual(page.text("#classes [aria-checked=true] .name"), "floor")

    def test_what_is_not_stored_says_so(self):
        page = self.served(classes=("sofa", "floor"))
        page.keys("1")
        self.haste(page, "key('ArrowRight'); click(p[0]);", (30, 40))  # the person still sees the view before
        self.message(page, "Not stored: another view is coming")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); pointer('pointercancel', p[1]);", (30, 40), (60, 40))
        self.message(page, "Not stored: the stroke was broken off")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); key('ArrowLeft'); pointer('pointerup', p[1]);", (30, 40), (60, 40))
        self.message(page, "The stroke is dropped")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); pointer('pointerup', p[1]);", (-8, 40), (60, 40))
        self.message(page, "Click into the picture")
        self.dialog(page, "n")
        page.mouse(self.page_of(page, 5, 5))
        self.message(page, "Not stored: a window is open over the picture")
        page.keys("escape", "p")
        self.haste(page, "click(p[0]); click(p[1]); key('ArrowRight');", (30, 40), (60, 40))
        self.message(page, "The polygon is dropped")
        page.keys("b")
        self.assertEqual(self.labels(), [])
        self.click(page, 30, 40, saved=1)

    def test_labels_that_everybody_sees(self):
        """Pale colours of a table are deepened, lines part the classes, and certainty waits for the classes that are seen."""
        self.serve(classes=("wall", "floor", "sofa"))
        self.room.given[0]["color"], self.room.unreached = [225, 235, 240], 0.4
        page = self.open()
        sofa, floor = self.pixel_of(0, 4), self.pixel_of(0, 0)
        page.keys("1")
        self.click(page, *sofa, saved=1)
        page.keys("2")
        self.click(page, *floor, saved=2)
        page.wait("document.querySelector('#classes .area').textContent == '50 %'", "no area")
        self.assertEqual([page.text("#classes .sure"), "40 % of the surface" in page.run("return document.querySelector('#classes .sure').title")], ["\u2013", True])
        deep = page.run("return import('./dom.js').then(({seenOnWhite}) => seenOnWhite([225, 235, 240]))")
        self.assertLess(sum(deep), 560)
        far = (sofa[0] + 5, sofa[1])
        self.wait_pixel(page, *far, self.mixed(0, *far, deep), "the pale colour is shown as it is")
        rows = self.room.view(0)[1]
        # A border between what is named: six pixels of one thing, then six of the other.
        x, y = next((x, y) for y in range(10, 80) for x in range(10, 110) if {bytes(rows[y][x - 6:x]), bytes(rows[y][x:x + 6])} == {b"\0" * 6, b"\4" * 6})
        at = self.page_of(page, x, y + 0.5)
        def has_line(light):
            return max(light) > light[0] + 60 and max(light) > light[-1] + 60 and min(light) < min(light[0], light[-1]) - 60

        for _ in range(60):  # lines come a moment after the colours
            across = page.pixels([(at[0] + k / 2, at[1]) for k in range(-6, 7)])
            if has_line([sum(pixel) for pixel in across]):
                break
        else:
            self.fail(f"no line: {across}")
        self.room.unreached = 0.01
        self.room.touch()
        page.wait("document.querySelector('#classes .sure').textContent == '90 %'", "no certainty")

    def test_a_click_without_a_class(self):
        page = self.served()
        self.haste(page, "click(p[0]);", (30, 40))
        self.opened(page)
        page.keys("escape")
        self.message(page, "Not stored: the click has no class")
        self.assertEqual(self.room.events, [])

    def test_a_proposal_that_was_not_seen(self):
        page = self.served(classes=("sofa",))
        page.wait("document.getElementById('proposal-text').textContent.startsWith('Click proposed here')")
        page.run("window.draws = window.requestAnimationFrame; window.requestAnimationFrame = () => 0;")  # no frame comes
        before = self.room.state(0)["proposal"]["id"]
        place = self.room.state(0)["proposal"]
        self.room.apply({"id": "x-1", "type": "skip", "frame": self.room.frames[place["view"]], "size": list(SIZE), "points": [place["at"]]})
        self.assertNotEqual(self.room.state(0)["proposal"]["id"], before)
        page.run("return new Promise((resolve) => setTimeout(resolve, 700))")
        for name in ("space", "g", "s"):
            page.keys(name)
            page.run("return new Promise((resolve) => setTimeout(resolve, 100))")
        self.message(page, "another click has just been proposed")
        self.assertEqual(len(self.room.events), 1)


if __name__ == "__main__":
    page_case.main()
