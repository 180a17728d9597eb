#!/usr/bin/env python3
"""The program, killed and signalled: no run is lost and resumed ones end in the same bits; what its verbs say, on a
terminal too."""

import random
import re
import shutil

from program import *


def header_of(file):
    data = file.read_bytes()
    return json.loads(data[8:8 + struct.unpack_from("<Q", data)[0]])


def evals(run):
    rows = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [row for row in rows if row["kind"] == "eval"]


class Process(ProgramCase):
    def scaled(self, scale):
        return [word for of in ("pose", "depth") for word in ("--set", f"scene.load.{of}_scale={scale}")]

    def test_random_kills_lose_no_run_and_change_no_bit(self):
        """SEMFIELD_TORTURE_KILLS sets how many."""
        self.room(200, 0.02)
        # Small steps: a thousand kills are about starts, saves and resumes.
        config = self.write("small.yaml", "include: config.yaml\ntrain: {rays: 24}\nruntime: {threads: 1}\n")
        victim, wanted = self.dir / "victim", max(1, int(os.environ.get("SEMFIELD_TORTURE_KILLS", 25)))
        start = time.monotonic()
        self.ok(["train", config, "--out", self.dir / "whole"])
        whole_s, whole = time.monotonic() - start, tensors(self.dir / "whole")

        def words():
            return ("train", "--resume", victim) if (victim / "run.yaml").exists() else (
                "train", config, "--out", victim)

        def ended_as_whole():
            self.assertEqual(newest_step(victim), 200)
            self.assertTrue(tensors(victim) == whole, "other bits")

        kills, step, chance = 0, -1, random.Random(7)
        for _ in range(10 * wanted):
            process = self.start(*words())
            # Up to half of what the whole run takes on this machine, so that kills fall into every part of it.
            time.sleep(0.005 + 0.5 * whole_s * chance.random())
            process.send(signal.SIGKILL)
            result = process.wait()
            if result.code != -signal.SIGKILL:
                # The run reached its end between two kills: kill further runs of the same course.
                self.ok(result)
                ended_as_whole()
                shutil.rmtree(victim)
                step = -1
                continue
            left = newest_step(victim)
            if left >= 0:
                tensors(victim)  # sound
            self.assertGreaterEqual(left, step, f"kill {kills} lost a checkpoint")
            kills, step = kills + 1, left
            if kills == wanted:
                break
        self.assertEqual(kills, wanted)
        self.ok(words())
        ended_as_whole()
        self.assertEqual(list(victim.rglob("*.tmp")), [])

    def test_eval_prints_one_json_object(self):
        self.ok(["train", self.room(30), "--out", self.dir / "run"])
        out = self.ok("--json eval run").out
        self.assertEqual(out.count("\n"), 1)
        json.loads(out)
        self.has(out, *(f'"{name}":' for name in ("miou_present", "total_accuracy", "psnr", "absrel", "train_s",
                                                  "entropy_auroc", "auroc_error")))
        self.lacks(out, "given_right_entropy")
        self.has(self.ok("--json eval run --split train").out, '"given_right_entropy":1.', '"given_wrong_auroc":null')
        self.has(self.ok("render run --split test --npy").out, "frames=3")

    def test_a_step_of_depth_pictures_suits_the_scene_and_is_said(self):
        config = self.room(5)
        for scale, step in ((1, 0.001), (300, 0.1)):
            out = self.dir / f"of_{scale}"
            self.ok(["train", config, *self.scaled(scale), "--out", out])
            err = self.ok(["render", out, "--split", "test", "--out", out / "views"]).err
            self.assertEqual(json.loads((out / "views/cameras.json").read_text())["depth_step"], step)
            self.assertEqual("a step of the depth pictures is 0.1 " in err, step == 0.1, err)

    def test_figures_of_a_tiny_scene_are_not_printed_as_nought(self):
        """A figure that is a length has its digits in a scene of any unit."""
        words = ["train", self.room(5), *self.scaled("1e-4")]
        self.ok([*words, "--out", self.dir / "run"])
        self.has(self.ok([*words, "--dry-run"]).out, "bounds    0.000")
        said, of = self.ok("eval run").out, json.loads(self.ok("eval run --json").out)
        for name in ("absdiff", "sqrel", "rmse"):
            self.assertLess(of[name], 1e-3)
            shown = float(re.search(f"  {name} +(\\S+)", said)[1])
            self.assertAlmostEqual(shown / of[name], 1, 3, name)

    def test_a_refused_run_leaves_no_folder(self):
        """What is wrong with words and configurations: tests/bad_files."""
        config = shlex.quote(str(self.room(5)))
        for words, code in (("--set runtime.device=cuda --out x", 69), ("--out /proc/semfield", 73),
                            ("--set passes.0.field.type=tiny_mpl --out x", 78)):
            self.ended(f"train {config} {words}", code)
        self.assertFalse((self.dir / "x").exists())


@unittest.skipIf(os.environ.get("SEMFIELD_SANITIZE"), "a sanitizer's memory would be counted as the program's")
@unittest.skipIf(os.environ.get("SEMFIELD_WITH_RAYCAST") == "0", "the shipped room is not at hand")
class Memory(ProgramCase):
    def test_the_first_steps_tell_what_they_took_and_end_a_run_that_may_not_take_it(self):
        train = (f"train {shlex.quote(f'{SOURCE}/configs/quickstart.yaml')} --set scene.frames=10 --set scene.test_frames=1 --set "
                 "scene.width_px=64 --set scene.height_px=48 --threads 2 --steps 2")
        said = self.ok(f"{train} --out made").err
        took = re.search("after the first steps the process holds ([0-9]+) MB of memory", said)
        self.assertIsNotNone(took, said)
        self.ended(f"{train} --memory {0.97 * int(took[1]) / 1024} --out over", 69, "runtime.memory_gb allows",
                   "lower train.rays")

    def test_pixels_that_do_not_fit_are_refused_before_they_are_read(self):
        self.ended(f"train {shlex.quote(f'{SOURCE}/configs/quickstart.yaml')} --dry-run --memory 0.2 --set scene.frames=900 --set "
                   "scene.width_px=1600 --set scene.height_px=1200", 69, "frames would take", "scene.load.downscale")


class ScoreLines(ProgramCase):
    """Those of a sample cannot be taken for those of the split."""

    def test_a_sample_has_names_of_its_own(self):
        self.room(200, 60)
        # A time that the first step exceeds leaves time for the least evaluation.
        cut = self.ok("train config.yaml --time 0.001s --threads 1 --out cut")
        self.assertTrue(cut.out.startswith("train: sample=3/3 sample_pixels=1/"), cut.out)
        self.has(cut.out, " sample_miou_present=0.")
        self.lacks(cut.out, " miou_present=", " total_accuracy=", " psnr=", " absrel=")
        self.has(cut.err, "the last evaluation scores all 3 frames at 1 pixel in ", "(report.eval_share 0.1)",
                 "`semfield eval cut` scores every pixel")
        self.has((self.dir / "cut/report.html").read_text(), '"split":"test_sample"')
        self.assertTrue((said := self.ok("eval cut").out).startswith("cut: 3 test frames, step "), said)
        whole = self.ok("train config.yaml --time 0.001s --set report.eval_share=0 --threads 1 --out whole -q")
        self.assertTrue(whole.out.startswith("train: miou_present=0."), whole.out)
        self.assertEqual(whole.err, "", "-q")

    def test_eval_keeps_its_scores_for_the_report(self):
        """What it found is what the report shows from then on, once however often it ran."""
        self.room(200, 60)
        run = self.dir / "run"
        self.ok("train config.yaml --time 0.001s --threads 1 --out run -q")
        self.assertEqual(len(evals(run)), 1)
        found = json.loads(self.ok("eval run --json").out)
        self.ok("eval run -q")
        self.assertEqual(len(evals(run)), 2, "the same scores are kept once")
        kept = evals(run)[-1]
        self.assertEqual([kept[name] for name in ("split", "step", "psnr", "frames", "pixels")],
                         ["test", found["step"], found["psnr"], 3, found["pixels"]])
        self.has((run / "final_eval.json").read_text(), '"split":"test"')
        self.ok("report run")
        shown = json.loads(re.search('id="data">(.*?)</script>', (run / "report.html").read_text(), re.S)[1])
        self.assertEqual(shown["runs"][0]["rows"][-1]["split"], "test", "all frames, no sample")
        # A run that has ended prints what its folder holds.
        again = self.ok("train --resume run --threads 1").out
        self.assertTrue(again.startswith("train: miou_present="), again)
        # Figures of other settings are not the run's.
        self.has(self.ok("eval run --set scene.load.width_px=24 --set scene.load.height_px=18").err,
                 "the run's folder does not keep these scores")
        self.assertEqual(len(evals(run)), 2)
        # Colours from poses that fit the field stand beside the plain figure.
        refined = json.loads(self.ok("eval run --refine-poses --json").out)["refined_poses"]
        self.assertEqual(evals(run)[-1]["psnr_refined_poses"], refined["psnr"])

    def test_figures_that_the_scene_cannot_have_are_not_printed(self):
        self.room(2, 60)
        out = self.ok("train config.yaml --set scene.labels.frames=none --threads 1 --out run").out
        self.assertTrue(out.startswith("train: psnr="), out)
        self.has(out, " absrel=")
        self.lacks(out, "=-")

    def test_what_training_has_shown_is_not_said_again(self):
        self.room(2, 60)
        warning = "the size asked for changes the aspect ratio"
        self.has(self.ok("train config.yaml --set scene.load.width_px=20 --set scene.load.height_px=36 --threads 1 "
                         "--out run").err, warning)
        for verb in ("eval run", "render run"):
            self.lacks(self.ok(verb).err, warning)
        (self.dir / "run/findings.txt").unlink()
        self.has(self.ok("eval run").err, warning)


class RunTruth(ProgramCase):
    """A run's files say what was trained, and the program says what does not go with them."""

    def test_a_folder_that_is_no_utf8_is_refused_before_training(self):
        odd = os.fsdecode(b"caf\xe9")
        self.room(5)
        folder = self.dir / odd
        folder.mkdir()
        for name in ("config.yaml", "room.sfpack"):
            shutil.copy(self.dir / name, folder)
        self.ended("train config.yaml --out run", 78, "it is not UTF-8; nothing was written", "caf\\xe9", folder=folder)
        self.assertFalse((folder / "run").exists())
        # Where only the run folder's name is none, the run's files hold no part of it.
        self.ok(["train", "config.yaml", "--threads", 1, "--out", f"{odd}/run"])
        self.ok(["--json", "eval", f"{odd}/run"])

    def test_settings_of_a_resume_are_stored_and_told(self):
        self.room(5)
        self.ok("train config.yaml --threads 1 --out run")
        environment = self.dir / "run/environment.json"
        environment.write_text(environment.read_text().replace('"started": "', '"started": "on '))
        self.has(self.ok("train --resume run --set train.steps=9 --set report.strips=1").err,
                 "from step 5 on: train.steps: 5 -> 9")
        file = self.dir / "run/run.yaml"
        yaml = file.read_text()
        self.has(yaml, "\n  steps: 9\n", "\n  strips: 1\n")
        # The next resume reads what the last one was given, and the report shows both.
        again = self.ok("train --resume run --set train.steps=12").err
        self.has(again, "from step 9 on: train.steps: 9 -> 12")
        self.lacks(again, "strips")
        self.has(environment.read_text(), '"started": "on 20')  # the first training's, not the resume's
        self.assertEqual(json.loads(environment.read_text())["settings_changed"],
                         ["step 5: train.steps: 5 -> 9", "step 5: report.strips: 0 -> 1",
                          "step 9: train.steps: 9 -> 12"])
        self.has((self.dir / "run/report.html").read_text(), "step 9: train.steps")
        # A run.yaml that says something else than its checkpoint, as earlier versions left them.
        file.write_text(yaml.replace("\n  rays: ", "\n  rays: 1", 1))
        refused = self.ended("train --resume run", 78).err
        remedy = re.search("semfield (train --resume run --set train.rays=[^;]*);", refused)
        self.assertIsNotNone(remedy, refused)
        self.ok(remedy[1])

    def test_moved_data_are_named_on_the_command_line(self):
        """From another working folder too, and they stay found. What is said of them: tests/bad_files/runs.cases."""
        self.room(5)
        self.ok("train config.yaml --threads 1 --out run")
        (self.dir / "elsewhere").mkdir()
        (self.dir / "room.sfpack").rename(self.dir / "elsewhere/moved.sfpack")
        for words in ("eval ../run", "train --resume ../run"):
            self.ok(f"{words} --set scene.file=moved.sfpack", self.dir / "elsewhere")
        self.ok("eval run")

    def test_equal_runs_have_one_identity(self):
        self.room(8)
        for name, more in (("a", "--threads 1"), ("b", "--threads 2 --set report.log_every_steps=3 --memory 100"),
                           ("seed", "--threads 1 --set runtime.seed=7")):
            self.ok(f"train config.yaml --out {name} {more}")
        a, b, seed = (header_of(self.dir / name / "checkpoints/step_00000008.safetensors")["__metadata__"]
                      for name in ("a", "b", "seed"))
        self.assertEqual(a["config_hash"], b["config_hash"], "whatever their threads")
        self.assertNotEqual(a["config_hash"], seed["config_hash"])
        sums = lambda of: {key: value for key, value in of.items() if key.startswith("semfield.crc32c:")}
        self.assertEqual(sums(a), sums(b))
        self.assertGreater(len(sums(a)), 8)
        self.assertNotEqual(sums(a), sums(seed))

    def test_a_resume_may_take_another_seed_or_learning_rate(self):
        """What helps a run over a step that fails may change; the remedy of such a step says so."""
        self.room(3)
        self.ok("train config.yaml --threads 1 --out run")
        self.has(self.ok("train --resume run --steps 5 --set runtime.seed=4 --set train.adam.learning_rate=0.001").err,
                 "from step 3 on: runtime.seed: 1 -> 4")
        self.ok("train --resume run --steps 6")  # and it stays so


class Screen:
    """A terminal of 80 columns as far as the program uses one: its rows at the end."""

    def __init__(self, text):
        self.rows, self.overflows, column = [""], 0, 0
        for part in re.findall(r"\x1b\[K|.", text, re.S):
            if part == "\r":
                column = 0
            elif part == "\n":
                self.rows.append("")
                column = 0
            elif part == "\x1b[K":
                self.rows[-1] = self.rows[-1][:column]
            else:
                if column == 80:  # goes on in the next row, in the middle of a word
                    self.overflows, column = self.overflows + 1, 0
                    self.rows.append("")
                row = self.rows[-1].ljust(column)
                self.rows[-1], column = row[:column] + part + row[column + 1:], column + 1

    def rows_with(self, text):
        return [row for row in self.rows if text in row]


class Terminal(ProgramCase):
    """What people see: a live line within its width, which leaves nothing behind, and notes of whole words."""

    def shown(self, words, code=0):
        """What its screen shows at the end, and everything that was written."""
        ended, text = self.on_terminal([PROGRAM, *words.split()], {"TERM": "dumb"})
        self.assertEqual(ended, code, text)
        return Screen(text), text

    def test_training_leaves_no_litter_and_notes_stand_alone(self):
        self.room(200, 60)
        screen, written = self.shown("train config.yaml --time 3s --out run --set report.log_every_steps=1 --set "
                                     "report.eval_every_s=1")
        self.assertGreater(written.count("\r\x1b[Kstep "), 3, "the line is live")
        self.has(written, " left\r\x1b[K", "miou_present")
        self.assertEqual(screen.rows_with("loss ") + screen.rows_with("elapsed"), [])
        # A note begins its row, and only what people copy runs over the edge.
        settled = screen.rows_with("the length is settled")
        self.assertTrue(len(settled) == 1 and settled[0].startswith("the length is settled: "), screen.rows)
        self.assertEqual(len(screen.rows_with("  semfield eval run")), 1)
        for words in ("eval run", "render run", "mesh run", "inspect config.yaml", "report run"):
            screen, _ = self.shown(words)
            self.assertEqual([row for row in screen.rows if re.search(r"scored |rendered |depth of [0-9]|scene: ", row)], [], words)

    def test_an_error_stands_alone_and_breaks_between_words(self):
        self.room(200, 60)
        screen, _ = self.shown("train config.yaml --set train.steppes=1 --set train.rays=many --set "
                               "runtime.device=an_accelerator_of_a_long_name", 78)
        self.assertEqual(screen.overflows, 0, screen.rows)
        self.has("\n".join(screen.rows), "--set train.steppes=1: train: unknown key 'steppes'")


if __name__ == "__main__":
    main()
