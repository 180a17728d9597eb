"""Firefox driven through its own protocol, Marionette: a message is its length, a colon, and [kind, number, error or command, value] as JSON."""

import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import tempfile
import time

PROGRAMS = {"firefox-esr": "firefox-esr", "xvfb-run": "xvfb"}  # and their packages; a screen, since Firefox has no WebGL without one


def missing():
    """Packages to install; empty where all is here."""
    return [package for program, package in PROGRAMS.items() if not shutil.which(program)]


class Firefox:
    """One window of 1280 x 800, drawn by the CPU."""

    def __init__(self, seconds=120):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.folder = tempfile.TemporaryDirectory(prefix="semfield_firefox_", ignore_cleanup_errors=True)
        pathlib.Path(self.folder.name, "user.js").write_text(f'user_pref("marionette.port", {port});\nuser_pref("webgl.force-enabled", true);\n')
        words = ["xvfb-run", "-a", "-s", "-screen 0 1280x800x24", "firefox-esr", "--marionette", "--no-remote", "--profile", self.folder.name]
        self.process = subprocess.Popen(words, env={**os.environ, "HOME": self.folder.name}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                                        start_new_session=True)
        self.socket, self.number, end = None, 0, time.monotonic() + seconds
        while self.socket is None:
            try:
                self.socket = socket.create_connection(("127.0.0.1", port), timeout=seconds)
            except OSError:
                if time.monotonic() > end or self.process.poll() is not None:
                    self.close()
                    raise RuntimeError("Firefox does not answer") from None
                time.sleep(0.1)
        self.receive()  # who it is
        self.call("WebDriver:NewSession", {"capabilities": {}})

    def receive(self):
        length = b""
        while not length.endswith(b":"):
            length += self.more(1)
        text = b""
        while len(text) < int(length[:-1]):
            text += self.more(int(length[:-1]) - len(text))
        return json.loads(text)

    def more(self, most):
        got = self.socket.recv(most)
        if not got:
            raise RuntimeError("Firefox has ended")
        return got

    def call(self, command, value):
        self.number += 1
        text = json.dumps([0, self.number, command, value]).encode()
        self.socket.sendall(str(len(text)).encode() + b":" + text)
        _, _, error, answer = self.receive()
        if error:
            raise RuntimeError(f"{command}: {error['error']}: {error['message']}")
        return answer

    def open(self, address):
        self.call("WebDriver:Navigate", {"url": address})

    def run(self, script):
        return self.call("WebDriver:ExecuteScript", {"script": script, "args": []})["value"]

    def close(self):
        if self.socket:
            self.socket.close()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
        self.process.wait()
        self.folder.cleanup()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
