#!/usr/bin/env python3
"""The program under mpirun (SEMFIELD_MPIRUN): the files of one process from any number of them, and an end in order
when one is killed. SEMFIELD_MPIRUN_RECOVERY: mpirun's flag to leave the others when one ends."""

from program import *

MPIRUN, RECOVERY = os.environ["SEMFIELD_MPIRUN"], os.environ["SEMFIELD_MPIRUN_RECOVERY"]
# More ranks than cores, also where nobody but root is there.
ENV = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMPI_MCA_rmaps_base_oversubscribe": "1",
       "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
TWO_PASSES = """scene: {type: packed, file: room.sfpack}
semantics: {hidden_width: 16, weight: 0.3}
passes:
  - name: coarse
    sampler: {type: stratified, samples: 8}
    position: {type: frequency, frequencies: 3}
    direction: {type: frequency, frequencies: 2}
    field: {type: nerf_mlp, depth: 4, width: 24, skip_at: 2, view_width: 12}
  - name: fine
    sampler: {type: importance, samples: 8}
    position: {type: frequency, frequencies: 3}
    direction: {type: frequency, frequencies: 2}
    field: {type: nerf_mlp, depth: 4, width: 24, skip_at: 2, view_width: 12}
train: {steps: STEPS, rays: 64}
report: {eval_every_s: 0, strips: 0}
"""


class Mpirun(ProgramCase):
    def env(self):
        """Two of mpirun that begin at once in /tmp make the same folder, and one fails: each has a folder of its own."""
        return {**ENV, "TMPDIR": str(self.dir)}

    def begin(self, ranks, *words, of_mpirun=()):
        return self.start("-n", ranks, "--oversubscribe", *of_mpirun, PROGRAM, *words, env=self.env(), program=MPIRUN)

    def ranks(self, ranks, *words):
        return self.begin(ranks, *words).wait()

    def count(self, text, part, expected=1):
        """Lines that have the part."""
        self.assertEqual(sum(part in line for line in text.splitlines()), expected, text)

    def same_bits(self, run, other, steps):
        self.assertEqual((newest_step(run), newest_step(other)), (steps, steps))
        self.assertTrue(tensors(run) == tensors(other), run)

    def process_of(self, rank, run):
        """The process of a rank, once it is there."""
        def found():
            for path in pathlib.Path("/proc").glob("[0-9]*"):
                try:
                    words = (path / "cmdline").read_bytes()
                    if words.startswith(os.fsencode(PROGRAM)) and os.fsencode(run) in words:
                        if f"OMPI_COMM_WORLD_RANK={rank}\0".encode() in (path / "environ").read_bytes():
                            return int(path.name)
                except OSError:
                    pass  # it has ended
        process = until(found, 20)
        self.assertIsNotNone(process, f"no rank {rank}")
        return process

    def test_it_trains_the_same_bits_on_1_and_2_and_3_ranks_of_1_and_2_threads(self):
        steps = 40
        for config in (self.room(steps), self.write("two_pass.yaml", TWO_PASSES.replace("STEPS", str(steps)))):
            alone = self.dir / f"{config.stem}_alone"
            self.ok(["train", config, "--out", alone, "--threads", 1])
            for ranks, threads in ((1, 2), (2, 1), (3, 2)):
                out = self.dir / f"{config.stem}_{ranks}_ranks_of_{threads}"
                trained = self.ok(self.ranks(ranks, "train", config, "--out", out, "--threads", threads))
                self.same_bits(out, alone, steps)
                self.count(trained.out, "train: ")

    def test_it_evaluates_and_renders_what_one_process_does(self):
        run, one, three = self.dir / "run", self.dir / "one", self.dir / "three"
        self.ok(["train", self.room(30), "--out", run])
        self.assertEqual(self.ranks(3, "eval", run, "--json").out, self.ok(["eval", run, "--json"]).out)
        self.ok(["render", run, "--out", one, "--npy"])
        self.ok(self.ranks(3, "render", run, "--out", three, "--npy"))
        files = [path for path in one.rglob("*") if path.is_file()]
        for path in files:
            self.assertEqual((three / path.relative_to(one)).read_bytes(), path.read_bytes(), path)
        self.assertGreater(len(files), 10)

    def test_weak_multiplies_the_rays_and_the_run_says_so(self):
        config, weak, alone = self.room(5), self.dir / "weak", self.dir / "alone"
        self.ok(self.ranks(2, "train", config, "--out", weak, "--weak"))
        self.has((weak / "run.yaml").read_text(), "rays: 384")
        self.ok(["train", config, "--out", alone, "--set", "train.rays=384"])
        self.same_bits(weak, alone, 5)
        self.ended(self.ranks(2, "train", "--resume", weak, "--weak"), 2, "--weak multiplies the rays of a new run")

    def test_it_says_once_what_is_wrong(self):
        config, run = self.room(5), self.dir / "run"
        # The folder exists: an error of rank 0 alone, after the others have begun to follow.
        self.ok(self.ranks(2, "train", config, "--out", run))
        for words, code, said in ((("train", config, "--stepz", 3), 2, "semfield: train has no flag --stepz"),
                                  (("train", self.dir / "none.yaml"), 66, "semfield: "),
                                  (("inspect", config), 2,
                                   "mpirun started 3 processes, but `semfield inspect` works in one"),
                                  (("train", config, "--out", run), 73, "semfield: ")):
            self.count(self.ended(self.ranks(3, *words), code).err, said)

    def test_a_killed_rank_ends_the_run_with_a_message_and_one_process_goes_on_with_the_bits(self):
        steps, whole = 300, self.dir / "whole"
        config = self.room(steps, 0.05)
        self.ok(["train", config, "--out", whole])
        # A launcher that ends the others, and one that leaves that to them.
        for rank, of_mpirun in ((1, ()), (2, (RECOVERY,)), (0, ()), (0, (RECOVERY,))):
            out = self.dir / f"victim_{rank}{''.join(of_mpirun)}"
            process = self.begin(3, "train", config, "--out", out, "--threads", 1, of_mpirun=of_mpirun)
            self.assertTrue(until(lambda: newest_step(out) >= 20))
            os.kill(self.process_of(rank, out), signal.SIGKILL)
            err = process.wait(30).err
            self.assertLess(newest_step(out), steps, "it was killed too late")
            if rank:
                self.has(err, f"rank {rank} on ", "has ended", "resume with `semfield train --resume ")
            self.ok(["train", "--resume", out])
            self.same_bits(out, whole, steps)

    def test_a_stop_saves_and_any_number_of_ranks_goes_on(self):
        """Of any rank, or of all of them at once, as launchers pass it on."""
        steps, whole = 400, self.dir / "whole"
        config = self.room(steps, 0.05)
        self.ok(["train", config, "--out", whole])
        for asked in ((0,), (1,), (1, 0), (0, 1)):
            out = self.dir / f"stopped_{asked}"
            process = self.begin(2, "train", config, "--out", out, "--threads", 1)
            self.assertTrue(until(lambda: newest_step(out) >= 20))
            for pid in [self.process_of(rank, out) for rank in asked]:
                os.kill(pid, signal.SIGTERM)
                time.sleep(0.002)  # the other rank may hear of it first
            err = process.wait(30).err
            self.assertLess(newest_step(out), steps, "it was asked too late")
            self.has(err, "after its checkpoint; resume with `semfield train --resume")
            self.ok(self.ranks(3, "train", "--resume", out))
            self.same_bits(out, whole, steps)

    def test_a_stop_of_any_rank_ends_a_rendering(self):
        """A verb that saves nothing ends at once, whichever rank got the signal."""
        run, views = self.dir / "run", self.dir / "views"
        self.ok(["train", self.room(5), "--out", run])
        process = self.begin(2, "render", run, "--trajectory", "smooth", "--frames", 100000, "--out", views)
        self.assertTrue(until((views / "cameras.json").exists))
        os.kill(self.process_of(1, views), signal.SIGTERM)
        process.wait(30)

    def test_ranks_that_were_started_with_other_words_are_refused(self):
        config = self.room(5)

        def both(first, second):
            # By a script: `mpirun ... : ...` of Open MPI 5.0.7 crashes.
            line = lambda words: shlex.join(["exec", PROGRAM, *words.split()])
            script = self.write("script", f'[ "$OMPI_COMM_WORLD_RANK" = 0 ] && {line(first)}\n{line(second)}\n')
            return self.start("-n", 2, "--oversubscribe", "sh", script, env=self.env(), program=MPIRUN).wait()

        words = f"train {config} --out {self.dir}/a"
        self.count(self.ended(both(words, f"{words} --steps 9"), 2).err,
                   f"was started as `semfield {words} --steps 9`, and rank 0 as `semfield {words}`; start all ")
        self.assertFalse((self.dir / "a").exists())
        unknown = both(f"train {config} --out {self.dir}/b", f"train {config} --stepz 9")
        self.assertNotEqual(unknown.code, 0)
        self.count(unknown.err, "semfield: train has no flag --stepz")


if __name__ == "__main__":
    main()
