#!/usr/bin/env python3
"""`semfield bench step` on narrow networks: its words and its table."""

from program import *

TINY = "-q bench step --size tiny --repeats 1"


class Bench(ProgramCase):
    def test_every_measurement_has_a_row(self):
        out = json.loads(self.ok(f"--json {TINY}").out)
        for row in out["rows"]:
            self.assertTrue(0 < row["seconds"]["median"], row)
        self.assertGreaterEqual(len(out["rows"]), 14)  # three networks, four more numbers of classes for two of them
        self.assertEqual(len({row["name"] for row in out["rows"]}), len(out["rows"]))

    def test_measurements_are_chosen_by_their_names(self):
        lines = self.ok(f"{TINY} --only 'hash 15 bf16'").out.splitlines()
        self.assertRegex(lines[-1], r"\Ahash 15 bf16 C=29 +[0-9.]+  \([0-9.]+ [.]{2} [0-9.]+\) ")

    def test_wrong_words_are_refused(self):
        for words, code in (("bench step --size huge", 2), ("bench step --repeats 0", 2),
                            (f"{TINY} --only xyzzy", 2), (f"{TINY} --set runtime.thread=1", 78), ("bench", 2)):
            self.ended(words, code)
        r = self.semfield("bench pairs")
        self.has(r.err + r.out, "studies/leave_out.py")


if __name__ == "__main__":
    main()
