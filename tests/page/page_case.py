"""What tests of the page have in common: a browser, and where things lie on the page."""

import sys
import unittest

import browser


class PageCase(unittest.TestCase):
    """SIZE: of the views. `url` is open()ed; clicks() counts the clicks that the program has."""

    SIZE = (0, 0)

    @classmethod
    def setUpClass(cls):
        cls.driver = browser.Driver()

    @classmethod
    def tearDownClass(cls):
        cls.driver.close()

    def open(self, width=1280, height=720):
        page = self.driver.browser(width, height)
        self.addCleanup(self.driver.give_back, page)
        page.open(self.url)
        self.wait_start(page)
        return page

    def wait_start(self, page):
        page.wait("document.getElementById('connection').textContent == 'connected' && document.querySelector('#strip img[src]')", "the page does not start")

    def scale(self, page):
        """Pixels of the page per pixel of the fitted view."""
        box = page.box("#canvas")
        return min((box["width"] - 16) / self.SIZE[0], (box["height"] - 16) / self.SIZE[1])

    def page_of(self, page, x, y):
        """Where a pixel of the fitted view lies on the page."""
        box, scale = page.box("#canvas"), self.scale(page)
        return (box["x"] + (box["width"] - scale * self.SIZE[0]) / 2 + x * scale, box["y"] + (box["height"] - scale * self.SIZE[1]) / 2 + y * scale)

    def click(self, page, x, y, saved=None):
        """`saved`: waits until the program has so many clicks."""
        page.mouse(self.page_of(page, x, y))
        page.hover(5, 715)
        if saved is not None:
            self.wait_saved(page, saved)

    def opened(self, page, dialog="class-dialog"):
        page.wait(f"document.getElementById('{dialog}').open")

    def dialog(self, page, *keys):
        page.keys(*keys)
        self.opened(page)

    def make_class(self, page, name):
        self.dialog(page, "n")
        page.type(name)
        page.keys("enter")
        page.wait("!document.getElementById('class-dialog').open")

    def wait_saved(self, page, clicks):
        page.wait_for(self.clicks, clicks, "clicks do not arrive")
        page.wait("document.getElementById('saving').textContent == 'every click is saved'", "not saved")


def main():
    if not browser.programs():
        print("skipped: the page was tried in no browser; install Debian's chromium and chromium-driver")
        sys.exit(77)
    unittest.main(verbosity=2)
