"""What a run hands over to other programs, and its pages in browsers."""
import math
import shutil
import sys
import time

from . import common

sys.path[1:1] = [str(common.ROOT / "tests" / name) for name in ("handover", "page")]
import browser  # noqa: E402
import firefox  # noqa: E402
import other_programs  # noqa: E402

NPM_PACKAGES = ("gltf-validator@2.0.0-dev.3.10", "copc@0.0.8")
EDGE, TOP = 1.24, (3.72, 2.5, 0.745)  # metres; a place on the table's top, off the lamp above the middle
COLORS = """
    const canvas = document.getElementById("canvas"), small = document.createElement("canvas").getContext("2d");
    small.drawImage(canvas, 0, 0, 64, 48);
    return new Set(new Uint32Array(small.getImageData(0, 0, 64, 48).data.buffer)).size;"""
MEASURE = """
    const [top, edge, side] = arguments, page = semfield;
    Object.assign(page.camera, {yaw: 0, pitch: 1.45});
    page.camera.lookAt(top, 0.6 * edge);
    page.camera.reach = 2.2;
    const at = (x) => {
      const found = page.read(...page.camera.toScreen([x, top[1], top[2]]));
      if (found === null || page.facts.classes[found.label]?.name !== "table") return null;
      return Math.abs(found.place[2] - top[2]) < 0.04 ? found.place : null;
    };
    let inside = 0, outside = 0.75 * edge, last = at(top[0]);
    while (last !== null && outside - inside > 0.004) {  // where the table ends
      const middle = (inside + outside) / 2, place = at(top[0] + side * middle);
      if (place === null) outside = middle; else [inside, last] = [middle, place];
    }
    return last;"""


def view(run, *, build=common.BUILD):
    """Measures how soon `semfield view` shows a run of the shipped room, and the long edge of the dining table as a
person does, by points read in headless Chromium: the last ones of the table's top on the line from end to end.

view_ready_s is from start to the first picture, measured_error a share of the edge."""
    if not browser.programs():
        raise common.Failed("no chromium and chromium-driver here: apt-get install chromium chromium-driver")
    with browser.Driver() as driver:
        page, begin = driver.browser(), time.monotonic()
        with common.served(build / "bin" / "semfield", "view", run) as url:
            page.open(url)
            page.wait("document.body.dataset.state === 'ready'", "no picture", 60)
            ready = time.monotonic() - begin
            page.wait("document.body.dataset.mesh === 'fine'", "no fine mesh", 300)
            page.call("POST", "/timeouts", {"script": 300_000})  # a CPU draws the whole mesh for every point
            ends = [page.run(MEASURE, TOP, EDGE, side) for side in (-1, 1)]
    if not all(ends):
        raise common.Failed("the table is not seen: the run is none of the shipped room, or was trained too briefly")
    length = math.dist(*ends)
    common.say(f"table: {length:.3f} m, true {EDGE} m")
    return {"view_ready_s": ready, "measured_error": abs(length - EDGE) / EDGE}


def opened(run):
    """Whether the page drew something: its picture has many colours."""
    for _ in range(300):
        if run("return document.body.dataset.state") != "loading" and run(COLORS) > 100:
            return True
        time.sleep(0.2)
    return False


PHONE, PAPER_PX = (390, 844), round((210 - 2 * 12) / 25.4 * 96)  # A4 less the margins of report.css
NAMES = ".map((e) => `${e.tagName}#${e.id}.${e.className}`)"
# What sticks out of the screen, but for what a person scrolls sideways there, and what ends in dots.
WIDE = """const holds = (e) => e.matches("#strip, .scroll, pre") || getComputedStyle(e).overflowX === "hidden";
    const isHeld = (e) => (e = e.parentElement) !== document.body && e !== null && (holds(e) || isHeld(e));
    const out = [...document.body.querySelectorAll("*")].filter((e) => e.getBoundingClientRect().right > innerWidth + 1 && !isHeld(e));
    if (document.documentElement.scrollWidth > innerWidth + 1) out.push(document.documentElement);
    return out""" + NAMES
# A view that is open to labels and its first class, or true: the dialog of a new one is open.
CHOOSE = """document.querySelector("#strip button:not(:has(.badge))").click();
    const [one] = document.querySelectorAll("#classes button[aria-checked=false]");
    (one ?? document.getElementById("new-class")).click();
    return document.getElementById("class-dialog").open"""
# On paper nothing scrolls: what would is cut, and so is what is wider than the paper.
CUT = """for (const one of document.querySelectorAll("details")) one.open = true;
    return [...document.querySelectorAll("table, pre, .scroll, .panel, img, svg")].filter((e) =>
      e.getBoundingClientRect().right > innerWidth + 1 || e.clientWidth && e.scrollWidth > e.clientWidth + 1)""" + NAMES


def pages(run, *, build=common.BUILD):
    """Opens the labelling page, the viewer, the report and its scene in 3D on a phone of 390 x 844 pixels, and counts what
is wider than the screen; prints the report to A4, unfolded, and counts what is cut. It labels in a run of its own."""
    program, ready = build / "bin" / "semfield", "document.body.dataset.state === 'ready'"
    with browser.Driver() as driver, common.work_folder() as folder:
        page, report, wide = driver.browser(), folder / "report.html", []

        def look(what, script=WIDE):
            found = page.run(script)
            common.check(not found, f"{what}: {', '.join(found[:8])}")
            return found

        page.size(*PHONE, is_phone=True)
        own = [run / "run.yaml", "--out", folder / "run"]
        if (run / "clicks.jsonl").exists():  # with which a copy of their run goes on
            own = [shutil.copytree(run, folder / "run")]
        for words, shown in (["serve", *own], "document.querySelector('#strip img[src]')"), (["view", run], ready):
            with common.served(program, *words) as url:
                page.open(url)
                page.wait(shown, "nothing is shown", 60)
                wide += look(f"{words[0]} on a phone")
                if words[0] == "serve":
                    if page.run(CHOOSE):
                        page.keys(*"a class with a long name", "enter")
                    page.click("#canvas")
                    page.wait("document.querySelector('#classes .clicks:not(:empty)')", "no click")
                    wide += look("a click on a phone")
        common.run(program, "report", run, "--out", report, "-q")
        page.open(report.as_uri())
        wide += look("the report on a phone")
        scene = page.run("return data.scene ?? ''")
        page.size(PAPER_PX, 1000, media="print")
        cut = look("the report on A4", CUT)
        page.size(*PHONE, is_phone=True)
        report.write_text(scene or "<body data-state=ready>", encoding="utf-8")
        page.open(report.as_uri())
        page.wait(ready, "no scene", 60)
        wide += look("the scene in 3D on a phone")
    return {"phone_overflow": len(wide), "print_cut": len(cut)}


def hand_over(run, *, build=common.BUILD):
    """Checks what the suite cannot of what a run hands over: its page in headless Chromium and in Firefox. It installs
the packages of npm too, with which the suite reads glTF and LAS; without them, and without CloudCompare, MeshLab,
Open3D, PCL and OctoMap, handover_test leaves those out."""
    npm = other_programs.NODE_MODULES.parent  # in the build tree, where tests find them too
    if not (npm / "node_modules").is_dir():
        npm.mkdir(parents=True, exist_ok=True)
        options = ("--no-audit", "--no-fund", "--ignore-scripts", "--prefix", npm)
        try:
            common.run("npm", "install", *options, *NPM_PACKAGES)
        except (OSError, common.Failed) as failed:
            common.say(f"the packages of npm cannot be had: {failed}")
    figures = {}
    with common.work_folder() as folder:
        page = folder / "room.html"
        common.run(build / "bin" / "semfield", "mesh", run, "--faces", "2000000", "--out", page, "-q")
        figures["html_mb"] = page.stat().st_size * 1e-6
        missing = {"html_opens": [] if browser.programs() else ["chromium", "chromium-driver"],
                   "firefox_opens": firefox.missing()}
        for key, packages in missing.items():
            if packages:
                common.say(f"{key}: apt-get install {' '.join(packages)}")
                continue
            with browser.Driver() if key == "html_opens" else firefox.Firefox() as driver:
                window = driver.browser() if key == "html_opens" else driver
                window.open(page.as_uri())
                good = opened(window.run) and (key == "firefox_opens" or not window.complaints())
                figures[key] = "yes" if common.check(good, f"{key}: the page does not open") else "no"
    return figures
