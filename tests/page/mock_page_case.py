"""What tests of the page against the mock server have in common: the server, and what the page shows at pixels of a view."""

import mock_server
import page_case

SIZE = (120, 90)
RED, BLUE = [230, 75, 70], [70, 150, 240]  # the first colours that the page offers


class MockPageCase(page_case.PageCase):
    SIZE = SIZE

    def serve(self, **options):
        self.room = mock_server.Room(views=options.pop("views", 6), size=SIZE, **options)
        self.server = mock_server.Server(self.room)
        self.url = self.server.start()
        self.addCleanup(lambda: self.server.http.ended or self.server.stop())

    def clicks(self):
        return sum(e["type"] == "click" for e in self.room.events)

    def wait_pixel(self, page, x, y, want, why, tolerance=14):
        """Until the page shows about this colour at a pixel of the view."""
        seen = None
        for _ in range(60):
            seen = page.pixels([self.page_of(page, x, y)])[0]
            if max(abs(a - b) for a, b in zip(seen, want)) <= tolerance:
                return
        self.fail(f"{why}: {seen} at {x}, {y}, not {want}")

    def mixed(self, view, x, y, color):
        """The photograph with the overlay at its first opacity."""
        photo = self.room.view(view)[0][int(y)][3 * int(x):3 * int(x) + 3]
        return [0.45 * a + 0.55 * b for a, b in zip(photo, color)]

    def pixel_of(self, view, which):
        """A pixel well inside an object of the room."""
        objects = self.room.view(view)[1]
        inside = [(i + 0.5, j + 0.5) for j in range(8, SIZE[1] - 8) for i in range(8, SIZE[0] - 8)
                  if all(objects[j + dj][i + di] == which for dj in (-5, 0, 5) for di in (-5, 0, 5))]
        return inside[len(inside) // 2]
