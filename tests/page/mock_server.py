#!/usr/bin/env python3
"""A stand-in for `semfield serve`: serves the page with a small room that learns at once. For tests of the page, and to work on it:
  python3 mock_server.py [--port 8090] [--views 12] [--size 160x120] [--held-out 2] [--classes]"""

import argparse
import functools
import http.server
import json
import math
import pathlib
import struct
import threading
import time
import urllib.parse
import zlib

# A flat room: one long picture, of which each view shows a part. A place is a point of it, in widths and heights of a view.
THINGS = {  # by number, each before those above it: left, top, right, bottom, colour
    2: (-9, 0, 9, 1, (198, 190, 178)), 0: (-9, 0.7, 9, 1, (158, 132, 102)), 1: (-9, 0, 9, 0.2, (228, 228, 224)),
    4: (0.45, 0.35, 0.85, 0.75, (118, 130, 160)), 5: (0.05, 0.6, 0.3, 0.8, (150, 106, 70)), 6: (0.95, 0.2, 1.2, 0.7, (176, 168, 150)),
    7: (0.3, 0.2, 0.36, 0.35, (240, 226, 180)),
}


def png(width, height, rows, color_type, palette=None):
    """A PNG of 8 bits a value. color_type: 0 grey, 2 RGB, 3 palette, whose entry 0 is transparent."""
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    out = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, color_type, 0, 0, 0))
    if palette:
        out += chunk(b"PLTE", bytes(v for rgb in palette for v in rgb)) + chunk(b"tRNS", b"\0")
    return out + chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows), 1)) + chunk(b"IEND", b"")


def left_of(view):
    """Where its part of the picture begins."""
    return 0.06 * (view % 5)


@functools.lru_cache(maxsize=None)
def rendered(view, width, height):
    """(rgb rows, objects [height][width]) of a view."""
    rows, objects = [], []
    for j in range(height):
        places = [(left_of(view) + (i + 0.5) / width, (j + 0.5) / height) for i in range(width)]
        objects.append(bytes([which for which, (l, t, r, b, _) in THINGS.items() if l <= u < r and t <= v < b][-1] for u, v in places))
        rows.append(b"".join(bytes(THINGS[which][4]) for which in objects[-1]))
    return rows, objects


def photo(k, width, height, scale, is_turned=False):
    """The photograph of view k as PNG, `scale` times as large: then with lines that are one of its pixels wide, 8 of a small one's apart."""
    rows = rendered(k, width, height)[0][::-1 if is_turned else 1]
    if scale == 1:
        return png(width, height, rows, 2)
    large = []
    for row in rows:
        wide = bytearray(b"".join(row[3 * i:3 * i + 3] * scale for i in range(width)))
        for x in range(0, width * scale, 8 * scale):
            wide[3 * x:3 * x + 3] = b"\xff\xff\xff"
        large += [bytes(wide)] * scale
    return png(width * scale, height * scale, large, 2)


PAGE = pathlib.Path(__file__).resolve().parents[2] / "app/serve/page"
TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
COLORS = [[200, 60, 60], [60, 140, 220], [80, 180, 90], [230, 180, 60]]


class Room:
    """Events, and what a program that learns would say about them. `faults` is for tests:
    "overlay": label maps stay as they are; "event": 503 and a sentence; "refuse": 400; "lost": a click never arrives; "drop": it is
    applied, but the response is lost; "silent": the state is sent to nobody; "picture": slow; "slow export": for ever."""

    def __init__(self, views=12, size=(160, 120), classes=(), room=32, held_out=0, photo_scale=1):
        self.size, self.most, self.held_out, self.photo_scale = size, room, held_out, photo_scale
        self.photos = []  # (view, most_px) that were requested
        self.frames = [f"rgb_{k:02}" for k in range(views)]
        self.given = [{"name": name, "color": COLORS[i % 4], "own": True} for i, name in enumerate(classes)]
        self.events, self.exports, self.faults, self.received = [], [], set(), []
        self.start, self.revision, self.overlay, self.failure = time.time(), 1, [1, 0], ""
        self.run_id, self.trouble, self.turned = "run-1", "", 0  # turned: photographs stand on their heads
        self.changed = threading.Condition()
        self.pictures, self.most_pictures, self.picture_lock = 0, 0, threading.Lock()
        self.polls, self.things = 0, []
        self.told, self.unreached = {}, 0  # told: states by revision

    def touch(self):
        with self.changed:
            self.revision += 1
            self.changed.notify_all()

    def view(self, k):
        return rendered(k, *self.size)

    # What the events add up to.
    def alive(self, events):
        dead = set()
        for event in reversed(events):  # an undo that is undone undoes nothing
            if event["type"] == "undo" and event["id"] not in dead:
                dead ^= {event["of"]}
        return [e for e in events if e["type"] != "undo" and e["id"] not in dead]

    def classes(self, alive):
        classes = [dict(row) for row in self.given]
        names = {row["name"]: row for row in classes}
        for event in alive:
            if event["type"] == "class":
                row = {"name": event["name"], "color": event.get("color") or COLORS[len(classes) % 4], "own": False}
                classes.append(row)
                names[event["name"]] = row
            if event["type"] == "rename" and event["class"] in names:
                row = names[event["class"]]
                row["name"], row["color"] = event["name"], event.get("color", row["color"])
                names[event["name"]] = row
            if event["type"] == "merge":
                names[event["class"]] = names[event["into"]]
            if event["type"] == "delete":
                names.pop(event["class"], None)
        ended = {e["class"] for e in alive if e["type"] in ("merge", "delete")}
        for row in classes:
            row["ended"] = row["name"] in ended
        index = {name: classes.index(row) for name, row in names.items()}
        return classes, {**index, "void": -1}

    def marks(self, alive, index):
        return [{"id": e["id"], "view": self.frames.index(e["frame"]), "points": e["points"], "radius": e["radius"], "fill": e.get("fill", False),
                 "object": e.get("object", 0), "class": index[e["class"]]} for e in alive if e["type"] == "click" and e["class"] in index]

    def inside(self, mark):
        """A pixel of the mark: its first point, or the middle of an outline."""
        points = mark["points"] if mark["fill"] else mark["points"][:1]
        return int(sum(p[0] for p in points) / len(points)), int(sum(p[1] for p in points) / len(points))

    def learned(self, marks):
        """Object -> class by the last click on it."""
        known = {}
        for mark in marks:
            x, y = self.inside(mark)
            if mark["class"] >= 0:
                known[self.view(mark["view"])[1][y][x]] = mark["class"]
        return known

    def place(self, view, at):
        return left_of(view) + at[0] / self.size[0], at[1] / self.size[1]

    def pixel_of(self, view, place):
        """Where a view has a place; None: it does not see it."""
        x = (place[0] - left_of(view)) * self.size[0]
        return [x, place[1] * self.size[1]] if 0 <= x < self.size[0] else None

    def seen(self, marks, view):
        """Marks of other views that a view sees."""
        places = [(m["id"], self.pixel_of(view, self.place(m["view"], m["points"][0]))) for m in marks if m["view"] != view and m["class"] >= 0]
        return [{"id": id_, "points": [at]} for id_, at in places if at]

    def apply(self, event):
        if any(e["id"] == event["id"] for e in self.events):
            return False
        alive = self.alive(self.events)
        classes, index = self.classes(alive)
        if event["type"] == "click" and self.frames.index(event["frame"]) >= len(self.frames) - self.held_out:
            raise ValueError(f"frame '{event['frame']}' is not a training frame", "label training frames only")
        if event["type"] == "click" and event["class"] not in index:
            raise ValueError(f"there is no class '{event['class']}'", "make it first")
        if event["type"] == "class" and event["name"] in {row["name"] for row in classes}:
            raise ValueError(f"there is a class '{event['name']}' already", "choose another name")
        if event["type"] in ("merge", "delete") and event["class"] not in index:
            raise ValueError(f"no class '{event['class']}'", "")
        self.events.append(event)
        self.touch()
        threading.Timer(0.35, self.learn).start()
        return True

    def learn(self):
        if "overlay" not in self.faults and self.overlay[1] != len(self.events):
            self.overlay = [self.overlay[0] + 1, len(self.events)]
            self.touch()

    def proposal(self, known, skipped):
        for which in (4, 5, 6, 0, 7, 2, 1):
            for k in range(len(self.frames) - self.held_out):
                if which in known or (which, k) in skipped or k % 3:
                    continue
                at = [(i, j) for j, row in enumerate(self.view(k)[1]) for i, v in enumerate(row) if v == which]
                if len(at) > 40:
                    i, j = at[len(at) // 2]
                    return {"id": f"p{which}-{k}", "view": k, "at": [i + 0.5, j + 0.5], "why": "unseen" if len(known) < 2 else "uncertain",
                            "class_guess": known[min(known)] if known else -1}
        return None

    def state(self, after):
        alive = self.alive(self.events)
        classes, index = self.classes(alive)
        marks = self.marks(alive, index)
        known = self.learned(marks)
        skipped = set()
        for e in alive:
            if e["type"] == "skip":
                k = self.frames.index(e["frame"])
                skipped.add((self.view(k)[1][int(e["points"][0][1])][int(e["points"][0][0])], k))
        seconds = time.time() - self.start
        share = 1 / max(1, len(known))
        return {
            "revision": self.revision, "overlay": {"revision": self.overlay[0], "events": self.overlay[1]}, "events": len(self.events),
            "run": {"id": self.run_id, "name": "mock_room", "folder": "runs/mock_room", "device": "CPU, 2 threads", "step": int(seconds * 9), "train_s": seconds, "loss": 0.1,
                    "psnr": 14 + 12 * (1 - math.exp(-seconds / 15)), "rays_per_s": 21500, "phase": "learning colour and geometry", "geometry_ready": True, "unreached": self.unreached, "temperature": 1.2},
            "room": {"named": len(classes), "most": self.most},
            "classes": [{"index": i, **row, "clicks": sum(m["class"] == i for m in marks), "area_share": share * list(known.values()).count(i),
                         "confidence": 0.9 if i in known.values() else 0} for i, row in enumerate(classes) if not row["ended"]],
            "views": [{"frame": f, "width": self.size[0], "height": self.size[1], "clicks": sum(m["view"] == k for m in marks),
                       "entropy": max(0.05, 0.9 - 0.1 * len(known) - 0.02 * (k % 4)), "ready": bool(known), "photo": f"{k}-{self.turned}",
                       "held_out": k >= len(self.frames) - self.held_out} for k, f in enumerate(self.frames)],
            "proposal": self.proposal(known, skipped), "marks": marks, "exports": self.exports, "notes": [], "trouble": self.trouble, "failure": self.failure}

    def news(self, after):
        """What of the state a client has not got that was told `after`, as the program says it."""
        state = json.loads(json.dumps(self.state(after)))
        before = self.told.get(after, {})
        self.told.setdefault(state["revision"], state)
        news = {key: value for key, value in state.items() if before.get(key) != value}
        news["revision"] = state["revision"]
        if "views" in news:
            changes = [{k: v for k, v in view.items() if not before or before["views"][i].get(k) != v} for i, view in enumerate(state["views"])]
            news["views"] = [{"index": i, **change} for i, change in enumerate(changes) if change]
        if "marks" in news:
            had = before.get("marks", [])
            kept = next((i for i, (a, b) in enumerate(zip(had, state["marks"])) if a != b), min(len(had), len(state["marks"])))
            news.update(marks=state["marks"][kept:], marks_kept=kept)
        return news

    def picture(self, wish):
        marks = [m for m in self.marks(*(lambda a: (a, self.classes(a)[1]))(self.alive(self.events[:self.overlay[1]])))]
        classes = self.classes(self.alive(self.events))[0]
        known = self.learned(marks)
        begin = time.time()
        (width, height), (rows, objects) = self.size, self.view(wish["view"])
        other = known[min(known)] if known else -1
        table = bytes(known.get(v, other) + 1 for v in range(256))
        doubt = bytes((40 if v in known else 220) if known else 128 for v in range(256))
        head = {"width": width, "height": height, "overlay_revision": self.overlay[0], "render_ms": 1000 * (time.time() - begin), "stale": False,
                "marks": self.seen(marks, wish["view"])}
        parts = [json.dumps(head).encode(), png(width, height, rows, 2) if wish.get("color") else b"",
                 png(width, height, [r.translate(table) for r in objects], 3, [[0, 0, 0]] + [c["color"] for c in classes]) if wish.get("labels") else b"",
                 png(width, height, [r.translate(doubt) for r in objects], 0) if wish.get("entropy") else b""]
        return b"".join(struct.pack("<I", len(part)) + part for part in parts)

    def thing(self, wish):
        """The box of the object at the first place, 4 pixels larger for each level; other places widen it, and it ends left of what is no part of it."""
        self.things.append(wish)
        (width, height), objects = self.size, self.view(wish["view"])[1]
        (x, y), level = wish["also"][0], max(-1, min(2, wish["level"]))
        which = objects[int(y)][int(x)]
        at = [(i, j) for j in range(height) for i in range(width) if objects[j][i] == which]
        xs, ys = [i for i, _ in at] + [p[0] for p in wish["also"][1:]], [j for _, j in at] + [p[1] for p in wish["also"][1:]]
        left, top, bottom = min(xs) - 4 * level, min(ys) - 4 * level, max(ys) + 1 + 4 * level
        right = min([max(xs) + 1 + 4 * level, *(p[0] for p in wish["not"])])
        facts = {"width": width, "height": height, "stale": False, "level": level, "least": -1, "most": 2, "share": 0.1, "class_guess": 0,
                 "outlines": [[[left, top], [right, top], [right, bottom], [left, bottom]]]}
        return b"".join(struct.pack("<I", len(part)) + part for part in (json.dumps(facts).encode(), b""))

    def export(self, what):
        job = {"id": f"x{len(self.exports) + 1}", "what": what, "state": "running", "text": "exported 3/12 frames, 0:09 left", "files": []}
        self.exports.append(job)
        self.touch()

        def finish():
            if what == "mesh":
                job.update(state="failed", text="The surface is empty yet. Train for a minute, then export again.")
            else:
                job.update(state="done", text="", files=[f"{f}_label.png" for f in self.frames] if what == "labels" else ["annotations.json"])
            self.touch()
        if "slow export" not in self.faults:
            threading.Timer(0.4, finish).start()
        return {"id": job["id"]}

    def cancel_export(self, number):
        for job in self.exports:
            if job["id"] == number:
                job.update(state="canceled", text="")
        self.touch()
        return {"id": number}


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def answer(self, body, kind="application/json", status=200, cache="no-store"):
        if not isinstance(body, bytes):
            body = json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": len(body), "Cache-Control": cache, "Referrer-Policy": "no-referrer",
                            "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:", "X-Content-Type-Options": "nosniff"}.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)

    def break_off(self):
        """A response that begins and does not end: browsers repeat a request by themselves only when none begins."""
        self.send_response(200)
        self.send_header("Content-Length", "100")
        self.end_headers()
        self.close_connection = True

    def path_below_token(self):
        path, _, query = self.path.partition("?")
        if self.server.ended:  # the process is gone
            self.close_connection = True
            return None, None
        if not path.startswith(self.server.folder):
            self.answer({"error": "This address has another token.", "remedy": "Open the address that the program prints."}, status=404)
            return None, None
        return path[len(self.server.folder):], dict(urllib.parse.parse_qsl(query))

    def do_GET(self):
        room = self.server.room
        path, query = self.path_below_token()
        if path is None:
            return
        file = PAGE / (path or "index.html")
        if "/" not in path and file.is_file():
            self.answer(file.read_bytes(), TYPES[file.suffix])
        elif path == "state":
            room.polls += 1
            with room.changed:
                if int(query["after"]) > 0:
                    room.changed.wait_for(lambda: "silent" not in room.faults and room.revision > int(query["after"]) or self.server.ended,
                                          timeout=30 if "silent" in room.faults else 2)
                if self.server.ended:
                    self.close_connection = True
                    return
                news = room.news(int(query["after"]))
            self.answer(news)
        elif path == "photo":
            view, most = int(query["view"]), int(query.get("most_px", 0))
            room.photos.append((view, most))
            scale = 1 if 0 < most <= 480 else room.photo_scale
            named = query.get("photo") == f"{view}-{room.turned}"
            self.answer(photo(view, *room.size, scale, room.turned), "image/png", cache="max-age=600, immutable" if named else "no-store")
        elif path.startswith("export/"):
            self.answer(b"exported", "application/octet-stream")
        else:
            self.answer({"error": "Nothing is here.", "remedy": ""}, status=404)

    def do_POST(self):
        room = self.server.room
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        path, _ = self.path_below_token()
        if path == "event":
            room.received.append(body["id"])
            if "lost" in room.faults:
                room.faults.discard("lost")
                return self.break_off()
            if "event" in room.faults:
                return self.answer({"error": "The click could not be stored: no space left on the disk.", "remedy": "Make room; the page sends it again."}, status=503)
            if "refuse" in room.faults:
                return self.answer({"error": f"event '{body['id']}': frame 'rgb_00' is held out for tests", "remedy": "label another view"}, status=400)
            try:
                applied = room.apply(body)
            except ValueError as error:
                return self.answer({"error": error.args[0], "remedy": error.args[1]}, status=400)
            if "drop" in room.faults:
                room.faults.discard("drop")
                return self.break_off()
            self.answer({"applied": applied, "revision": room.revision})
        elif path == "picture":
            with room.picture_lock:
                room.pictures += 1
                room.most_pictures = max(room.most_pictures, room.pictures)
            if "picture" in room.faults:
                time.sleep(0.4)
            data = room.picture(body)
            with room.picture_lock:
                room.pictures -= 1
            self.answer(data, "application/octet-stream")
        elif path == "thing":
            self.answer(room.thing(body), "application/octet-stream")
        elif path == "export":
            self.answer(room.cancel_export(body["cancel"]) if "cancel" in body else room.export(body["what"]))
        elif path:
            self.answer({"error": "Nothing is here.", "remedy": ""}, status=404)


class Quiet(http.server.ThreadingHTTPServer):
    """Says nothing of browsers that leave."""

    allow_reuse_address = daemon_threads = True

    def handle_error(self, *_):
        pass


class Server:
    """Serves a room until it is stopped; start again with the same room, port and token goes on."""

    def __init__(self, room, port=0, token="mocktoken"):
        self.room, self.port, self.token = room, port, token

    def start(self):
        self.room.told = {}  # another process knows nothing of those
        self.http = Quiet(("127.0.0.1", self.port), Handler)
        self.http.room, self.http.folder, self.http.ended = self.room, f"/{self.token}/", False
        self.port = self.http.server_address[1]
        threading.Thread(target=self.http.serve_forever, args=(0.05,), daemon=True).start()
        return f"http://127.0.0.1:{self.port}/{self.token}/"

    def stop(self):
        """Like a killed process: no response comes any more, not to waiting requests either."""
        self.http.ended = True
        self.http.shutdown()
        self.http.server_close()
        self.room.touch()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=8090)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--held-out", type=int, default=2, help="the last views are test frames")
    parser.add_argument("--classes", action="store_true", help="the scene has classes of its own")
    given = parser.parse_args()
    room = Room(given.views, tuple(int(v) for v in given.size.split("x")), ("floor", "wall", "sofa") if given.classes else (),
                held_out=given.held_out, photo_scale=4)
    print(Server(room, given.port).start(), flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
