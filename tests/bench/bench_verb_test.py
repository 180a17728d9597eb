#!/usr/bin/env python3
"""`semfield bench step` on narrow networks: its words, its last line, and that steps allocate nothing."""

import json
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))
from program import *

TINY = "-q bench step --size tiny --repeats 1"
# An interpreter that responds as the peer's script does, always with the same time.
PEER = """#!/bin/sh
[ "$1" = -c ] && exit 0
echo '{"torch": "0", "threads": 2, "blas": "openblas"}'
while read -r line; do
  case $line in *hash*) echo '{"seconds": 2.0}';; *) echo '{"seconds": 3.0}';; esac
done
"""


class Bench(ProgramCase):
    def test_the_last_line_has_every_goal(self):
        number = r"[0-9]+\.[0-9]{1,2}"
        self.assertRegex(self.ok(TINY).out.splitlines()[-1],
                         rf"\Abench: P1=n/a P2=n/a P2c=({number}|n/a) P3=n/a P4={number} P7={number} P8={number} "
                         rf"threads2=({number}|n/a) P15=({number}|n/a) isa=[a-z0-9_]+\Z")

    def test_steps_allocate_nothing_after_the_first(self):
        out = json.loads(self.ok(f"--json {TINY}").out)
        rows = [row for group in ("steps", "classes", "scaling") for row in out[group]]
        for row in rows:
            self.assertTrue(row["allocated_bytes"] == 0 < min(row["seconds"]["median"], row["flop"]), row)
        self.assertGreaterEqual(len(rows), 13)  # three networks, five numbers of classes for two of them
        self.assertGreater(out["peak_fp32_flops"][0], 0)
        self.assertAlmostEqual(out["goals"]["P4"], out["steps"][0]["peak_share"], 11)

    def test_without_a_peer_it_says_why(self):
        r = self.ok(f"{TINY} --peers --python /no/such/python")
        self.has(r.err + r.out, "no Python with torch (asked: /no/such/python)")
        self.has(r.out.splitlines()[-1], "P1=n/a P2=n/a P2c=")

    def test_ratios_are_of_rates_beside_the_peer(self):
        peer = self.write("fake python", PEER)
        peer.chmod(0o755)
        out = json.loads(self.ok(f"--json {TINY} --peers --python {shlex.quote(str(peer))}").out)
        self.assertGreaterEqual(len(out["peers"]), 4)
        rate = {row["net"]: row["samples_per_s"] for row in out["steps"] if row["precision"] == "fp32"}
        rays = out["steps"][0]["rays"]
        self.assertAlmostEqual(out["goals"]["P1"], rate["paper"] / (rays * 256 / 3), 6)
        self.assertAlmostEqual(out["goals"]["P3"], rate["hash T=2^15"] / (rays * 30 / 2), 6)

    def test_wrong_words_are_refused(self):
        for words, code in (("bench step --size huge", 2), ("bench step --repeats 0", 2),
                            (f"{TINY} --set runtime.thread=1", 78), ("bench", 2)):
            self.ended(words, code)
        r = self.semfield("bench pairs")
        self.has(r.err + r.out, "studies/leave_out.py")


if __name__ == "__main__":
    main()
