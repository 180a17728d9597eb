#!/usr/bin/env python3
"""The command line's words, what verbs print as JSON, completions in their shells, the
manual page, settings' names."""

import re
import shutil

from program import *

HERE = pathlib.Path(__file__).resolve().parent


class WordsCase(ProgramCase):
    def refused(self, words, code, named):
        """Exit code 2 and this code, with `named` among the words on stderr and nothing on stdout."""
        with self.subTest(words):
            r = self.ended(words, 2, named)
            self.assertTrue(r.err.endswith(f" [{code}]\n"), r.err)
            self.assertEqual(r.out, "")

    def help_of(self, verb):
        """One line an option: sentences are wrapped."""
        return re.sub(r"\n {20,}", " ", self.semfield(f"help {verb}").out)

    def verbs(self):
        """Verbs that do something: "train", "config check"."""
        listed = lambda help: re.findall(r"\n  ([a-z-]+) ", help.partition("\nVerbs:")[2])
        tops = [(verb, listed(self.semfield(f"help {verb}").out)) for verb in listed(self.semfield("help").out)]
        return [f"{verb} {word}".strip() for verb, below in tops for word in below or [""]]


class Words(WordsCase):
    """Verbs and flags as they are typed: what is listed, what is refused, and what is suggested instead."""

    def test_without_a_verb_the_verbs_are_listed(self):
        alone = self.ended("", 2)
        self.assertEqual(alone.err, "")
        self.has(alone.out, "\n  train  ")
        self.has(self.ended("config", 2).out, "\nVerbs:\n  check  ")
        for asked in ("help", "--help", "-h", "-q help"):
            self.assertEqual(self.ok(asked).out, alone.out, asked)

    def test_help_of_a_verb_is_the_same_however_it_is_asked(self):
        for verb in ("render", "config", "config check", "help", "bench numerics"):
            help = self.ok(f"help {verb}").out
            self.assertEqual(self.ok(f"{verb} --help").out, help, verb)
            self.has(help, f"Usage: semfield {verb}")
        # Ranges, defaults and choices are stated.
        self.has(self.help_of("render"), "--frames N ", "(1 to 100000; default: 240)", "({test,train}; default: test)")
        self.has(self.ok("--help-all").out, "--frames N ", "semfield train", "semfield config check",
                 "semfield bench step")

    def test_version_says_what_the_program_is(self):
        self.assertRegex(self.ok("--version").out, r"\Asemfield .*\ncompiler .*\nplugin api .*\ncpu .*\nkernels .*\n\Z")
        self.has(self.ok("--version --json").out, '"verb":"version"', '"compiler":', '"cpu":')

    def test_a_misspelled_verb_gets_a_suggestion(self):
        for words, named in (("trian room.yaml", "`semfield train`"), ("-q trian", "`semfield train`"),
                             ("config chek", "`semfield config check`"), ("explain", "`semfield config explain`"),
                             ("help config chek", "`semfield config check`"), ("bench chek", "`semfield config check`"),
                             ("hlep train", "`semfield help`"), ("xyzzy", "`semfield help`"),
                             ("bench xyzzy", "`semfield help bench`"), ("bench pairs", "studies/leave_out.py")):
            self.refused(words, "usage.verb.unknown", named)

    def test_a_verb_that_was_renamed_names_the_new_one(self):
        (self.dir / "runs").mkdir()  # which is no scene to inspect then
        for words, named in (("capture room.yaml --out x", "`semfield pack CONFIG --format replica`"),
                             ("classes nyu13", "`semfield labels classes`"),
                             ("completion bash", "`semfield help --completion`"),
                             ("degrade room.yaml --out x", "`semfield labels degrade`"),
                             ("-q export run --out x", "`semfield labels export`"),
                             ("fuse room.yaml", "`semfield labels fuse`"),
                             ("help propagate", "`semfield labels propagate`")):
            self.refused(words, "usage.verb.unknown", named)

    def test_an_unknown_flag_gets_a_suggestion_or_the_verb_that_it_belongs_to(self):
        for words, named in (("train --thread 4 room.yaml", "--threads?"), ("eval --spilt=train run", "--split?"),
                             ("eval --video run", "`semfield render`"), ("--dry-run train room.yaml",
                                                                         "`semfield train`"),
                             ("train --xyzzy", "`semfield help train`"), ("eval --versoin run", "--version?"),
                             ("train --thr 4 room.yaml", "--threads?"),
                             ("--out x train room.yaml", "and others, and comes after the verb")):
            self.refused(words, "usage.flag.unknown", named)

    def test_words_that_are_missing_or_too_many(self):
        for words, code, named in (("eval", "word.missing", "RUN"), ("eval a b", "word.unexpected", "'b'"),
                                   ("pack room.yaml", "word.missing", "--out"),
                                   ("render run --panels", "word.missing", "--panels"),
                                   ("render run --panels rgb", "word.missing", "--video"),
                                   ("render run --npy --video", "word.missing", "--npy"),
                                   ("--plugin", "word.missing", "--plugin"),
                                   ("mesh run --format ply,gbl", "value.invalid", "did you mean glb?"),
                                   ("mesh run --format ply,,glb", "value.invalid",
                                    "an item between the commas is empty"),
                                   ("train room.yaml --steps 2.5", "value.invalid", "1 to 1000000000"),
                                   ("render run --split tset", "value.invalid", "did you mean test?"),
                                   ("help --json train", "json.none", "")):
            self.refused(words, f"usage.{code}", named)

    def test_an_operand_is_no_verb(self):
        """A run folder may be called as a verb is."""
        for words in ("eval config", "--json eval mesh", "eval --split test render", "eval -- help"):
            self.ended(words, 66, "there is no run folder '")
        # A list takes one word, and leaves the next to the operand; so does a flag that may be given several times.
        self.ended("mesh --format ply,glb run", 66)
        self.ended("eval --set runtime.threads=2 --set train.rays=64 run", 66)
        self.ended("--plugin none.so eval run", 69, "none.so")

    def test_whole_numbers_are_decimal(self):
        for steps in ("08", "+8"):
            self.ended(f"train none.yaml --steps {steps}", 66)

    def test_numbers_outside_their_ranges_are_refused(self):
        """Of every option with a range, as its own help states it."""
        verbs, options = self.verbs(), 0
        self.assertGreaterEqual(len(verbs), 30)
        for verb in verbs:
            for flag, bounds in re.findall(r"\n *(--[a-z-]+) (?:N|X|GB|PX) [^\n]*\((more than 0|\S+ to [0-9.e+]+)[;)]",
                                           self.help_of(verb)):
                options += 1
                for value in ("-7", "nan", "inf", "x", "1e400", *(["0"] if bounds == "more than 0" else [])):
                    self.refused(f"{verb} {flag}={value}", "usage.value.invalid", flag)
                self.refused(f"{verb} {flag}=''", "usage.word.missing", flag)
        self.assertGreaterEqual(options, 14)


# Everything that takes --json, in an order in which a run is there when it is needed: words behind the verb, and keys
# besides `semfield` and `verb`.
CASES = {
    "config check": ("config.yaml", "config errors"),
    "config explain": ("config.yaml", "settings"),
    "inspect": ("config.yaml", "scene frames bounds classes findings"),
    "init": ("room.sfpack --out init.yaml", "file type others downscale"),
    "train": ("config.yaml --steps 200 --out run", "run step train_s values report"),
    "config diff": ("config.yaml run/run.yaml", "differences"),
    "eval": ("run", "run split step miou_present per_class_iou confusion per_frame"),
    "render": ("run --out images", "run step frames s_per_frame width_px height_px folder"),
    "report": ("run", "runs file"),
    "sweep": ("sweep.yaml --dry-run --out swept", "folder planned"),
    "tune": ("config.yaml --steps 200 --dry-run --out tuned", "folder cells time_s"),
    "mesh": ("run --resolution 24", "run vertices faces files"),
    "pack": ("config.yaml --out again.sfpack", "frames bytes file"),
    "labels degrade": ("config.yaml --out degraded", "frames labelled_px accuracy folder"),
    "labels fuse": ("config.yaml --method bayesian", "scores"),
    "labels propagate": ("run --out spread", "method labelled_share accuracy folder"),
    "labels export": ("run --out labels.json", "run frames shapes format out"),
    "labels classes": ("nyu13", "classes"),
    "plugins list": ("", "plugins"),
    "plugins show": ("hash_grid", "plugins"),
    "bench numerics": ("--only A01", "passed failed cases rows"),
}
# These measure for long, or need a device, the shipped room, a module or COLMAP; serve is tried below, prepare by
# tests/capture, objects by tests/objects.
ELSEWHERE = {"bench gpu", "bench step", "serve", "demo", "plugins check", "prepare", "objects", "view"}


class Examples(WordsCase):
    """The examples that begin the help of every verb."""

    def test_every_help_begins_with_two_and_they_run(self):
        # What they name is there: photographs, a configuration, two runs and a sweep, all small.
        write_room(self.dir / "data/my_photos", 8)
        self.write("configs/my_photos.yaml", "name: my_photos\n" + CONFIG.replace("ROOM", ROOM.replace("root: ", "root: ../data/"))
                   .replace("root: ../data/room", "root: ../data/my_photos").replace("steps: 200", "steps: 40") +
                   "report: {eval_every_s: 0, strips: 0}\n")
        self.ok("train configs/my_photos.yaml --no-3d")
        shutil.copytree(self.dir / "runs/my_photos", self.dir / "runs/my_clicks")
        self.write("my_sweep.yaml", "name: tried\nbase: configs/my_photos.yaml\ngrid: {train.rays: [64, 128]}\n")
        short = [(r"--time \S+", "--steps 20"), ("^train configs/my_photos.yaml", r"\g<0> --out runs/second"),
                 ("^init .*", r"\g<0> --replace"), ("smooth", "smooth --frames 9"),
                 (r"^tune \S+ --steps 20", r"\g<0> --dry-run")]  # tests/sweep runs one
        for verb in self.verbs():
            with self.subTest(verb):
                for words in re.match(r"  semfield (.*)\n  semfield (.*)\n\n", self.ok(f"help {verb}").out).groups():
                    self.assertEqual(words.split()[:len(verb.split())], verb.split())
                    for long, brief in short:
                        words = re.sub(long, brief, words)
                    if verb not in ELSEWHERE - {"bench step"}:
                        self.ok(words)
                    elif verb != "demo":  # without what it needs: but its words are right
                        self.assertNotIn(self.semfield(words, self.folder()).code, (0, 2), words)


class OnATerminal(WordsCase):
    """Of 80 columns, with and without colours."""

    def test_what_people_read_fits_and_says_how_to_go_on(self):
        write_room(self.dir / "room", 8)
        self.write("config.yaml", CONFIG.replace("ROOM", ROOM) + "report: {eval_every_s: 0, strips: 0}\n")
        said = {}
        for words in ("inspect config.yaml", "train config.yaml --dry-run", "train config.yaml --out run --no-3d",
                      "eval run", "mesh run --resolution 24"):
            code, said[words] = self.on_terminal([PROGRAM, *words.split()], {"TERM": "xterm"})
            self.assertEqual(code, 0, said[words])
            plain = re.sub(r"\x1b\[[0-9;]*[mK]", "", said[words])
            for line in plain.replace("\r\n", "\n").split("\n"):
                self.assertLessEqual(len(line.rsplit("\r", 1)[-1]), 80, line)
        self.has(" ".join(said["train config.yaml --out run --no-3d"].split()), "Trained 200 steps in ",
                 "Held-out views match", "% of their labels are right", "Look at run/report.html first.",
                 "\x1b[1mnext\x1b[0m")
        self.has(said["eval run"], " dB", " m\r\n")
        self.lacks(said["train config.yaml --dry-run"], "left out")
        for more in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
            self.lacks(self.on_terminal([PROGRAM, "eval", "run"], {"TERM": "xterm", **more})[1], "\x1b[1m", "\x1b[2m")


class JsonOutput(WordsCase):
    """--json of every verb: one object with the keys that all have, or a refusal."""

    def setUp(self):
        super().setUp()
        write_room(self.dir / "room", 8)
        self.write("files.yaml", CONFIG.replace("ROOM", ROOM))
        self.ok("pack files.yaml --out room.sfpack")
        self.write("config.yaml", CONFIG.replace("ROOM", "{type: packed, file: room.sfpack}") +
                   "report: {eval_every_s: 0, strips: 0}\n")
        self.write("sweep.yaml", "name: tried\nbase: config.yaml\ngrid: {train.rays: [64, 128]}\n")

    def test_every_verb_prints_one_object_or_refuses(self):
        version = json.loads(self.ok("--version --json").out)["semfield"]
        for verb, (words, keys) in CASES.items():
            with self.subTest(verb):
                r = self.ok(f"{verb} {words} --json -q")
                self.assertEqual(r.out.index("\n"), len(r.out) - 1)
                self.assertTrue(r.out.startswith(f'{{"semfield":"{version}","verb":"{verb}"'), r.out[:80])
                self.assertEqual(set(keys.split()) - set(json.loads(r.out)), set())
        refusals = 0
        for verb in self.verbs():
            if verb in CASES or verb in ELSEWHERE:
                continue
            # What its operands are does not matter: it is refused before they are read.
            help = self.semfield(f"help {verb}").out
            self.lacks(help, "--json")  # else a case is missing here
            operands = [word for operand, word in ((" CONFIG", " x"), (" RUN", " x"))
                        if operand in help.partition("Usage:")[2]]
            self.refused(f"{verb}{''.join(operands)} --json", "usage.json.none", verb)
            refusals += 1
        self.assertGreaterEqual(refusals, 1)

    def test_what_was_packed_is_told(self):
        written = json.loads(self.ok("pack config.yaml --format replica --out captured --json -q").out)
        self.assertEqual(set(written) - {"semfield", "verb"}, {"frames", "bytes", "folder"})
        self.assertEqual(self.ended("eval nowhere --json", 66).out, "")

    def test_init_calls_its_file_as_the_folder_is_called(self):
        (self.dir / "my_photos").symlink_to("room")
        self.ok("init my_photos")
        self.assertTrue((self.dir / "configs/my_photos.yaml").exists())

    def test_serve_tells_its_address(self):
        serve = self.start("serve", self.dir / "config.yaml", "--json", "-q", "--out", self.dir / "labelled")
        until(lambda: "\n" in serve.out_file.read_text() or serve.process.poll() is not None)
        if serve.process.poll() is not None:
            self.skipTest("this build has no labelling page")
        said = json.loads(serve.out_file.read_text())
        self.assertEqual(said["verb"], "serve")
        self.assertTrue(said["url"].startswith("http://127.0.0.1:"), said)
        serve.send(signal.SIGINT)
        self.assertEqual(serve.wait().code, 130)

    def test_the_page_names_every_verb_that_takes_it(self):
        rows = {verb: row for row in (SOURCE / "docs/reference/json.md").read_text().splitlines()
                if row.startswith("| `") for verb in row.split("|")[1].split("`")[1::2]}
        for verb, (_, keys) in CASES.items():
            self.has(rows[verb], *(f"`{key}`" for key in keys.split()))
        self.assertEqual(ELSEWHERE - set(rows), set())


# As readline cuts words: at blanks and at '='.
TRY_BASH = """source "$1"
read -ra COMP_WORDS <<<"${2//=/ = }"
[[ $2 != *' ' ]] || COMP_WORDS+=('')
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_semfield 2>/dev/null
printf '%s\\n' "${COMPREPLY[@]}"
"""
# What is offered where a line behind "semfield " ends.
OFFERED = {
    "tr": "train", "config ": "check diff explain", "-q config ch": "check", "help conf": "config",
    "--plugin x.so config ch": "check",
    "eval --sp": "--split", "train room.yaml --dr": "--dry-run", "bench step --si": "--size",
    "eval --vid": "", "help --compl": "--completion",
    "--pl": "--plugin", "eval --js": "--json", "help --js": "",  # --json where there is one
    "eval runs --split ": "test train", "eval runs --split te": "test", "eval runs --split=te": "test",
    "train --device c": "cpu cuda", "labels export runs --format co": "coco coco_rle", "mesh runs --format g": "glb",
    "mesh runs --format ply,g": "glb", "labels exp": "export", "render runs --trajectory sm": "smooth",
}
# Where the program offers nothing, a shell offers files; bash does so outside of the function that is tried.
FILES = {"train ": "room.yaml runs", "config check roo": "room.yaml", "eval r": "room.yaml runs", "train --out ru": "runs"}


class Completion(ProgramCase):
    """A shell with the program's script, in a folder that has a file room.yaml and a folder runs."""

    def offered(self, shell, line):
        """Without what stands before "=" and the last comma."""
        tool = HERE / "zsh_candidates.zsh" if shell == "zsh" else self.dir / "try.bash"
        said = subprocess.run([shell, "--norc" if shell == "bash" else "-f", tool, self.dir / "script", line],
                              timeout=60,
                              cwd=self.dir / "work", capture_output=True, text=True, stdin=subprocess.DEVNULL,
                              env={**os.environ, "HOME": str(self.dir),
                                   "PATH": f"{pathlib.Path(PROGRAM).parent}:{os.environ['PATH']}"})
        words = [word.split(",")[-1] for word in (said.stdout + said.stderr).splitlines()]
        words = [word.partition("=")[2] if word.startswith("--") and "=" in word else word for word in words]
        return {word.removesuffix("/") for word in words} - {""}

    def test_offers_verbs_flags_choices_and_files(self):
        self.write("work/room.yaml", "")
        (self.dir / "work/runs").mkdir()
        self.write("try.bash", TRY_BASH)
        for shell in ("bash", "zsh"):
            self.write("script", self.ok("help --completion").out)
            with self.subTest(shell):
                if shutil.which(shell) is None:
                    self.skipTest(f"{shell} is not installed: its script was not tried")
                verbs = self.offered(shell, "semfield ")
                self.assertEqual({"train", "config", "bench", "labels", "help"} - verbs, set())
                self.assertNotIn("check", verbs)
                for line, words in {**OFFERED, **(FILES if shell == "zsh" else dict.fromkeys(FILES, ""))}.items():
                    self.assertEqual(self.offered(shell, "semfield " + line), set(words.split()), line)

    def test_the_manual_page_has_no_warnings(self):
        made = subprocess.run([SOURCE / "packaging/manual_page", PROGRAM, "2.0.0"], capture_output=True, text=True,
                              check=True)
        page = self.write("semfield.1", made.stdout)
        self.has(made.stdout, r"\-\-frames N")
        if shutil.which("man") is None:
            self.skipTest("man is not installed: no page was formatted by it")
        read = subprocess.run(["man", "-l", "--warnings", page], capture_output=True, text=True)
        self.assertEqual(read.stderr, "")
        self.has(read.stdout, "--frames N")


class Names(ProgramCase):
    """Names of settings: what the program prints is what --set takes."""

    def explained(self, name, sets=()):
        words = [word for one in sets for word in ("--set", one)]
        return json.loads(self.ok(["config", "explain", "--json", SOURCE / "configs" / name, *words]).out)["settings"]

    def test_every_key_that_explain_prints_can_be_set_back(self):
        for name in ("quickstart.yaml", "paper.yaml"):
            before = self.explained(name)
            keys = [setting["key"] for setting in before]
            self.assertGreater(len(before), 100)
            self.assertGreater(sum(key.startswith(("passes.main.", "passes.coarse.")) for key in keys), 5)
            self.assertEqual([key for key in keys if re.match(r"passes\.[0-9]", key)], [])
            after = self.explained(name, [f"{setting['key']}={setting['value']}" for setting in before])
            self.assertEqual(*([(one["key"], one["value"]) for one in settings] for settings in (after, before)))
            for one in after:
                self.assertTrue(one["from"].startswith(f"--set {one['key']}"), one)

    def test_differences_set_the_one_as_the_other(self):
        quickstart, train = "quickstart.yaml", "train.rays=500"
        sets = ("passes.main.position.levels=12", "passes.main.semantic.few.dropout=0.3", train,
                "passes.main.sampler.max_samples=32")
        by_index = ("passes.0.position.levels=12", "passes.0.semantic.1.dropout=0.3", train,
                    "passes.0.sampler.max_samples=32")
        plain = lambda settings: [(one["key"], one["value"]) for one in settings]
        before, after = plain(self.explained(quickstart)), plain(self.explained(quickstart, sets))
        self.assertEqual(plain(self.explained(quickstart, by_index)), after)
        self.assertEqual(sum(a != b for a, b in zip(before, after)), 4)
        self.write("b.yaml", f"include: {SOURCE}/configs/{quickstart}\nname: quickstart\ntrain: {{rays: 500}}\n")
        said = json.loads(self.ok(["config", "diff", "--json", SOURCE / "configs" / quickstart,
                                   "b.yaml"]).out)["differences"]
        self.assertEqual([f"{d['key']}={d['b']}" for d in said if d["key"] != "base_dir"], [train])
        text = self.ok(["config", "explain", SOURCE / "configs" / quickstart, "--set", train]).out
        self.has(text, "# train.ray_source is auto: where a step's rays come from", "# runtime.precision is auto: ")
        self.lacks(text, "runtime.memory_gb is auto")

    def test_keys_of_notes_can_be_set(self):
        """What was chosen and left out, and why, with the key that changes it."""
        preset = shlex.quote(str(SOURCE / "configs/quickstart.yaml"))
        r = self.ok(f"train --dry-run {preset} --set scene.frames=20 --set scene.width_px=64 --set scene.height_px=48")
        keys = set(re.findall(r"passes\.[A-Za-z0-9_.]*[a-z0-9_]", r.out + r.err))
        self.assertGreaterEqual(len(keys), 2)
        for key in keys:  # the place is there: what is wrong is the key below it
            self.ended(f"config check {preset} --set {key}.nonsense=1", 78, "unknown key 'nonsense'")

    def test_a_wrong_name_is_told_with_those_that_there_are(self):
        self.ended(f"config check {shlex.quote(f'{SOURCE}/configs/paper.yaml')} --set passes.corse.field.depth=4", 78,
                   "(coarse, fine)", "(0 to 1)", "'corse'; did you mean 'coarse'?")


if __name__ == "__main__":
    main()
