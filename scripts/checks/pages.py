"""The pages of a run on a phone and on paper."""
import shutil

from . import common
from .hand_over import browser, served

PHONE, PAPER_PX = (390, 844), round((210 - 2 * 12) / 25.4 * 96)  # A4 less the margins of report.css
NAMES = "(all) => all.map((e) => `${e.tagName.toLowerCase()}#${e.id} .${e.className.baseVal ?? e.className}`)"
# What sticks out of the screen, but for what a person scrolls sideways there, and long names, which end in dots.
WIDE = f"""
    const holds = (e) => e.matches("#strip, .scroll, pre") || getComputedStyle(e).overflowX === "hidden";
    const isHeld = (e) => (e = e.parentElement) !== document.body && e !== null && (holds(e) || isHeld(e));
    const out = [...document.body.querySelectorAll("*")].filter((e) => e.getClientRects().length &&
      e.getBoundingClientRect().right > innerWidth + 1 && !isHeld(e));
    if (document.documentElement.scrollWidth > innerWidth + 1) out.push(document.documentElement);
    return ({NAMES})(out);"""
# On paper nothing scrolls: what would is cut, and so is what is wider than the paper.
CUT = f"""
    for (const one of document.querySelectorAll("details")) one.open = true;
    return ({NAMES})([...document.querySelectorAll("table, pre, .scroll, .panel, img, svg")].filter((e) => e.getClientRects().length &&
      (e.getBoundingClientRect().right > innerWidth + 1 || e.scrollWidth > e.clientWidth + 1 && e.matches(".scroll, pre, .panel"))));"""


def pages(run, *, build=common.BUILD):
    """Opens the labelling page, the viewer, the report and its scene in 3D on a phone of 390 x 844 pixels, and counts what
is wider than the screen; prints the report to A4, unfolded, and counts what is cut. It labels in a copy of the run."""
    if not browser.programs():
        raise common.Failed("no chromium and chromium-driver here: apt-get install chromium chromium-driver")
    program, wide = build / "bin" / "semfield", []
    with browser.Driver() as driver, common.work_folder() as folder:
        page, report = driver.browser(), folder / "report.html"

        def look(what, script=WIDE):
            found = page.run(script)
            common.check(not found, f"{what}: {', '.join(found[:8])}")
            return found

        page.size(*PHONE, is_phone=True)
        words = [run / "run.yaml", "--out", folder / "run"]
        if (run / "clicks.jsonl").exists():  # it goes on with clicks that are its own
            words = [shutil.copytree(run, folder / "run")]
        with served(program, "serve", *words) as url:
            page.open(url)
            page.wait("document.querySelector('#strip img[src]')", "no views", 60)
            wide += look("the labelling page on a phone")
            page.keys("n", *"a class with a long name", "enter")
            page.click("#canvas")
            page.wait("document.querySelector('#classes .clicks:not(:empty)')", "no click")
            wide += look("the labelling page with a click on a phone")
            page.click("#help")
            wide += look("its help on a phone")
        with served(program, "view", run) as url:
            page.open(url)
            page.wait("document.body.dataset.state === 'ready'", "no picture", 60)
            wide += look("the viewer on a phone")
        common.run(program, "report", run, "--out", report, "-q")
        page.open(report.as_uri())
        wide += look("the report on a phone")
        scene = page.run("return JSON.parse(document.getElementById('data').textContent).scene ?? ''")
        page.paper(PAPER_PX)
        cut = look("the report on A4", CUT)
        page.size(*PHONE, is_phone=True)
        report.write_text(scene, encoding="utf-8")
        page.open(report.as_uri())
        if scene:
            page.wait("document.body.dataset.state === 'ready'", "no scene", 60)
        wide += look("the scene in 3D on a phone")
    return {"phone_overflow": len(wide), "print_cut": len(cut)}
