"""A browser driven through chromedriver's own protocol (W3C WebDriver): tabs, keys, mouse, fingers, pixels of screenshots."""

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request

KEYS = {"space": " ", "enter": "\ue007", "escape": "\ue00c", "left": "\ue012", "up": "\ue013", "right": "\ue014", "down": "\ue015", "tab": "\ue004",
        "shift": "\ue008", "ctrl": "\ue009", "backspace": "\ue003", "f2": "\ue032", "delete": "\ue017", "home": "\ue011", "end": "\ue010"}


def programs():
    """(chromium, chromedriver), or None where one is missing."""
    found = [shutil.which(name) for name in ("chromium", "chromedriver")]
    return found if all(found) else None


class Driver:
    """chromedriver; ends with its browsers."""

    def __init__(self):
        self.chromium, driver = programs()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.folder = tempfile.mkdtemp(prefix="semfield_page_")
        environment = {**os.environ, "TMPDIR": self.folder, "HOME": self.folder}
        self.process = subprocess.Popen([driver, f"--port={self.port}", "--silent"], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.browsers, self.idle = [], []
        for _ in range(200):
            try:
                if self.call("GET", "/status")["ready"]:
                    return
            except OSError:
                time.sleep(0.05)
        raise RuntimeError("chromedriver does not answer")

    def call(self, method, path, value=None):
        data = None if value is None else json.dumps(value).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            told = json.load(error)["value"]
            raise AssertionError(f"{path}: {told['error']}: {told['message'].splitlines()[0]}") from None

    def browser(self, width=1280, height=720):
        """One that nobody uses, or a new one. A page of another port finds its storage empty."""
        browser = self.idle.pop() if self.idle else Browser(self)
        if browser not in self.browsers:
            self.browsers.append(browser)
        browser.size(width, height)
        return browser

    def give_back(self, browser):
        browser.open("about:blank")
        browser.complaints()
        self.idle.append(browser)

    def close(self):
        for browser in self.browsers:
            try:
                browser.close()
            except (OSError, AssertionError):
                pass
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


class Browser:
    """One browser with storage of its own."""

    def __init__(self, driver):
        self.driver = driver
        arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars=false", "--force-color-profile=srgb",
                     "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
        options = {"binary": driver.chromium, "args": arguments}
        wish = {"browserName": "chrome", "goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        self.path = "/session/" + driver.call("POST", "/session", {"capabilities": {"alwaysMatch": wish}})["sessionId"]

    def call(self, method, path, value=None):
        return self.driver.call(method, self.path + path, value)

    def emulate(self, what, **values):
        self.call("POST", "/goog/cdp/execute", {"cmd": f"Emulation.set{what}", "params": values})

    def size(self, width, height, is_phone=False, media=""):
        """Of the page, without the window's frame; is_phone: fingers point; media: "print" is on paper of this size within its margins."""
        self.emulate("DeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=is_phone)
        self.emulate("EmulatedMedia", media=media)
        self.emulate("TouchEmulationEnabled", enabled=is_phone)

    def open(self, address):
        self.call("POST", "/url", {"url": address})

    def reload(self):
        self.call("POST", "/refresh", {})

    def close(self):
        self.call("DELETE", "")

    def run(self, script, *arguments):
        """`script` is the body of a function; its promise is waited for."""
        return self.call("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def wait(self, expression, why="", seconds=20):
        """Until a JavaScript expression is true; its value."""
        end = time.monotonic() + seconds
        while True:
            value = self.run(f"return ({expression})")
            if value:
                return value
            if time.monotonic() > end:
                raise AssertionError(f"{why or expression}: not within {seconds} s")
            time.sleep(0.05)

    @staticmethod
    def wait_for(value, want, why, seconds=20):
        """Until value() is what is wanted."""
        end = time.monotonic() + seconds
        while (seen := value()) != want:
            if time.monotonic() > end:
                raise AssertionError(f"{why}: {seen} is not {want} within {seconds} s")
            time.sleep(0.05)

    def text(self, selector):
        return self.run("return document.querySelector(arguments[0]).textContent", selector)

    def actions(self, *sources):
        self.call("POST", "/actions", {"actions": list(sources)})
        self.call("DELETE", "/actions")

    def keys(self, *names):
        """Each name is a key, or keys held together: "n", "space", "shift+z"."""
        steps = []
        for name in names:
            held = name.split("+") if len(name) > 1 else [name]
            values = [KEYS.get(key, key) for key in held]
            steps += [{"type": "keyDown", "value": v} for v in values] + [{"type": "keyUp", "value": v} for v in reversed(values)]
        self.actions({"type": "key", "id": "keys", "actions": steps})

    def type(self, text):
        self.keys(*text)

    def mouse(self, *steps, button=0):
        """steps: points (x, y) of the page; pressed at the first, released at the last."""
        moves = [{"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)} for x, y in steps]
        actions = [moves[0], {"type": "pointerDown", "button": button}, *moves[1:], {"type": "pointerUp", "button": button}]
        self.actions({"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions})

    def hover(self, x, y):
        self.actions({"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"},
                      "actions": [{"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)}]})

    def wheel(self, x, y, delta):
        self.actions({"type": "wheel", "id": "wheel", "actions": [{"type": "scroll", "x": round(x), "y": round(y), "deltaX": 0, "deltaY": delta, "duration": 0}]})

    def fingers(self, *ways):
        """Each way is the points of one finger; all go down, move and leave together."""
        self.actions(*({"type": "pointer", "id": f"finger{k}", "parameters": {"pointerType": "touch"}, "actions": [
            {"type": "pointerMove", "duration": 0, "x": round(way[0][0]), "y": round(way[0][1])}, {"type": "pointerDown", "button": 0},
            *({"type": "pointerMove", "duration": 20, "x": round(x), "y": round(y)} for x, y in way[1:]), {"type": "pointerUp", "button": 0}]}
            for k, way in enumerate(ways)))

    def click(self, selector):
        box = self.box(selector)
        self.mouse((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2))

    def box(self, selector):
        return self.run("return document.querySelector(arguments[0]).getBoundingClientRect().toJSON()", selector)

    def pixels(self, points):
        """[r, g, b] of points of the page, as the person sees them."""
        return self.run("""
            const bytes = Uint8Array.from(atob(arguments[0]), (c) => c.charCodeAt(0));
            return createImageBitmap(new Blob([bytes], {type: 'image/png'})).then((bitmap) => {
              const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
              const context = canvas.getContext('2d');
              context.drawImage(bitmap, 0, 0);
              return arguments[1].map(([x, y]) => [...context.getImageData(Math.round(x), Math.round(y), 1, 1).data].slice(0, 3));
            });""".replace("arguments[1]", "points").replace("const bytes", "const points = arguments[1]; const bytes"), self.call("GET", "/screenshot"), points)

    def complaints(self):
        """What the page said to the console as errors, failed connections aside."""
        rows = self.call("POST", "/se/log", {"type": "browser"})
        return [row["message"] for row in rows if row["level"] == "SEVERE" and "Failed to load resource" not in row["message"]]
