#!/usr/bin/env python3
"""The page of a run, as a file beside the PLY file of the same mesh and from `semfield view`, in headless Chromium."""

import base64
import itertools
import json
import math
import pathlib
import re
import struct
import subprocess
import sys
import tempfile
import time
import zlib

import browser
import live_view
from handover import ply
from program import PROGRAM, SOURCE

CONFIG = str(SOURCE / "configs/quickstart.yaml")
SETTINGS = {"scene.frames": 24, "scene.test_frames": 1, "scene.load.width_px": 80, "scene.labels.frames": "all", "train.steps": 500, "train.rays": 512, "runtime.threads": 2, "report.eval_share": 0}
NO_CLASS = 65535


def semfield(*words):
    done = subprocess.run([PROGRAM, *words, "-q"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def part(text, name):
    return re.search(rf'<script type="[^"]*" id="{name}">(.*?)</script>', text, re.S).group(1)


def numbers(data, at, form, count):
    return struct.unpack_from(f"<{count}{form}", data, at), at + count * struct.calcsize(form)


def read_page(text):
    """facts, corners of triangles, positions, labels, colours, entropy and objects."""
    facts = json.loads(part(text, "facts"))
    data, count = zlib.decompress(base64.b64decode(part(text, "mesh"))), facts["vertices"]
    steps, at = numbers(data, 0, "I", 3 * facts["triangles"])
    corners = [value % 2**32 for value in itertools.accumulate(steps)]
    axes = []
    for axis in range(3):
        steps, at = numbers(data, at, "H", count)
        low, high = facts["low"][axis], facts["high"][axis]
        axes.append([low + value % 65536 * (high - low) / 65535 for value in itertools.accumulate(steps)])
    normals, channels = [], []
    for _ in range(3):
        normal, at = numbers(data, at, "b", count)
        normals.append(normal)
    assert all(120 < math.hypot(*normal) < 134 for normal in zip(*normals)), "normals are units of 127 steps"
    labels, at = numbers(data, at, "H", count)
    for _ in range(3):
        channel, at = numbers(data, at, "B", count)
        channels.append(channel)
    entropy, at = numbers(data, at, "B", count)
    objects, at = numbers(data, at, "H", count) if facts["objects"] else ((0,) * count, at)
    assert at == len(data), (at, len(data))
    return facts, corners, list(zip(*axes)), labels, list(zip(*channels)), entropy, objects


def read_ply(path):
    """Positions, colours, class ids and entropy of vertices; corners of faces."""
    vertex, face = (ply.read(path)[name] for name in ("vertex", "face"))
    triples = lambda *names: list(zip(*(vertex[name] for name in names)))
    return triples("x", "y", "z"), triples("red", "green", "blue"), vertex["label"], vertex["entropy"], [tuple(corners) for corners in face["vertex_indices"]]


def compare(page, mesh):
    facts, corners, places, labels, colors, shares, objects = page
    positions, ply_colors, ids, entropy, faces = mesh
    assert (facts["vertices"], facts["triangles"], facts["unit"]) == (len(positions), len(faces), "m"), facts
    allowed = max(high - low for low, high in zip(facts["low"], facts["high"])) / 65535
    for a, b in zip(places, positions):
        assert max(abs(x - y) for x, y in zip(a, b)) <= allowed, (a, b)
    assert list(colors) == ply_colors
    of_ids = [-1 if label == NO_CLASS else facts["classes"][label]["id"] for label in labels]
    assert all(got == want or (got == -1 and want < 0) for got, want in zip(of_ids, ids)), "classes of vertices"
    assert len(set(of_ids)) > 2, "a room has some classes"
    assert sum(nats > facts["entropy"] for nats in entropy) <= 0.01 * len(entropy) + 1, "colours of entropy end at its 99th percentile"
    assert all(abs(share - min(255, 255 * nats / facts["entropy"])) <= 1 for share, nats in zip(shares, entropy)), "entropy as a share"
    ids_there = {row["id"] for row in facts["objects"]}
    assert ids_there and set(objects) - {0} <= ids_there and len(set(objects)) > 2, (ids_there, set(objects))
    assert list(corners) == [corner for face in faces for corner in face]
    assert all(len({labels[v] for v in face}) == 1 for face in faces), "a face is of one class"
    of_place = {}
    for place, label in zip(positions, labels):
        of_place.setdefault(place, set()).add(label)
    assert any(len(found) > 1 for found in of_place.values()), "some border of classes"


def drawn(view):
    """Draw calls, once no picture follows: where one takes long, a whole one comes after a light one."""
    calls = None
    while (now := view.run("return semfield.drawing.calls")) != calls:
        calls = now
        time.sleep(1)
    return calls


def look(driver, path, page):
    facts, _, places, labels, *_ = page
    view = driver.browser()
    view.open("file://" + str(path))
    view.wait("document.body.dataset.state === 'ready'", "the page draws", 60)
    assert view.text("#title") == facts["title"] and "steps of training" in view.text("#about")
    assert view.run("return performance.getEntriesByType('resource').length") == 0, "nothing is fetched"
    assert view.run("return document.getElementById('inside').getAttribute('aria-pressed')") == "true", "a room opens inside"
    view.click("#outside")
    view.wait("document.getElementById('outside').getAttribute('aria-pressed') === 'true'")
    (left, right), (top, bottom), free = view.run("""
        const {camera, layer} = semfield, {forward} = camera.axes, m = camera.turnToY;
        const facing = layer.points().filter(([, n]) => [0, 1, 2].reduce((sum, k) => sum + forward[k] * (m[k] * n[0] + m[4 + k] * n[1] + m[8 + k] * n[2]), 0) < 0);
        const at = facing.map(([place]) => camera.toScreen(place));
        return [...[0, 1].map((k) => [Math.min(...at.map((p) => p[k])), Math.max(...at.map((p) => p[k]))]), semfield.free()];""")
    assert free["left"] - 1 < left < right < free["right"] + 1 and free["top"] - 1 < top < bottom < free["bottom"] + 1, "the scene is in the free part of the canvas"
    assert right - left > 0.9 * (free["right"] - free["left"]) or bottom - top > 0.9 * (free["bottom"] - free["top"]), "and fills it"
    calls = drawn(view)
    view.click("#class")
    view.wait(f"semfield.drawing.calls === {calls + 1}", "a press of a button is one draw call")

    # A vertex whose place in the window is known is read there, as it lies in the input's world.
    reads = view.run("""
        const [places] = arguments, clip = semfield.camera.matrices().clip, found = [];
        for (let i = 0; i < places.length && found.length < 60; i += 97) {
          const p = moved(clip, places[i]);
          if (Math.abs(p[0]) > 0.9 || Math.abs(p[1]) > 0.9) continue;
          const x = (p[0] + 1) / 2 * canvas.clientWidth, y = (1 - p[1]) / 2 * canvas.clientHeight, read = semfield.read(x, y);
          if (read !== null && document.elementFromPoint(x, y) === canvas) found.push([i, read, moved(clip, read.place), p, [x, y]]);
        }
        return found;""", places)
    near = [(read, at) for i, read, _, _, at in reads if math.dist(read["place"], places[i]) < 0.05]
    assert len(near) >= 5, f"{len(near)} of {len(reads)} vertices are read where they are"
    for _, _, got, want, _ in reads:  # others are hidden by what lies before them, on the same ray
        assert math.hypot(got[0] - want[0], got[1] - want[1]) < 0.01, (got, want)
    of_class = {len(facts["classes"]), *labels} - {NO_CLASS}
    assert all(read["label"] in of_class for read, _ in near), near

    # Two clicks measure; the third begins anew.
    (read, start), *_, (_, end) = near
    view.mouse(start)
    view.wait("semfield.points.length === 1", "a click reads a point")
    view.mouse(end)
    view.wait("document.getElementById('readout').textContent.includes('distance')", "two measure")
    first, second = (point["place"] for point in view.run("return semfield.points"))
    told = float(re.search(r"distance ([0-9.]+) m", view.text("#readout")).group(1))
    assert abs(told - math.dist(first, second)) < 0.001, (told, first, second)
    assert view.text("#marks text") == f"{told:.3f} m", "the line says its length"
    yellow = """return semfield.picture().then((blob) => createImageBitmap(blob)).then((image) => {
        const canvas = new OffscreenCanvas(image.width, image.height), context = canvas.getContext('2d');
        context.drawImage(image, 0, 0);
        const {data} = context.getImageData(0, 0, image.width, image.height);
        let count = 0;
        for (let i = 0; i < data.length; i += 4) count += data[i] === 255 && data[i + 1] === 213 && data[i + 2] === 74;
        return count; });"""
    assert view.run(yellow) > 100, "a saved picture keeps it"
    view.mouse(start)
    view.wait("semfield.points.length <= 1", "a third click begins anew")

    # What is hidden is neither drawn nor read.
    view.run("document.querySelectorAll('#class-list input')[arguments[0]].click()", min(read["label"], len(facts["classes"])))
    after = view.run("return semfield.read(arguments[0], arguments[1])", *start)
    assert after is None or after["label"] != read["label"], (read, after)

    view.run("document.querySelector('#class-list input:not(:checked)').click()")
    live_view.choose_an_object(view)
    assert view.run("return document.getElementById('edit').hidden"), "a file edits nothing"

    # Where a picture takes long, a lighter mesh is drawn until the camera rests.
    place = [0, 0, 0, 9, 65535, 0, 0, 9, 0, 65535, 0, 9, 3, 65535, 2, 9]
    assert view.run("return [...lightened({corners: [0, 1, 2, 1, 3, 2, 0, 1, 3], place: arguments[0]})]", place) == [0, 1, 2, 0, 1, 2]
    calls = view.run("const {calls} = semfield.drawing; semfield.drawing.isSlow = true; semfield.look('turn', 30, 0); return calls")
    view.wait(f"semfield.drawing.calls === {calls + 2}", "a light picture, and a whole one")
    light, whole = view.run("const {light, fine} = semfield.layer; return [light.count, fine.count]")
    assert 0 < light <= whole == 3 * facts["triangles"], (light, whole)

    before = view.run("return semfield.camera.matrices().eye")
    view.mouse(start, (start[0] + 80, start[1] + 10))
    assert view.run("return semfield.camera.matrices().eye") != before, "a drag turns"
    view.click("#inside")
    view.wait("document.getElementById('inside').getAttribute('aria-pressed') === 'true'")
    view.size(390, 844, is_phone=True)
    view.wait("canvas.clientWidth === 390")
    assert view.run("return document.documentElement.scrollWidth") <= 390
    view.run("semfield.points = []; semfield.changed()")
    view.wait("(({innerText}) => innerText.includes('Tap a point') && !innerText.includes('drag to move'))(document.getElementById('hint'))", "hints for fingers")
    view.size(390, 844)
    assert view.complaints() == [], view.complaints()
    driver.give_back(view)


def look_at_report(driver, path):
    """The report holds the page, and its policy lets no other script run."""
    stranger = "<script>document.title = 'a stranger'</script>"
    path.write_text(path.read_text(encoding="utf-8").replace("<noscript>", stranger + "<noscript>"), encoding="utf-8")
    view = driver.browser()
    view.open("file://" + str(path))
    view.wait("document.querySelector('#scene iframe').contentDocument.body.dataset.state === 'ready'", "the report shows the scene", 60)
    inside = "document.querySelector('iframe').contentWindow"
    assert view.run(f"return {inside}.document.querySelector('#about').textContent").count("500 steps of training") == 1
    assert view.run("return document.title") != "a stranger"
    assert all("Content Security Policy" in text for text in view.complaints()), "of the stranger alone"
    view.run(f"{inside}.document.getElementById('outside').click()")
    before = view.run(f"return {inside}.semfield.camera.reach")
    wheel = f"const w = {inside}, c = w.document.getElementById('canvas'); %s c.dispatchEvent(new w.WheelEvent('wheel', {{deltaY: -100, cancelable: true}}));"
    view.run(wheel % "")
    assert view.run(f"return {inside}.semfield.camera.reach") == before, "the report scrolls"
    view.run(wheel % "c.focus();")
    assert view.run(f"return {inside}.semfield.camera.reach") < before, "a scene that was clicked comes closer"
    view.size(390, 844)
    assert view.run("return document.documentElement.scrollWidth") <= 390
    driver.give_back(view)


def main():
    with tempfile.TemporaryDirectory(prefix="semfield_scene_page_") as folder:
        run = folder + "/run"
        semfield("train", CONFIG, "--out", run, *(word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")))
        quick = {"objects.steps": 200, "objects.points": 12000, "objects.rays": 60000, "objects.least_points": 8, "objects.neighbours": 2, "objects.least_views": 2}
        semfield("objects", run, *(word for key, value in quick.items() for word in ("--set", f"{key}={value}")))
        told = json.loads(semfield("mesh", run, "--resolution", "64", "--format", "ply,html", "--color", "photo", "--out", folder + "/scene", "--json"))
        assert [pathlib.Path(file).name for file in told["files"]] == ["scene.html", "scene.ply"] and "up" in told, told
        text = pathlib.Path(folder, "scene.html").read_text(encoding="utf-8")
        assert "http" not in text.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", ""), "the file needs no network"
        page = read_page(text)
        compare(page, read_ply(folder + "/scene.ply"))
        told = json.loads(semfield("mesh", run, "--out", folder + "/sent/room.html", "--json"))
        sent = json.loads(part(pathlib.Path(folder, "sent/room.html").read_text(encoding="utf-8"), "facts"))
        assert pathlib.Path(folder, "sent/room.html").stat().st_size <= 25e6 and len(sent["objects"]) > 0, told
        assert "Semfield" in "".join(sent["about"]) and "Apache License 2.0" in "".join(sent["about"]), sent["about"]
        semfield("report", run, "--no-3d", "--out", folder + "/flat.html")
        report, flat = (pathlib.Path(folder, name).read_text(encoding="utf-8") for name in ("run/report.html", "flat.html"))
        assert "scene" in json.loads(part(report, "data")) and "scene" not in json.loads(part(flat, "data"))
        semfield("report", run, "--out", folder + "/again.html")
        assert len(pathlib.Path(folder, "again.html").read_bytes()) > len(report.encode()), "it has the objects too"
        if browser.programs() is None:
            print("skipped in part: no chromium with chromedriver")
            sys.exit(77)
        with browser.Driver() as driver:
            look(driver, pathlib.Path(folder, "scene.html"), page)
            look_at_report(driver, pathlib.Path(folder, "again.html"))
            live_view.look(driver, PROGRAM, run)


main()
