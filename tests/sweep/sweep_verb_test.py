#!/usr/bin/env python3
"""`semfield sweep` as a program: cells in parallel, tables, going on after a kill, processes that share a folder."""

import random
import socket

from program import *

TIMES = ("train_s", "processor_s", "peak_mb")  # what is measured of a process differs from run to run
SWEEP = """base: base.yaml
split: train
scenes: {room: }
metrics: [miou_present, given_miou_present]
variants:
  clean: {x: 0}
  noisy: {x: 50, set: {scene.labels.degrade: [{type: pixel_noise, ratio: 0.5}]}}
  fused: {fuse: {method: bayesian, field: noisy}, set: {scene.labels.degrade: [{type: pixel_noise, ratio: 0.5}]}}
"""
BROKEN = "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n"


def result_of(text):
    root = json.loads(text)
    return {**root, "values": {name: value for name, value in root["values"].items() if name not in TIMES}}


class SweepCase(ProgramCase):
    def sweep(self, steps, more="", folder=None):
        """Writes a tiny sweep: two variants that train on three frames, and one that fuses. Where its cells go."""
        folder = folder or self.dir
        write_room(folder / "room")
        (folder / "base.yaml").write_text(f"include: {SOURCE}/configs/experiments/editions/hash_field.yaml\n"
                                          f"scene: {ROOM}\ntrain: {{steps: {steps}, rays: 64}}\n")
        (folder / "tiny.yaml").write_text(SWEEP + more)
        return folder / "out"

    def words(self, *more, out=None):
        return ["sweep", self.dir / "tiny.yaml", "--out", out or self.dir / "out", *more]

    def cells(self, name, out=None):
        """Text of cells/ID/NAME by ID, for the cells that have it."""
        return {path.relative_to((out or self.dir / "out") / "cells").parts[0]: path.read_text()
                for path in (out or self.dir / "out").glob(f"cells/*/{name}")}

    def begun(self):
        """Cells whose runs have taken a step."""
        return [cell for cell, rows in self.cells("run/metrics.jsonl").items() if rows]

    def results(self, out=None):
        lines = ((out or self.dir / "out") / "results.csv").read_text().splitlines()
        return [line for line in lines if not any(f",{name}," in line for name in TIMES)]

    def results_of_one(self):
        self.ok(self.words(out=self.dir / "one"))
        return self.results(self.dir / "one")

    def process_of(self, cell):
        return int((self.dir / "out/cells" / cell / "run/.lock").read_text().split()[0])

    def held(self, sweep):
        """A cell in the middle of its work, stopped there, and its process."""
        self.assertTrue(until(self.begun), sweep.err())
        cell = self.begun()[0]
        os.kill(self.process_of(cell), signal.SIGSTOP)
        return cell, self.process_of(cell)

    def done(self, cells, failed=0):
        return f"sweep: cells={cells} done={cells - failed} failed={failed} folder={self.dir / 'out'}\n"


class Sweep(SweepCase):
    def test_every_cell_runs_once_and_makes_its_tables(self):
        out = self.sweep(6)
        self.assertEqual(self.ok(self.words("--jobs", 2)).out, self.done(3))
        csv = (out / "results.csv").read_text()
        self.has(csv, "tiny,room,clean,1,given_miou_present,1", "tiny,room,noisy,1,miou_present,",
                 "tiny,room,fused,1,miou_present,")
        self.has((out / "tables.md").read_text(), "| fused |")
        self.has((out / "tables.html").read_text(), '"experiments"', '"fused"')
        # Again, from another working folder: nothing runs, the same bytes.
        self.ended(self.words(), 0, "3 of them done", folder=self.folder())
        self.assertEqual((out / "results.csv").read_text(), csv)

    def test_a_stopped_sweep_goes_on(self):
        """Stopped by SIGTERM while cells train: they save, nothing is left running, and the next start resumes them."""
        self.sweep(200)
        sweep = self.start(*self.words("--jobs", 2, "-q"))
        self.assertTrue(until(self.begun), "no cell began to train")
        sweep.send(signal.SIGTERM)
        self.assertEqual(sweep.wait().code, 143)
        self.assertTrue(self.cells("run/checkpoints/latest"))
        self.ok(self.words())
        self.assertTrue(any('"step":200' in rows for rows in self.cells("run/metrics.jsonl").values()))

    def test_ctrl_c_of_a_terminal_lets_cells_save(self):
        """A terminal sends it to every process of the group: a cell must not take it as its first signal and the sweep's
        as the second, which ends at once."""
        self.sweep(100_000)
        sweep = self.start(PROGRAM, *self.words("--jobs", 2), program="/usr/bin/setsid")
        self.assertTrue(until(lambda: len(self.begun()) == 2), sweep.err())
        locks = self.cells("run/.lock")
        self.assertEqual(len(locks), 2)
        for lock in locks.values():
            self.assertNotEqual(os.getpgid(int(lock.split()[0])), sweep.pid)
        os.kill(-sweep.pid, signal.SIGINT)
        self.assertEqual(sweep.wait().code, 130)
        self.assertEqual(set(self.cells("run/checkpoints/latest")), set(locks))

    def test_a_killed_sweep_that_is_started_again_waits_for_its_old_cells(self):
        """A cell that outlives its sweep holds the cell's lock until it has saved; here the test does."""
        out = self.sweep(200)
        first = self.start(*self.words("--jobs", 1))
        cell, process = self.held(first)
        first.kill()
        os.kill(process, signal.SIGCONT)
        with open(out / "cells" / cell / ".lock", "r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self.assertIn(cell, self.cells("run/checkpoints/latest"))
            lock.truncate()
            lock.write(f"{os.getpid()} {socket.gethostname()}\n")
            lock.flush()
            second = self.start(*self.words("--jobs", 1))
            waits = f"/cells/{cell}: process {os.getpid()} on "
            self.assertTrue(until(lambda: waits in second.err()), second.err())
            self.assertIn(cell, self.cells("run/metrics.jsonl"))
        self.has(self.ok(second.wait()).out, "cells=3 done=3 failed=0")
        # What it had learned is not lost: the run was gone on with.
        self.lacks(self.cells("result.json")[cell], "processor_s")

    def test_kills_of_two_processes_lose_no_result(self):
        """Two on one folder, killed at random moments and started again. SEMFIELD_SWEEP_KILLS: starts and kills of both
        together; scripts/release_check sweep_torture gives it."""
        kills = int(os.environ.get("SEMFIELD_SWEEP_KILLS", 6))
        self.sweep(60, "seeds: [1, 2]\n")
        begin = time.monotonic()
        self.ok(self.words("--jobs", 2, out=self.dir / "whole"))
        whole_s = time.monotonic() - begin
        expected = self.cells("result.json", self.dir / "whole")
        self.assertEqual(len(expected), 6)
        choices = random.Random(1)  # the moments are the machine's, the choices are not
        killed = sweeps = resumed = 0
        while killed < kills:
            out, done = self.dir / f"out{sweeps}", {}
            while killed < kills and len(done) < 6:
                both = [self.start(*self.words("--jobs", 2, out=out))]
                time.sleep(0.04 * whole_s * choices.random())
                both.append(self.start(*self.words("--jobs", 2, out=out)))
                for process in choices.sample(both, 2):
                    time.sleep(0.4 * whole_s * choices.random())
                    sent = signal.SIGTERM if choices.random() < 1 / 3 else signal.SIGKILL
                    process.send(sent)
                    r = process.wait()
                    # All done, stopped in order, or ended by the signal: a SIGTERM comes before the handler is there.
                    self.assertTrue(r.code in (0, -sent) or (r.code, sent) == (143, signal.SIGTERM),
                                    f"{r.code}: {r.err}")
                    killed += 1
                now = self.cells("result.json", out)
                self.assertEqual({cell: now.get(cell) for cell in done}, done, f"after {killed} kills")
                done = now
            self.has(self.ok(self.words("--jobs", 2, out=out)).out, "cells=6 done=6 failed=0")
            ended = self.cells("result.json", out)
            self.assertEqual({cell: ended[cell] for cell in done}, done)
            self.assertEqual({cell: result_of(text) for cell, text in ended.items()},
                             {cell: result_of(text) for cell, text in expected.items()})
            resumed += sum("processor_s" not in text for text in ended.values())
            sweeps += 1
        print(f"sweep torture: kills={killed} sweeps={sweeps} resumed_cells={resumed} lost=0 changed=0")


class SharedSweep(SweepCase):
    """Several processes of one sweep on one folder share the cells, and what they leave is what one process leaves."""

    def both(self):
        processes = [self.start(*self.words("--jobs", 1)) for _ in range(2)]
        return [process.wait() for process in processes]

    def test_two_run_every_cell_once_and_leave_the_files_of_one(self):
        out = self.sweep(40, "seeds: [1, 2]\n")
        one = self.results_of_one()
        a, b = (self.ok(r) for r in self.both())
        # Each reports the end of the whole sweep, and of its cells alone.
        self.assertEqual([a.out, b.out], [self.done(6)] * 2)
        counts = [r.err.count("/6] ") for r in (a, b)]
        self.assertTrue(sum(counts) == 6 and all(counts), a.err + b.err)
        self.assertEqual(self.results(), one)
        for name in ("tables.md", "cells.csv", "tiny.csv", "tables.html"):
            self.assertEqual((out / name).read_bytes(), (self.dir / "one" / name).read_bytes(), name)
        names = lambda where: {str(p.relative_to(where)) for p in where.rglob("*")}
        self.assertEqual(names(out), names(self.dir / "one"))

    def test_a_failed_cell_is_tried_by_one_and_by_the_next_sweep_again(self):
        self.sweep(60, BROKEN)
        broken = "broken, room, seed 1: exit code 65"
        a, b = self.both()
        for r in (a, b):
            self.assertEqual((r.code, r.out), (1, self.done(4, 1)), r.err)
        self.assertEqual((a.err + b.err).count(broken), 1)
        failures = list(self.cells("failure.txt").values())
        self.assertEqual(len(failures), 1)
        self.has(failures[0], "no training pixel carries a label")
        again = self.ended(self.words(), 1, "no training pixel carries a label")
        self.assertEqual((again.err.count(broken), again.out), (1, a.out))

    def test_the_cell_of_a_killed_process_is_taken_up(self):
        """The cell is held in the middle of its work while its sweep dies, so that the other finds it unfinished."""
        self.sweep(200)
        first = self.start(*self.words("--jobs", 1))
        cell, process = self.held(first)
        second = self.start(*self.words("--jobs", 1))
        self.assertTrue(until(lambda: f"process {first.pid} on " in second.err()), second.err())
        first.kill()
        os.kill(process, signal.SIGCONT)
        self.assertEqual(self.ok(second.wait()).out, self.done(3))
        self.lacks(self.cells("result.json")[cell], "processor_s")  # gone on with, so nobody knows what it took in all
        self.assertEqual(self.results(), self.results_of_one())

    def test_another_sweep_on_the_folder_is_refused_by_name(self):
        out = self.sweep(100_000)
        first = self.start(*self.words("--jobs", 2))
        self.assertTrue(until(self.begun), first.err())
        before, other = self.cells("run/.lock"), self.folder()
        self.sweep(99_999, folder=other)
        second = self.start("sweep", other / "tiny.yaml", "--out", out).wait(120)
        self.ended(second, 73, f"the sweep folder '{out}' is in use by process {first.pid} on {socket.gethostname()}, "
                   "another sweep with other cells; wait for it to end, stop it")
        self.ok(self.words("--dry-run"), folder=other)  # looking is allowed
        for lock in before.values():
            os.kill(int(lock.split()[0]), 0)
        self.assertIsNone(first.process.poll())
        first.send(signal.SIGTERM)
        self.assertEqual(first.wait().code, 143)

    def test_devices_that_are_not_there_are_refused(self):
        out = self.sweep(3)  # no device of the machine is seen by tests
        for words, code, said in ((("--devices", "all"), 69, "--devices all: "),
                                  (("--devices", "1,0"), 69, "--devices: no cuda:1: "),
                                  (("--devices", "0,all"), 2, "--devices: 'all' is not a CUDA device"),
                                  (("--devices", "0", "--jobs", "2"), 2, "--jobs")):
            self.ended(self.words(*words), code, said)
        self.assertFalse(out.exists())


if __name__ == "__main__":
    main()
