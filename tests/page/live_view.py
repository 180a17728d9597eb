"""`semfield view` of a run with objects, as a person uses it in headless Chromium."""

import json
import pathlib
import signal
import subprocess


def choose_an_object(page):
    """Chooses one by a click into the picture; its row."""
    page.run("document.getElementById('outside').click()")
    place = page.run("""
        const {canvas, camera} = semfield;
        for (const row of semfield.objects.rows) for (const aside of [0, 12, -12, 24, -24, 36]) {  // the panel may lie over its middle
          const [px, py] = camera.toScreen(row.box.center), x = Math.round(px) + aside, y = Math.round(py);
          if (document.elementFromPoint(x, y) !== canvas) continue;
          const found = semfield.read(x, y);
          if (found !== null && found.object > 0) return [x, y, found.object];
        }
        return null;""")
    assert place is not None, "no object is seen"
    page.mouse(place[:2])
    page.wait(f"semfield.objects.chosen.has({place[2]})", "a click does not choose the object under it")
    row = page.run("return semfield.objects.row(arguments[0])", place[2])
    page.wait(f"document.getElementById('chosen').textContent.startsWith({json.dumps(row['name'])})")
    assert page.run("return document.querySelectorAll('#marks line.box').length") > 0, "no box is drawn"
    return row


class View:
    """The program at work."""

    def __init__(self, program, *words):
        self.process = subprocess.Popen([program, "view", *words, "--json", "-q"], stdout=subprocess.PIPE, text=True)
        self.told = json.loads(self.process.stdout.readline())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait() == 130, "Ctrl-C ends it"
        self.process.stdout.close()


def edits_of(run):
    return json.loads(pathlib.Path(run, "objects/edits.json").read_text())["edits"]


def table_of(run):
    return {row["id"]: row for row in json.loads(pathlib.Path(run, "objects/objects.json").read_text())["objects"]}


def edit_objects(page, run):
    count = page.run("return semfield.objects.rows.length")
    row = choose_an_object(page)
    page.run("document.getElementById('name').value = 'my \"thing\"'; document.getElementById('rename').click()")
    page.wait("document.getElementById('edit-hint').textContent === 'Saved.'", "no answer to an edit")
    assert edits_of(run) == [{"do": "rename", "object": row["id"], "name": 'my "thing"'}], edits_of(run)
    assert table_of(run)[row["id"]]["name"] == 'my "thing"'
    other = page.run("return semfield.objects.rows.find((one) => one.id !== arguments[0]).id", row["id"])
    page.run("semfield.objects.choose(arguments[0]); semfield.objects.choose(arguments[1], true); document.getElementById('merge').disabled = false; "
             "document.getElementById('merge').click()", row["id"], other)
    page.wait(f"semfield.objects.rows.length === {count - 1}", "a merge leaves one less")
    assert other not in table_of(run)
    page.run("document.getElementById('undo').disabled = false; document.getElementById('undo').click()")
    page.wait(f"semfield.objects.rows.length === {count}", "undo brings it back")
    assert len(edits_of(run)) == 1 and other in table_of(run)
    # An answer that takes its time leaves alone what a person does meanwhile; an edit meanwhile says that it is not saved.
    page.run("""
        const ask = fetch;
        window.fetch = (what, how) => {
          if (what !== "./edit") return ask(what, how);
          window.fetch = ask;
          return new Promise((later) => { window.answer = later; }).then(() => ask(what, how));
        };
        const {objects} = semfield, button = document.getElementById('rename'), rename = (name) => {
          document.getElementById('name').value = name;
          button.disabled = false;
          button.click();
        };
        objects.choose(arguments[0]);
        semfield.points = [];
        rename('slow');
        objects.choose(arguments[1]);
        semfield.points.push({place: objects.row(arguments[1]).box.center, object: arguments[1]});
        rename('lost');""", row["id"], other)
    page.wait("document.getElementById('edit-hint').textContent.startsWith('Not saved')", "an edit that is not saved does not say so")
    page.run("window.answer()")
    page.wait("document.getElementById('edit-hint').textContent === 'Saved.'", "no answer to an edit")
    assert page.run("return [[...semfield.objects.chosen], semfield.points.length]") == [[other], 1], "an answer changes what was chosen since"
    page.run("semfield.points = []; document.getElementById('undo').disabled = false; document.getElementById('undo').click()")
    page.wait("!semfield.objects.saving")
    page.run("semfield.objects.choose(0)")
    assert len(edits_of(run)) == 1, edits_of(run)
    # A cut goes through the two points, straight away from the eye.
    page.run("""
        const row = semfield.objects.row(arguments[0]), {center, axes, size} = row.box;
        semfield.objects.choose(row.id);
        semfield.points = [-1, 1].map((side) => ({place: center.map((v, i) => v + side * size[1] * axes[1][i]), object: row.id}));
        document.getElementById('plane').disabled = false;
        document.getElementById('plane').click();""", row["id"])
    page.wait(f"semfield.objects.rows.length === {count + 1}", "a cut leaves one more")
    plane, eye = edits_of(run)[1]["plane"], page.run("return semfield.camera.place")
    assert len(plane) == 3 and max(abs(a - b) for a, b in zip(plane[2], eye)) < 1e-9, (plane, eye)
    page.run("document.getElementById('undo').disabled = false; document.getElementById('undo').click()")
    page.wait(f"semfield.objects.rows.length === {count}", "undo joins the parts")
    # What was made on other objects, or cannot be, is refused and not saved.
    kept, shown = edits_of(run), table_of(run)
    for wrong in ({"do": "undo", "made_on": "0123456789abcdef"}, {"do": "undo"}, {"do": "rename", "object": row["id"], "name": "a\tb", "made_on": "here"}):
        status = page.run("""const body = {...arguments[0]}; if (body.made_on === "here") body.made_on = semfield.facts.state;
                             return fetch("edit", {method: "POST", body: JSON.stringify(body)}).then((answer) => answer.status);""", wrong)
        assert status == 400, (wrong, status)
        assert edits_of(run) == kept and table_of(run) == shown, wrong
    page.run("semfield.facts.state = '0'; document.getElementById('undo').disabled = false; document.getElementById('undo').click()")
    page.wait("document.getElementById('edit-hint').textContent.includes('Load the page again')", "a stale edit is not told")
    assert edits_of(run) == kept
    # A class that is hidden is neither drawn nor read.
    page.run("document.querySelector('#things details input[type=checkbox]').click()")
    assert page.run("return semfield.objects.hidden.size") > 0
    page.run("document.querySelector('#things details input[type=checkbox]').click()")


def look(driver, program, run):
    before = {file: file.stat().st_mtime_ns for file in pathlib.Path(run).rglob("*") if file.is_file() and "objects" not in file.parts}
    with View(program, run) as view:
        page = driver.browser(640, 360)
        page.open(view.told["url"])
        page.wait("document.body.dataset.state === 'ready'", "the page does not start", 60)
        hidden = page.run("return [...document.querySelectorAll('#colors [hidden], #class-list[hidden]')].map(({id}) => id)")
        assert hidden == [], f"there before the mesh is made: {hidden}"
        page.wait("document.body.dataset.mesh === 'fine'", "no fine mesh", 240)
        page.run("document.getElementById('inside').click()")
        page.wait("document.body.dataset.still === String(semfield.canvas.width)", "the field is not rendered", 240)
        told = page.run("return semfield.picture().then((blob) => createImageBitmap(blob)).then((image) => [image.width, image.height])")
        assert told == [640, 360], told
        # The mesh and the picture of the field show the same: both axes of the camera agree.
        differs = page.run("""
            const still = document.getElementById('still'), flat = (source, flip) => {
              const small = new OffscreenCanvas(32, 18), context = small.getContext('2d');
              if (flip) context.setTransform(-1, 0, 0, 1, 32, 0);
              context.drawImage(source, 0, 0, 32, 18);
              return [...context.getImageData(0, 0, 32, 18).data];
            };
            const field = flat(still), way = (other) => other.reduce((sum, v, i) => sum + Math.abs(v - field[i]), 0) / other.length;
            return [way(flat(semfield.canvas)), way(flat(semfield.canvas, true))];""")
        assert differs[0] < 0.8 * differs[1], f"the mesh is not where the field is: {differs}"
        for mode in ("class", "object", "entropy", "depth"):
            page.run("document.getElementById(arguments[0]).click()", mode)
            page.wait("Number(document.body.dataset.still) >= 240", f"no picture of {mode}", 60)
            assert page.run("return document.documentElement.scrollWidth") <= 640
        page.run("document.getElementById('photo').click()")
        seen = page.run("""
            for (let y = 60; y < 300; y += 30) for (let x = 310; x < 630; x += 40) if (semfield.read(x, y) !== null) return [x, y];
            return null;""")
        assert seen is not None, "the mesh is seen nowhere"
        page.mouse(seen)
        page.wait("semfield.points.length === 1 && semfield.points[0].told !== undefined", "a point does not say what it is")
        page.wait("/ [01][.][0-9]{2}.* at -?[0-9.]+, /.test(document.getElementById('readout').textContent)", "no reading of it")
        edit_objects(page, run)
        page.run("semfield.views = [semfield.camera.state()]; semfield.camera.turn(40, 0); semfield.views.push(semfield.camera.state())")
        lines = page.run("return semfield.pathText()").split("\n")[:-1]
        assert len(lines) == 49 and all(len(line.split()) == 12 for line in lines), len(lines)
        pathlib.Path(run).parent.joinpath("path.txt").write_text("\n".join(lines[:2]) + "\n")
        page.size(390, 844, is_phone=True)
        page.reload()
        page.wait("document.body.dataset.state === 'ready' && semfield.canvas.clientWidth === 390", seconds=60)
        assert "pinch" in page.text("dialog"), "its help knows fingers"
        assert page.run("return document.documentElement.scrollWidth") <= 390
        assert page.complaints() == [], page.complaints()
    after = {file: file.stat().st_mtime_ns for file in before if file.exists()}
    assert after == before, "looking changes nothing of the run"
    done = subprocess.run([program, "render", run, "--trajectory", str(pathlib.Path(run).parent / "path.txt"), "--out", str(pathlib.Path(run).parent / "path"), "-q"],
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    driver.give_back(page)
