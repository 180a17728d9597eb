#!/usr/bin/env python3
"""The program among faults: two processes on one run, full disks, limits, closed pipes and streams, signals, kills at
its file calls. A run that is gone on with ends in the bits of the run left alone. SEMFIELD_FAULT_SHIM names the library
that plans faults, SEMFIELD_SANITIZE the sanitizers of the build."""

import errno
import shutil

from program import *

STEPS = 80
HANG_S = 120  # a program that has not ended by then never will
SANITIZE = os.environ.get("SEMFIELD_SANITIZE", "")


class Program(ProgramCase):
    @classmethod
    def setUpClass(cls):
        """The tensors that STEPS end in, however often they are saved."""
        with tempfile.TemporaryDirectory(prefix="semfield_test_") as made:
            case, folder = cls("ok"), pathlib.Path(made)
            case.ok(["train", case.room(STEPS, folder=folder), "--out", folder / "run"], folder)
            cls.whole = tensors(folder / "run")

    def setUp(self):
        super().setUp()
        self.run_dir = self.dir / "run"

    def train(self, *words):
        """Words that begin the run, or go on with it."""
        begun = (self.run_dir / "run.yaml").exists()
        return ["train", *(["--resume", self.run_dir] if begun else [self.dir / "config.yaml", "--out", self.run_dir]),
                *words]

    def ends_in_the_same_bits(self):
        self.assertEqual(newest_step(self.run_dir), STEPS)
        self.assertTrue(tensors(self.run_dir) == self.whole, "other bits")

    def goes_on_to_the_same_bits(self):
        self.ok(self.train())
        self.ends_in_the_same_bits()

    def faulty(self, call=0, fault="", sticky=False):
        """Its environment with a fault (fault_shim.cpp) at a call below the run's folder, and the log of its calls."""
        shim, log = pathlib.Path(os.environ["SEMFIELD_FAULT_SHIM"]), self.folder() / "log"
        # By name: in LD_PRELOAD a space ends a path.
        return {"LD_PRELOAD": shim.name, "LD_LIBRARY_PATH": str(shim.parent),
                "ASAN_OPTIONS": "verify_asan_link_order=0", "SEMFIELD_FAULT_BELOW": str(self.run_dir),
                "SEMFIELD_FAULT_LOG": str(log), "SEMFIELD_FAULT_CALL": str(call), "SEMFIELD_FAULT": str(fault),
                "SEMFIELD_FAULT_STICKY": str(int(sticky))}, log

    def calls(self):
        """Name and path of each file call of an undisturbed run, which is removed."""
        env, log = self.faulty()
        self.ok(self.train(), env=env)
        shutil.rmtree(self.run_dir)
        return [(line.split("\t")[1], line.split("\t")[3]) for line in log.read_text().splitlines()]

    def latest(self):
        return (self.run_dir / "checkpoints/latest").read_bytes()

    def said(self, process, text):
        self.assertTrue(until(lambda: text in process.err(), HANG_S), process.err())

    def test_a_second_process_on_a_run_is_refused_and_readers_are_not(self):
        config = self.room(1_000_000, 0.05)
        first = self.start(*self.train())
        self.assertTrue(until((self.run_dir / "checkpoints/latest").exists, HANG_S))
        for words in (["--resume", self.run_dir], [config, "--out", self.run_dir]):
            self.ended(["train", *words], 73, f"the run folder '{self.run_dir}' is in use by process {first.pid}",
                       "wait for it to end, stop it, or choose another folder with --out")
        # Evaluation reads the newest checkpoint between two saves and takes none of the files that are being written.
        for _ in range(3):
            self.ok(["eval", self.run_dir])
        first.send(signal.SIGTERM)
        self.ended(first.wait(HANG_S), 143)

    def test_a_file_size_limit_is_a_failed_write_and_no_signal(self):
        self.room(STEPS)
        self.ended(self.limited("-f 64", self.train()), 74, "the limit of a file's size is reached: need ",
                   "raise it with `ulimit -f`", "there is no checkpoint yet")
        self.goes_on_to_the_same_bits()

    @unittest.skipIf("address" in SANITIZE, "the sanitizers open a pipe to look at an object's type, and take a "
                     "failure for a wrong one")
    def test_too_few_open_files_are_an_error_at_every_place(self):
        """The call that opens one file too many, wherever it is: each limit moves it."""
        self.room(STEPS)
        refused = 0
        for most in range(4, 64):
            shutil.rmtree(self.run_dir, ignore_errors=True)
            result = self.limited(f"-n {most}", self.train("--steps", 2))
            if result.code == 0:
                break
            if result.code == 127:  # the loader could not open a library
                continue
            refused += 1
            self.assertIn(result.code, (74, 66), result.err)  # 66: when it is the scene that cannot be read
            self.has(result.err, "Too many open files")
        self.assertEqual(result.code, 0)
        self.assertGreaterEqual(refused, 2)

    @unittest.skipIf(SANITIZE, "a sanitizer reserves more address space than any limit allows")
    def test_too_little_memory_is_a_sentence(self):
        self.room(STEPS)
        refused, most = 0, 30 << 10
        while most < 4 << 20:
            most += most // 32
            shutil.rmtree(self.run_dir, ignore_errors=True)
            # Less does not even start it: the allocator of TBB ends the process before main() by a signal.
            if self.limited(f"-v {most}", ["--version"]).code:
                continue
            result = self.limited(f"-v {most}", self.train("--steps", 2, "--threads", 1), {"OMP_NUM_THREADS": "1"})
            if result.code == 0:
                break
            if result.code != 127:
                refused += 1
                self.ended(result, 1, "ut of memory")  # libgomp itself writes "Out of memory"
        self.assertEqual(result.code, 0)
        self.assertGreaterEqual(refused, 1)

    def test_a_disk_that_fills_under_the_log_names_the_checkpoint_kept(self):
        self.room(STEPS)
        rows = [n for n, (name, path) in enumerate(self.calls(), 1)
                if name == "write" and path.endswith("metrics.jsonl")]
        self.assertGreaterEqual(len(rows), 10)
        self.ended(self.train(), 74, "training ended at step 30 (there is no checkpoint yet: a resume begins at step "
                   f"0; resume with `semfield train --resume {shlex.quote(str(self.run_dir))}`): cannot append to "
                   f"'{self.run_dir}/metrics.jsonl': disk full: need ",
                   env=self.faulty(rows[5], errno.ENOSPC, True)[0])
        self.goes_on_to_the_same_bits()

    def test_killed_at_its_file_calls_it_goes_on(self):
        """SEMFIELD_TORTURE_CALLS: at how many of them; 0: at every one."""
        self.room(STEPS, 0.01)
        calls = len(self.calls())
        self.assertGreater(calls, 100)
        places, kills = int(os.environ.get("SEMFIELD_TORTURE_CALLS", 6)) or calls, 0
        for i in range(places):
            shutil.rmtree(self.run_dir, ignore_errors=True)
            with self.subTest(call := 1 + calls * i // places):
                env, _ = self.faulty(call, "kill_after" if i % 2 else "kill_before")
                kills += self.semfield(self.train(), env=env).code == -signal.SIGKILL
                self.goes_on_to_the_same_bits()
                self.assertEqual(list(self.run_dir.rglob("*.tmp")), [])
        self.assertGreaterEqual(kills, places * 3 // 4)

    def test_a_reader_that_leaves_is_no_error_and_a_full_stdout_is(self):
        self.room(STEPS)

        def code_of(words, reader):
            code = self.dir / "code"
            subprocess.run(f"(sleep 0.1; {shlex.quote(PROGRAM)} {words} 2>&1; echo $? >code) | {reader} >/dev/null",
                           shell=True, cwd=self.dir, check=True)
            self.assertTrue(until(lambda: code.exists() and code.stat().st_size, HANG_S))
            text = code.read_text()
            code.unlink()
            return text

        self.assertEqual(code_of("help --completion", "head -1"), "0\n")
        self.assertEqual(code_of("help --completion", "true"), "0\n")
        self.assertEqual(code_of("train config.yaml --out run", "true"), "0\n", "training goes on without its reader")
        self.ends_in_the_same_bits()
        if not os.path.exists("/dev/full"):
            self.skipTest("no /dev/full here: a full stdout was not tried")
        with open("/dev/full", "wb") as full:
            done = subprocess.run([PROGRAM, "help", "--completion"], stdout=full, stderr=subprocess.PIPE, text=True)
        self.assertEqual(done.returncode, 74)
        self.has(done.stderr, "cannot write the results to stdout")

    def test_closed_streams_put_no_message_into_a_file(self):
        self.room(STEPS, 0.01)
        subprocess.run(f"{shlex.join(map(str, [PROGRAM, *self.train()]))} <&- >&- 2>&-", shell=True, check=True)
        self.ends_in_the_same_bits()
        for path in self.run_dir.rglob("*"):
            self.assertFalse(path.is_file() and b"miou_present=" in path.read_bytes(), path)

    def test_sighup_saves_and_goes_on(self):
        self.room(1_000_000)
        process, rows = self.start(*self.train()), self.run_dir / "metrics.jsonl"
        # Rows are there, so steps are under way and stop signals wait for them.
        self.assertTrue(until(lambda: rows.exists() and rows.stat().st_size, HANG_S))
        self.assertFalse((self.run_dir / "checkpoints/latest").exists())
        process.send(signal.SIGHUP)
        self.said(process, "saved as asked")
        first = self.latest()
        with self.assertRaises(subprocess.TimeoutExpired, msg="it goes on"):
            process.wait(0.3)
        process.send(signal.SIGHUP)
        self.assertTrue(until(lambda: self.latest() != first, HANG_S))
        process.send(signal.SIGTERM)
        self.ended(process.wait(HANG_S), 143)

    def test_stop_signals_are_answered_in_time_at_any_moment(self):
        """From the start on: the program ends in time, with the signal's code, and the run can be gone on with."""
        config = self.room(STEPS, 0.05)
        # Moments spread over what a whole run takes here and now; more of them until one fell between steps.
        start = time.monotonic()
        self.ok(["train", config, "--out", self.dir / "whole"])
        whole_s, orderly, i = time.monotonic() - start, 0, 0
        while i < 12 or (orderly == 0 and i < 320):
            number = signal.SIGINT if i % 2 else signal.SIGTERM
            process = self.start(*self.train())
            time.sleep(whole_s * (i % 12) / 12)
            process.send(number)
            result, i = process.wait(HANG_S), i + 1
            if result.code == -number:  # it came before the program's first line
                continue
            if result.code == 0:  # it came behind its last
                shutil.rmtree(self.run_dir)
                continue
            self.ended(result, 128 + number, "stopped")
            orderly += "stopped before the first step" not in result.err
        self.assertGreater(orderly, 0)
        self.goes_on_to_the_same_bits()

    def test_a_second_sigint_is_answered_and_a_third_ends_at_once_with_the_old_checkpoint(self):
        """Steps of seconds, and one that has just begun: the first signal is still waiting when the next come. People
        press Ctrl-C twice because nothing has answered yet, not to lose what they wait for; the third ends at once."""
        for signals in (2, 3):
            shutil.rmtree(self.run_dir, ignore_errors=True)
            self.room(2)
            self.ok(self.train("--set", "train.rays=100000"))
            process = self.start(*self.train("--steps", 1000, "--threads", 1))
            self.said(process, "resuming at step 2")
            process.send(signal.SIGHUP)
            self.said(process, "saved as asked")
            latest = self.latest()
            for _ in range(1, signals):
                process.send(signal.SIGINT)
                with self.assertRaises(subprocess.TimeoutExpired, msg="a step was to be under way"):
                    process.wait(0.05)
            process.send(signal.SIGINT)
            err = self.ended(process.wait(HANG_S), 130, *(
                ("after its checkpoint; resume with `semfield train --resume ", "stopped at step",
                 "still saving; press Ctrl-C again to end without saving\n") if signals == 2 else
                ("ended without saving; everything saved before is intact\n",))).err
            self.assertEqual("stopped at step" in err, signals == 2)
            self.assertEqual(self.latest() == latest, signals == 3, "was the step waited for")
            tensors(self.run_dir)  # sound


if __name__ == "__main__":
    main()
