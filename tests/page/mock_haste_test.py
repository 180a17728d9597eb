#!/usr/bin/env python3
"""The page in headless Chromium against the mock server: what a person does before the page has caught up, as on a loaded machine.
A label is of the class, view and proposal that the person saw, and what is not stored says so."""

import page_case
from mock_page_case import SIZE, MockPageCase

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
    def haste(self, page, script, *points):
        """`script` with the points of the view as p[0], p[1] ... in pixels of the page."""
        page.run(HASTE + "const p = arguments[0];" + script, [self.page_of(page, *point) for point in points])

    def message(self, page, text):
        page.wait(f"document.getElementById('messages').textContent.includes({text!r})", f"no message {text!r}: {page.text('#messages')!r}")

    def labels(self):
        return [(e["class"], round(e["points"][0][0])) for e in self.room.events if e["type"] == "click"]

    def opened(self, page, dialog="class-dialog"):
        page.wait(f"document.getElementById('{dialog}').open")

    def test_a_class_that_was_just_named(self):
        self.serve()
        page = self.open()
        self.haste(page, "click(p[0]);", (30, 40))  # waits for the first class
        self.opened(page)
        self.haste(page, "named('sofa'); click(p[0]);", (60, 40))
        self.wait_saved(page, 2)
        page.keys("n")
        self.opened(page)
        self.haste(page, "named('floor'); click(p[0]); click(p[1]);", (90, 40), (90, 70))
        self.wait_saved(page, 4)
        self.assertEqual(self.labels(), [("sofa", 30), ("sofa", 60), ("floor", 90), ("floor", 90)])
        self.assertEqual([e["name"] for e in self.room.events if e["type"] == "class"], ["sofa", "floor"])
        page.keys("1", "f2")
        self.opened(page)
        self.haste(page, "named('couch'); click(p[0]);", (50, 60))
        self.wait_saved(page, 5)
        self.assertEqual(self.labels()[-1], ("couch", 50))
        page.keys("f2")
        self.opened(page)
        self.haste(page, "byId('merge-into').value = 'floor'; byId('class-merge').click(); click(p[0]);", (10, 20))
        self.wait_saved(page, 6)
        self.assertEqual(self.labels()[-1], ("floor", 10))
        page.keys("f2")
        self.opened(page)
        self.haste(page, "byId('class-delete').click();")
        self.opened(page, "question")
        self.haste(page, "byId('question-yes').click(); click(p[0]);", (20, 20))  # no class is left: it waits for a new one
        self.opened(page)
        self.haste(page, "named('wall');")
        self.wait_saved(page, 7)
        self.assertEqual(self.labels()[-1], ("wall", 20))
        self.assertEqual(page.complaints(), [])

    def test_a_dialog_that_opens_again_at_once(self):
        self.serve()
        page = self.open()
        page.keys("n")
        self.opened(page)
        self.haste(page, "byId('class-cancel').click(); click(p[0]); ", (30, 40))  # its close event comes when the next one is open
        self.opened(page)
        self.haste(page, "named('sofa');")
        self.wait_saved(page, 1)
        self.assertEqual(self.labels(), [("sofa", 30)])

    def test_a_stroke_is_of_the_class_that_began_it(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        page.keys("1")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); key('2'); key(']'); pointer('pointerup', p[1]);", (30, 40), (60, 40))
        self.wait_saved(page, 1)
        event = self.room.events[-1]
        self.assertEqual((event["class"], event["radius"]), ("sofa", 3))
        self.assertEqual(page.text("#classes [aria-checked=true] .name"), "floor")

    def test_what_is_not_stored_says_so(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        page.keys("1")
        self.haste(page, "key('ArrowRight'); click(p[0]);", (30, 40))  # the person still sees the view before
        self.message(page, "Not stored: another view is coming")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); pointer('pointercancel', p[1]);", (30, 40), (60, 40))
        self.message(page, "Not stored: the stroke was broken off")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); key('ArrowLeft'); pointer('pointerup', p[1]);", (30, 40), (60, 40))
        self.message(page, "The stroke is dropped")
        self.haste(page, "pointer('pointerdown', p[0]); pointer('pointermove', p[1]); pointer('pointerup', p[1]);", (-8, 40), (60, 40))
        self.message(page, "Click into the picture")
        page.keys("n")
        self.opened(page)
        page.mouse(self.page_of(page, 5, 5))
        self.message(page, "Not stored: a window is open over the picture")
        page.keys("escape", "p")
        self.haste(page, "click(p[0]); click(p[1]); key('ArrowRight');", (30, 40), (60, 40))
        self.message(page, "The polygon is dropped")
        page.keys("b")
        self.assertEqual(self.labels(), [])
        self.click(page, 30, 40)
        self.wait_saved(page, 1)

    def test_a_click_without_a_class(self):
        self.serve()
        page = self.open()
        self.haste(page, "click(p[0]);", (30, 40))
        self.opened(page)
        page.keys("escape")
        self.message(page, "Not stored: the click has no class")
        self.assertEqual(self.room.events, [])

    def test_a_proposal_that_was_not_seen(self):
        self.serve(classes=("sofa",))
        page = self.open()
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

    def test_clicks_of_a_flight(self):
        self.serve(classes=("sofa", "floor"))
        page = self.open()
        page.keys("1", "f")
        page.wait("/\\d+ x \\d+, \\d+ ms/.test(document.getElementById('readout').textContent)", "no picture of the free camera")
        self.room.faults.add("picture")  # every answer takes a while
        self.haste(page, "click(p[0]); key('2'); click(p[1]); click(p[2]); key('Escape');", (60, 45), (70, 45), (50, 45))
        page.wait("document.getElementById('fly').getAttribute('aria-pressed') == 'false'")
        self.wait_saved(page, 3)
        self.assertEqual([name for name, _ in self.labels()], ["sofa", "floor", "floor"])
        page.keys("f")
        page.wait("/\\d+ x \\d+, \\d+ ms/.test(document.getElementById('readout').textContent)", "no picture of the free camera")
        self.haste(page, "click(p[0]); click(p[1]); key('z');", (60, 55), (70, 55))  # takes back what is still on its way
        self.message(page, "Undone: the click of the flight")
        self.wait_saved(page, 4)
        self.haste(page, "pointer('pointerdown', p[0]); key('Escape'); pointer('pointerup', p[0]);", (60, 45))
        self.message(page, "Not stored: the picture changed under it")
        self.assertEqual([e["type"] for e in self.room.events], ["click"] * 4)
        self.assertEqual(page.complaints(), [])


if __name__ == "__main__":
    page_case.main()
