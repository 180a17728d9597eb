#!/usr/bin/env python3
"""`semfield serve` with a small room: clicks over HTTP, kills, signals, exports by its own verbs. SEMFIELD_PAGE: the
build has the page."""

import contextlib
import ctypes
import http.client
import io
import random
import re
import threading
import zipfile

from program import *

HAS_PAGE = os.environ.get("SEMFIELD_PAGE", "1") == "1"
CHAIR = {"id": "c", "type": "class", "name": "chair"}


class Served:
    """A `semfield serve` that has printed its address."""

    def __init__(self, case, *words):
        self.process = case.start("serve", *words)
        said = until(lambda: re.match(r"serve: open http://127\.0\.0\.1:(\d+)(/\S*).*\n",
                                      self.process.out_file.read_text()) or self.process.process.poll() is not None)
        case.assertIsInstance(said, re.Match, self.process.err())
        self.case, self.port, self.folder = case, int(said[1]), said[2]

    def connect(self, seconds=120):
        return contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=seconds))

    def ask_over(self, connection, method, name, body=None):
        """Status and body of the answer."""
        connection.request(method, self.folder + name, body)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def ask(self, *words):
        with self.connect() as connection:
            return self.ask_over(connection, *words)

    def get(self, name):
        status, body = self.ask("GET", name)
        self.case.assertEqual(status, 200, body)
        return body

    def post(self, name, event):
        status, body = self.ask("POST", name, json.dumps(event))
        self.case.assertEqual(status, 200, body)
        return json.loads(body)

    def state(self, after=0):
        return json.loads(self.get(f"state?after={after}"))

    def state_when(self, condition, seconds=240):
        state, end = self.state(), time.monotonic() + seconds
        while not condition(state) and time.monotonic() < end:
            self.state(state["revision"])  # waits for news
            state = self.state()
        return state

    def click(self, id):
        view = self.state()["views"][0]
        return {"id": id, "type": "click", "frame": view["frame"], "size": [view["width"], view["height"]],
                "points": [[3, 4]], "radius": 2, "class": "chair"}

    def ended_by(self, number):
        self.process.send(number)
        return self.process.wait(120)


class NoPage(ProgramCase):
    def test_the_packages_that_it_needs_are_named(self):
        self.ended("serve room.yaml", 69, "-DSEMFIELD_WITH_SERVE=ON", "libturbojpeg0-dev", "[serve.page.missing]")


class Serve(ProgramCase):
    def setUp(self):
        super().setUp()
        self.run_dir = self.dir / "room"

    def serve(self, steps=200, every_s=1):
        """The run of its own, begun where it is not there."""
        config = self.dir / "config.yaml"
        return Served(self, config if config.exists() else self.room(steps, every_s), "--out", self.run_dir)

    def test_clicks_outlive_kills_and_the_run_goes_on(self):
        served = self.serve()
        served.post("event", CHAIR)
        self.assertTrue(served.post("event", served.click("k"))["applied"])
        address = served.folder
        served.ended_by(signal.SIGKILL)
        served = self.serve()
        self.has(served.process.err(),
                 f"continuing with {self.run_dir}, which is there already, by the settings in its run.yaml")
        self.assertEqual(served.folder, address)  # a page that is open goes on
        state = served.state()
        self.assertEqual((state["events"], len(state["marks"])), (2, 1))
        self.assertFalse(served.post("event", served.click("k"))["applied"])
        self.ended(served.ended_by(signal.SIGINT), 130, " labels, all saved\nnext        semfield serve "
                   f"{shlex.quote(str(self.run_dir))}")
        served = Served(self, self.run_dir)
        self.assertEqual(served.state()["events"], 2)
        self.assertEqual(served.ended_by(signal.SIGTERM).code, 143)

    def test_random_kills_lose_no_answered_click(self):
        """At any moment between a click and its acknowledgement; SEMFIELD_TORTURE_KILLS sets how many."""
        chance, answered = random.Random(11), set()
        for kill in range(int(os.environ.get("SEMFIELD_TORTURE_KILLS", 8))):
            served = self.serve()
            if kill == 0:
                served.post("event", CHAIR)
            state = served.state()
            self.assertEqual(state["failure"], "")
            self.assertEqual(answered - {mark["id"] for mark in state["marks"]}, set(), f"lost after kill {kill}")
            click = served.click("")
            killer = threading.Timer(chance.uniform(0, 0.3), served.process.send, (signal.SIGKILL,))
            killer.start()
            with served.connect(10) as connection, contextlib.suppress(OSError, http.client.HTTPException):
                for n in range(1_000_000):
                    click["id"] = f"k{kill}-{n}"
                    if served.ask_over(connection, "POST", "event", json.dumps(click))[0] != 200:
                        break
                    answered.add(click["id"])
            killer.join()
            served.process.wait(60)
        self.assertGreater(len(answered), 10)

    def test_exports_are_those_of_the_verbs(self):
        served = self.serve(50)
        served.post("event", CHAIR)
        served.post("event", served.click("k"))
        views = sum(not view["held_out"] for view in served.state()["views"])
        for what in ("labels", "coco", "mesh"):
            served.post("export", {"what": what})
            exports = served.state_when(
                lambda state: state["exports"][-1]["state"] not in ("waiting", "running"))["exports"]
            self.assertEqual(exports[-1]["state"], "done", exports)
        served.post("export", {"what": "mesh"})
        with zipfile.ZipFile(io.BytesIO(served.get("export/labels-1/0"))) as labels:
            self.assertEqual(len(labels.namelist()), views + 1)  # and the classes
        self.assertEqual(len(json.loads(served.get("export/coco-1/0"))["images"]), views)
        self.assertEqual([served.get(f"export/mesh-1/{n}")[:4] for n in range(4)], [b"ply\n", b"glTF"] * 2)
        self.ended(served.ended_by(signal.SIGINT), 130, "the export mesh-2 was stopped; begin it again on the page")

    def test_the_next_port_is_taken_unless_one_is_named(self):
        first, other = self.serve(50), self.folder() / "room"
        words = [self.dir / "config.yaml", "--out", other]
        self.ended(["serve", *words, "--port", first.port], 69, f"port {first.port} of 127.0.0.1", "leave --port out",
                   "[serve.port.taken]")
        self.assertFalse(other.exists())
        self.assertNotEqual(Served(self, *words).port, first.port)

    def test_what_cannot_be_written_is_told_and_ends_with_its_own_exit_code(self):
        """As on a full disk: a file stands where checkpoints are written."""
        served = self.serve(100_000, 0.05)
        served.post("event", CHAIR)
        self.assertTrue(until((self.run_dir / "checkpoints/latest").exists))
        file = self.write("room/file", "")
        # One exchange, because the program goes on writing into the folder.
        self.assertEqual(ctypes.CDLL(None).renameat2(-100, os.fsencode(file), -100,
                                                     os.fsencode(self.run_dir / "checkpoints"), 2), 0)
        state = served.state_when(lambda state: state["trouble"], 120)
        self.has(state["trouble"], "checkpoints")
        self.assertEqual(state["failure"], "")
        self.assertTrue(served.post("event", served.click("k"))["applied"])
        self.ended(served.ended_by(signal.SIGTERM), 74, "every label is stored")

    def test_a_thing_is_what_a_segmenter_saw(self):
        """Halves of a photograph that nothing in it tells apart."""
        (self.dir / "masks").mkdir()
        config = self.room(1_000_000, 1)
        self.ended(["serve", config, "--segments", self.dir / "masks"], 65, "holds no segments of a training frame",
                   "[objects.segments.none]")
        served = self.serve(1_000_000)
        view = served.state()["views"][0]
        served.ended_by(signal.SIGTERM)
        half = view["width"] // 2
        png(self.dir / f"masks/{view['frame']}.png", view["width"], view["height"], 0, 8,
            [bytes([1] * half + [2] * (view["width"] - half))] * view["height"])
        served = Served(self, self.run_dir, "--segments", self.dir / "masks")
        self.assertTrue(served.state_when(lambda state: state["run"]["geometry_ready"])["run"]["geometry_ready"])
        for x, share in ((half // 2, half / view["width"]), (half + half // 2, 1 - half / view["width"])):
            status, answer = served.ask("POST", "thing", json.dumps(
                {"client": "c", "view": 0, "also": [[x, view["height"] // 2]], "not": [], "level": 0}))
            self.assertEqual(status, 200, answer)
            size = struct.unpack_from("<I", answer)[0]
            self.assertAlmostEqual(json.loads(answer[4:4 + size])["share"], share, delta=0.001)
        self.ended(served.ended_by(signal.SIGTERM), 143,
                   f"semfield serve {shlex.quote(str(self.run_dir))} --segments {self.dir / 'masks'}")

    def test_a_full_disk_ends_nothing_and_no_row_is_lost(self):
        """A disk of 6 MB that somebody else fills for a moment while checkpoints are written."""
        self.room(1_000_000, 0.05)
        (self.dir / "disk").mkdir()
        if subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", self.dir / "disk"],
                          capture_output=True).returncode:
            self.skipTest("this system lets nobody mount a tmpfs in a namespace of its own")
        script = self.write("script", f"""mount -t tmpfs -o size=6m tmpfs disk || exit 99
latest=disk/run/checkpoints/latest
within_a_minute() {{ turn=0; until eval "$1" || [ $turn = 600 ]; do sleep 0.1; turn=$((turn + 1)); done; }}
{shlex.quote(PROGRAM)} serve config.yaml --out disk/run >out 2>err &
pid=$!
within_a_minute '[ -e $latest ]'
dd if=/dev/zero of=disk/other bs=1k 2>/dev/null
sleep 2; before=$(cat $latest); rm disk/other
within_a_minute '[ "$(cat $latest)" != "$before" ]'
kill -TERM $pid; wait $pid; echo $?; [ $turn = 600 ] && echo 'no checkpoint after the disk has room again'
cp -r disk/run copy
""")
        said = subprocess.run(["unshare", "-rm", "sh", script], cwd=self.dir, capture_output=True, text=True)
        self.assertEqual((said.returncode, said.stdout), (0, "143\n"), said.stderr + (self.dir / "err").read_text())
        rows = [json.loads(row)["step"] for row in (self.dir / "copy/metrics.jsonl").read_text().splitlines()]
        self.assertEqual(rows, list(range(5, rows[-1] + 1, 5)), "a row is lost or torn")
        self.assertGreaterEqual(newest_step(self.dir / "copy"), rows[-1])
        tensors(self.dir / "copy")  # sound

    def test_another_runs_clicks_are_not_added_to(self):
        """A run begun with another's run.yaml must not click into that run's file."""
        served = self.serve(50)
        served.post("event", CHAIR)
        self.assertEqual(served.ended_by(signal.SIGTERM).code, 143)
        clicks = self.run_dir / "clicks.jsonl"
        before = clicks.read_bytes()
        self.ended(["serve", self.run_dir / "run.yaml", "--out", self.dir / "other"], 73,
                   f"the clicks in '{clicks}' are those of another run")
        self.assertEqual(clicks.read_bytes(), before)

    def test_a_run_of_train_is_not_taken_for_one_of_its_own(self):
        config = self.room(3, 1)
        self.ok(["train", config, "--out", self.run_dir, "-q"])
        for words in (["serve", config, "--out", self.run_dir], ["serve", self.run_dir]):
            self.ended(words, 73, f"{self.run_dir}: it holds a run that was not begun by `semfield serve`")
        self.assertFalse((self.run_dir / "clicks.jsonl").exists())

    def test_a_run_that_is_served_already_is_left_alone(self):
        first = self.serve(50)
        second = self.semfield(["serve", self.run_dir])
        self.assertNotEqual(second.code, 0)
        self.has(second.err, str(self.run_dir))
        first.post("event", CHAIR)


globals().pop("NoPage" if HAS_PAGE else "Serve")  # what the other build has


if __name__ == "__main__":
    main()
