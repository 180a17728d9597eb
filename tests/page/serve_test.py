#!/usr/bin/env python3
"""The page in headless Chromium against `semfield serve` on the shipped room."""

import io
import json
import signal
import socket
import zipfile

import page_case
from program import SOURCE, ProgramCase, png_bytes
from serve.serve_verb_test import Served

CONFIG = SOURCE / "configs/quickstart.yaml"
SIZE = (96, 72)
SETTINGS = {"scene.frames": 8, "scene.test_frames": 2, "scene.labels.frames": "none", "scene.load.width_px": SIZE[0], "runtime.threads": 2}


class ServeTest(page_case.PageCase, ProgramCase):
    SIZE = SIZE

    def setUp(self):
        super().setUp()
        self.run_dir = self.dir / "run"
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = self.serve()

    def serve(self, by_run=False):
        """The address of the program at work; a new start on the same folder and port goes on."""
        words = [self.run_dir] if by_run else [CONFIG, "--out", self.run_dir, *(f"--set={key}={value}" for key, value in SETTINGS.items())]
        self.served = Served(self, *words, "--port", self.port)
        return f"http://127.0.0.1:{self.served.port}{self.served.folder}"

    def events(self):
        return [json.loads(line) for line in (self.run_dir / "clicks.jsonl").read_text().splitlines()]

    def clicks(self):
        return sum(e["type"] == "click" for e in self.events())

    def wait_learned(self, page):
        """Until the labels know every event."""
        for _ in range(600):
            state = self.served.state()
            if state["overlay"]["events"] == state["events"]:
                return
            page.run("return new Promise((resolve) => setTimeout(resolve, 100))")
        self.fail(f"labels stay behind: {state['overlay']} of {state['events']} events, {state['run']}")

    def wait_mixed(self, page, x, y, color, why):
        """Until the page shows the class over the picture at a pixel of the view: 55 of 100 parts of it, as white walls need it."""
        color = page.run(f"return import('./dom.js').then(({{seenOnWhite}}) => seenOnWhite({list(color)}))")
        at = self.page_of(page, x, y)
        seen = under = None
        for _ in range(40):
            seen = page.pixels([at])[0]
            page.keys("o")
            page.wait("document.getElementById('opacity-value').textContent == 'off'")
            under = page.pixels([at])[0]
            page.keys("o")
            page.wait("document.getElementById('opacity-value').textContent != 'off'")
            if max(abs(0.45 * u + 0.55 * c - s) for u, c, s in zip(under, color, seen)) < 10:
                return
        self.fail(f"{why}: {seen} over {under}, not of {color}")

    def colors(self):
        return {row["name"]: row["color"] for row in self.served.state()["classes"]}

    def test_what_a_person_does(self):
        page = self.open()
        page.keys("home")
        self.make_class(page, "my own thing")
        self.click(page, 20.5, 50.5, saved=1)
        page.keys("2")
        self.click(page, 75.5, 20.5, saved=2)
        colors = self.colors()
        second = list(colors)[1]
        page.wait("[...document.querySelectorAll('#classes .name')].at(-1).textContent == 'my own thing'")
        self.wait_learned(page)
        self.wait_mixed(page, 22.5, 50.5, colors["my own thing"], "the click is not in the overlay")
        self.wait_mixed(page, 77.5, 20.5, colors[second], "the other click is not in the overlay")
        page.keys("1")  # wrong: again with the right class
        self.click(page, 75.5, 20.5, saved=3)
        self.wait_learned(page)
        self.wait_mixed(page, 77.5, 20.5, colors[list(colors)[0]], "the correction is not in the overlay")
        page.keys("z")
        page.wait("document.getElementById('messages').textContent.includes('Undone')")
        page.wait_for(lambda: len(self.served.state()["marks"]), 2, "no undo arrives")
        self.wait_learned(page)
        self.wait_mixed(page, 77.5, 20.5, colors[second], "undo does not bring the label back")

        page.wait("document.getElementById('proposal-text').textContent.startsWith('Click proposed')", "nothing is proposed", 240)
        proposal = self.served.state()["proposal"]
        here = page.run("return Number(document.querySelector('#strip [aria-current=true]').dataset.view)")
        page.keys("space")
        page.wait(f"document.querySelector('#strip [aria-current=true]').dataset.view == {proposal['view']}", "space does not go to the proposal")
        if here != proposal["view"]:
            page.keys("space")
        self.wait_saved(page, 4)
        event = self.events()[-1]
        self.assertEqual((event["frame"], event["class"]), (self.served.state()["views"][proposal["view"]]["frame"], list(colors)[0]))

        other = self.open()  # another tab of the person, or another person
        other.wait("[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '1'")
        other.keys("home")
        self.make_class(other, "theirs")
        self.click(other, 60.5, 60.5, saved=5)
        page.keys("home")
        page.wait("[...document.querySelectorAll('#classes .name')].at(-1).textContent == 'theirs'")
        self.wait_mixed(page, 62.5, 60.5, self.colors()["theirs"], "the other browser's click is not seen")

        page.keys("e")
        page.wait("!document.getElementById('legend').hidden")
        page.keys("e", "r", "r", "home", "i", "p")
        for corner in ((4, 4), (30, 4), (30, 30), (4, 30)):
            self.click(page, *corner)
        page.keys("enter", "b")
        self.wait_saved(page, 6)
        self.wait_learned(page)
        size = page.run("return fetch('./photo?view=0').then((a) => a.blob()).then(createImageBitmap).then((b) => b.width)")
        self.assertGreater(size, SIZE[0], "the photograph is as small as what trains")
        held_out = [view["frame"] for view in self.served.state()["views"] if view["held_out"]]
        self.assertEqual(len(held_out), 2)
        page.keys("end")
        self.click(page, 20.5, 20.5)
        page.wait(f"document.getElementById('messages').textContent.includes('{held_out[-1]} is held out for tests')")
        page.keys("home")
        page.click("[data-what=labels]")
        page.wait("document.querySelector('#export-list a')", "no export", 120)
        data = page.run("return fetch(document.querySelector('#export-list a').href).then((a) => a.arrayBuffer()).then((b) => [...new Uint8Array(b)])")
        with zipfile.ZipFile(io.BytesIO(bytes(data))) as labels:
            pixels = png_bytes(zipfile.Path(labels, f"{self.served.state()['views'][0]['frame']}_label.png"))
        inside, outside = {pixels[SIZE[0] * j + i] for j in range(6, 28) for i in range(6, 28)}, pixels[40 * SIZE[0]:]
        self.assertEqual(len(inside), 1, "a region that is ignored has labels")
        self.assertNotIn(inside.pop(), {row["id"] for row in self.served.state()["classes"]})
        self.assertGreater(sum(v in {row["id"] for row in self.served.state()["classes"]} for v in outside), len(outside) / 2)
        self.assertEqual(page.complaints() + other.complaints(), [])

    def test_kills_lose_nothing(self):
        page = self.open()
        page.keys("home")
        self.make_class(page, "kept")
        clicks = 0
        for round_ in range(4):
            self.click(page, 20.5 + 10 * round_, 30.5)
            clicks += 1
            self.wait_saved(page, clicks)
            self.served.ended_by(signal.SIGKILL)
            self.click(page, 20.5 + 10 * round_, 60.5)  # nobody responds
            page.wait("document.getElementById('saving').textContent == '1 not saved yet'")
            page.wait("document.getElementById('connection').textContent.startsWith('Connection lost')")
            self.assertEqual(self.serve(by_run=round_ % 2 == 0), self.url)
            page.wait("document.getElementById('connection').textContent == 'connected'", "the page does not go on by itself")
            clicks += 1
            self.wait_saved(page, clicks)
            state = self.served.state()
            self.assertEqual(len(state["marks"]), clicks)
            self.assertEqual(state["classes"][-1]["name"], "kept")
            page.wait(f"[...document.querySelectorAll('#classes .clicks')].at(-1).textContent == '{clicks}'")
            page.keys("home")
            page.wait("document.querySelector('#strip [aria-current=true]').dataset.view == 0")
            page.run("document.querySelector('#classes button:last-child').click()")
        self.wait_learned(page)
        self.wait_mixed(page, 22.5, 60.5, self.colors()["kept"], "the click that was sent again is not in the overlay")
        ids = [event["id"] for event in self.events()]
        self.assertEqual(len(ids), len(set(ids)))


if __name__ == "__main__":
    page_case.main()
