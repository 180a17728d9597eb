"""The film of clicks that become a labelled room, and the labelling page that it asks."""
import contextlib
import json
import pathlib
import re
import struct
import subprocess
import time
import urllib.request

from . import common

CAPTURED = ("--set", "scene.width_px=320", "--set", "scene.height_px=240")


class Page:
    """A labelling page of `semfield serve`, asked by the same requests as a browser's."""

    def __init__(self, program, *words):
        words = [program, "serve", *words, "--json", "--quiet"]
        self.server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self.url = json.loads(self.server.stdout.readline())["url"]

    def close(self):
        self.server.kill()  # nobody resumes this run
        self.server.communicate()

    def ask(self, path, body=None):
        request = urllib.request.Request(f"{self.url.rstrip('/')}/{path}", body and json.dumps(body).encode())
        with urllib.request.urlopen(request, timeout=300) as answer:
            return answer.read()

    def state(self, wanted, seconds=600):
        """The state, once it is as wanted."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            state = json.loads(self.ask("state?after=0"))
            if state["failure"]:
                raise common.Failed(f"training failed: {state['failure']}")
            if wanted(state):
                return state
            time.sleep(0.2)
        raise common.Failed(f"the page did not get there in {seconds} s; give it an idle machine")

    def labels(self, view):
        """A view's labels as PNG; empty where there are none yet."""
        body, parts = self.ask("picture", {"client": "film", "view": view, "full": True}), []
        while body:
            size, = struct.unpack_from("<I", body)
            parts.append(body[4:4 + size])
            body = body[4 + size:]
        return parts[2]


def number_of(view):
    """Of a view's frame, as its file of truth has it."""
    return int(re.search("[0-9]+", view["frame"])[0])


def click_through(page, options, folder):
    """Clicks, and pictures after each. How many pictures have no labels yet, and which classes were clicked."""
    table = re.findall(r'id: (\d+), name: "([^"]*)"', (folder / "truth" / "classes.yaml").read_text(encoding="utf-8"))
    names = {int(number): name for number, name in table}
    state = page.state(lambda now: now["run"]["geometry_ready"] and now["run"]["train_s"] >= options.learn)
    numbers = [number_of(view) for view in state["views"]]
    shown = [numbers.index(int(number)) for number in options.frames.split(",")]
    for i, view in enumerate(shown):
        (folder / f"color_{i}.jpg").write_bytes(page.ask(f"photo?view={view}"))
    classes, empty = set(), 0
    for clicks in range(options.clicks + 1):
        pictures = [page.labels(view) for view in shown]
        empty += not all(pictures)
        for i, picture in enumerate(pictures if all(pictures) else []):
            (folder / f"label_{i}_{clicks - empty:03d}.png").write_bytes(picture)
        if clicks == options.clicks:
            return empty, classes
        state = page.state(lambda now: now["proposal"] is not None)
        place = state["proposal"]
        view = state["views"][place["view"]]
        width, height = view["width"], view["height"]
        truth = folder / "truth" / "semantic_class" / f"semantic_class_{number_of(view)}.png"
        x, y = min(int(place["at"][0]), width - 1), min(int(place["at"][1]), height - 1)
        name = names[common.read_pictures(truth, "gray")[y * width + x]]
        page.ask("event", {"id": f"film-{clicks}", "type": "click", "frame": view["frame"], "size": [width, height],
                           "points": [place["at"]], "radius": 1, "class": name})
        classes.add(name)
        page.state(lambda now: now["overlay"]["events"] > clicks and (now["proposal"] or {}).get("id") != place["id"])


def join_film(folder, views, empty, out):
    """Labels over colours, side by side, a moment per click and longer at the end."""
    inputs, chains = [], ""
    for i in range(views):
        inputs += ["-loop", "1", "-framerate", "4", "-i", folder / f"color_{i}.jpg",
                   "-framerate", "4", "-i", folder / f"label_{i}_%03d.png"]
        chains += (f"[{2 * i}]eq=saturation=0.7[gray{i}];"
                   f"[{2 * i + 1}]format=rgba,colorchannelmixer=aa=0.65,tpad=start={empty}:color=black@0[over{i}];"
                   f"[gray{i}][over{i}]overlay=shortest=1[view{i}];")
    chains += "".join(f"[view{i}]" for i in range(views))
    chains += (f"hstack=inputs={views},tpad=stop_mode=clone:stop_duration=3,"
               "split[a][b];[a]palettegen=max_colors=128:stats_mode=full[palette];"
               "[b][palette]paletteuse=dither=none:diff_mode=rectangle")
    common.run("ffmpeg", "-v", "error", "-y", *inputs, "-filter_complex", chains, "-loop", "0", out)


def labelling_film(words):
    """A film of clicks that become a labelled room. `semfield serve` trains the shipped room without labels. A
simulated person answers the page's questions, one click each, with the true class of the pixel, over the same requests
as the page. After each click the labels of the views are fetched; ffmpeg lays them over the photos and makes a film.

The last line is `film: clicks=... classes=... frames=... bytes=...`."""
    parser = common.parser_of(labelling_film)
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.gif")
    parser.add_argument("--clicks", type=int, default=30, help="how many (default: %(default)s)")
    parser.add_argument("--learn", type=float, default=45, help="seconds before the first click (default: %(default)s)")
    parser.add_argument("--frames", default="132,22", help="numbers of those shown (default: %(default)s)")
    common.add_build(parser)
    options = parser.parse_args(words)
    program = options.build / "bin" / "semfield"
    with common.work_folder() as folder:
        common.run(program, "capture", common.QUICKSTART, *CAPTURED, "--set", "scene.labels.frames=all", "--quiet",
                   "--out", folder / "truth")
        with contextlib.closing(Page(program, common.QUICKSTART, *CAPTURED, "--set", "scene.labels.frames=none",
                                     "--out", folder / "run")) as page:
            empty, classes = click_through(page, options, folder)
        join_film(folder, len(options.frames.split(",")), empty, options.out)
    print(f"film: clicks={options.clicks} classes={len(classes)} frames={options.clicks + 1} "
          f"bytes={options.out.stat().st_size}")
    return 0
