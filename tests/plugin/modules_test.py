#!/usr/bin/env python3
"""Which modules the program runs code of: none that does not fit, and none that only a configuration names. SEMFIELD_PROBES:
the folder of the modules."""

import shutil

from program import *

MACHINE, CLASS, TYPE = 18, 4, 16  # bytes of an ELF header
AARCH64, X86_64, CLASS_32, EXECUTABLE = 183, 62, 1, 2


def probe(name):
    return f"{os.environ['SEMFIELD_PROBES']}/probe_{name}.so"


class ModuleCase(ProgramCase):
    def setUp(self):
        super().setUp()
        write_room(self.dir / "room")
        self.base = self.write("base.yaml", f"include: {SOURCE}/configs/experiments/editions/hash_field.yaml\n"
                               f"scene: {ROOM}\ntrain: {{steps: 3, rays: 64}}\n")


class ModuleTrust(ModuleCase):
    def setUp(self):
        super().setUp()
        self.named = self.write("named.yaml", self.base.read_text() + "plugins: [shared/probe_sound.so]\n")
        (self.dir / "shared").mkdir()
        self.module = pathlib.Path(shutil.copy(probe("sound"), self.dir / "shared"))

    def run_words(self, *words, trusted=""):
        """The program's Result; `ran` says whether code of a probe ran."""
        trace = self.dir / "trace"
        trace.unlink(missing_ok=True)
        result = self.semfield(words, env={"SEMFIELD_PROBE_FILE": str(trace), "SEMFIELD_PLUGIN_PATH": str(trusted)})
        self.ran = trace.exists()
        return result

    def refused(self, module, why):
        self.ended(self.run_words("plugins", "list", "--plugin", module), 69, f"cannot load plugin '{module}': ", why)
        self.assertFalse(self.ran, f"{module}: its static initialiser ran")

    def test_no_initialiser_of_a_refused_module_runs(self):
        self.ok(self.run_words("plugins", "list", "--plugin", probe("sound")))
        self.assertTrue(self.ran, "the probe tells nothing")
        for name, why in (("no_stamp", "it has no section '.semfield_plugin', so it is not a plugin"),
                          ("other_stamp", "its section '.semfield_plugin' holds something else"),
                          ("other_api", "the module speaks plugin API 999, this framework speaks "),
                          ("other_abi", "the module was built with ABI 'cxx0-another-library', this framework with '")):
            self.refused(probe(name), why)

    def test_modules_cut_short_or_of_another_processor_are_refused_unrun(self):
        whole, file = pathlib.Path(probe("sound")).read_bytes(), self.dir / "broken.so"
        for size in (20, 64, len(whole) // 4, len(whole) // 2, len(whole) - 4096, len(whole) - 1):
            file.write_bytes(whole[:size])
            self.refused(file, f"the file is cut short: it ends at byte {size}")
        other = AARCH64 if whole[MACHINE] == X86_64 else X86_64
        for at, value, why in ((MACHINE, other, "it was built for another CPU"), (CLASS, CLASS_32,
                                                                                  "it was built for another CPU"),
                               (TYPE, EXECUTABLE, "it is not a shared library")):
            file.write_bytes(whole[:at] + bytes([value]) + whole[at + 1:])
            self.refused(file, why)
        for text in ("", "plain text"):
            file.write_text(text)
            self.refused(file, "it is not a shared library; check that it is the right file")

    def test_a_throwing_initialiser_ends_in_order(self):
        self.ended(self.run_words("plugins", "list", "--plugin", probe("throwing")), 69,
                   f"cannot load plugin '{probe('throwing')}': a static initialiser of it throws: no licence found; "
                   "fix the module, or leave it out [plugin.module.throws]\n")

    def test_a_configuration_alone_runs_no_code(self):
        sweep = self.write("sweep.yaml", "base: named.yaml\nvariants: {v: }\n")
        for verb in (("config", "check", self.named), ("config", "explain", self.named), ("config", "diff", self.named,
                                                                                          self.named),
                     ("inspect", self.named), ("labels", "fuse", self.named), ("pack", self.named, "--out",
                                                                     self.dir / "p.sfpack"),
                     ("pack", self.named, "--format", "replica", "--out", self.dir / "captured"), ("sweep", sweep, "--dry-run"),
                     ("labels", "degrade", self.named, "--out", self.dir / "degraded"), ("train", self.named, "--dry-run")):
            self.ended(self.run_words(*verb), 78,
                       f"named.yaml:4:11: the module '{self.module}' was not loaded: it is code",
                       f"add --plugin {self.module} (in Python: ", ", or set SEMFIELD_PLUGIN_PATH")
            self.assertFalse(self.ran, f"{verb[0]} ran code that a configuration names")
        # Both remedies, as written; and a module of that name which lies elsewhere.
        (self.dir / "mine").mkdir()
        for file in (self.module, shutil.copy(self.module, self.dir / "mine")):
            self.ok(self.run_words("config", "check", self.named, "--plugin", file))
            self.assertTrue(self.ran)
        for trusted in (self.dir / "shared", f"{self.dir}/none:{self.dir}/shared/", self.dir / "mine"):
            self.ok(self.run_words("config", "diff", self.named, self.named, trusted=trusted))
            self.assertTrue(self.ran, trusted)
        # A folder above the module's is not one that holds it.
        for not_trusted in (self.dir, "/", self.dir / "sha", f"{self.dir}/mine/..x"):
            self.ended(self.run_words("config", "check", self.named, trusted=not_trusted), 78)
            self.assertFalse(self.ran)
        self.ended(self.run_words("config", "check", self.named, trusted="shared"), 78,
                   "SEMFIELD_PLUGIN_PATH: 'shared' is not an absolute path")

    def test_a_run_trained_with_a_module_records_it_and_asks_for_it_again(self):
        run, module = self.dir / "run", probe("sound")
        self.ok(self.run_words("train", self.base, "--out", run, "--plugin", module))
        self.has((run / "run.yaml").read_text(), "probe_sound.so")
        for verb in (("eval", run), ("render", run), ("labels", "export", run, "--out", self.dir / "labels.json"),
                     ("train", "--resume", run)):
            self.ended(self.run_words(*verb), 78, f"add --plugin {module}")
            self.assertFalse(self.ran, f"{verb[0]} ran code that a run folder names")
            self.ok(self.run_words(*verb, "--plugin", self.module))

    def test_a_sweep_hands_its_modules_to_its_cells(self):
        sweep = self.write("sweep.yaml", "base: named.yaml\nmetrics: [psnr]\nvariants: {v: }\n")
        self.has(self.ok(self.run_words("sweep", sweep, "--plugin", self.module, "--out", self.dir / "out")).out,
                 "cells=1 done=1 failed=0")


class PluginsCheck(ModuleCase):
    """`semfield plugins check`."""

    def run_words(self, *words, **env):
        return self.semfield(words, env=env)

    def test_laws_that_hold_are_told_a_line_each(self):
        rows = self.write("rows.txt", "# as conformance.txt\ndefaults\nbands=3 gain=0.5\n")
        r = self.ok(self.run_words("plugins", "check", probe("sound"), "--settings", rows))
        self.has(r.out, "declaration", "defaults, positions", "defaults, directions", "bands=3 gain=0.5, positions",
                 f"plugins check: passed=5 failed=0 refused=0 file={probe('sound')}\n")
        self.lacks(r.out, "FAILED")

    def test_a_broken_law_is_told_with_plugin_build_and_cause(self):
        said = json.loads(self.ended(self.run_words("plugins", "check", probe("bent"), "--json"), 1).out)
        self.assertEqual([said[key] for key in ("verb", "passed", "failed")], ["plugins check", 1, 2])
        self.assertEqual([row["status"] for row in said["rows"]], ["passed", "FAILED", "FAILED"])
        self.assertEqual([said["rows"][1][key] for key in ("kind", "name", "build")], ["encoder", "bent", "positions"])
        self.has(said["rows"][1]["found"][0], "gradient")

    def test_a_plugin_that_ends_the_process_breaks_the_law_under_way(self):
        """An exit code of 0 is no law that holds."""
        r = self.ended(self.run_words("plugins", "check", probe("quitting")), 1)
        fault = "it ended the process with exit code 0 in the law 'what is written'"
        self.assertRegex(r.out, f"quitting +defaults, positions +FAILED\n    {fault}\n")
        self.has(r.out, "plugins check: passed=1 failed=1 refused=0 ")
        self.ended(self.run_words("plugins", "check", probe("quitting"), SEMFIELD_PROBE_QUITS="1"), 69,
                   f"cannot load plugin '{probe('quitting')}': it ended the process with exit code 0")

    def test_words_that_fit_nothing_are_refused_before_a_law_runs(self):
        sound = probe("sound")
        rows = {name: self.write(name, text) for name, text in (
            ("a", "\nbands\n"), ("b", "bandz=2\n"), ("c", "defaults\nbands=99\n"))}
        for words, code, said in (
                ((self.dir / "none.so",), 69, "there is no such file"),
                ((self.dir,), 69, "there is no such file"),
                ((probe("other_api"),), 69, "plugin API 999"),
                ((sound, "--settings", self.dir / "none.txt"), 66, "none.txt"),
                ((sound, "--settings", rows["a"]), 78,
                 f"{rows['a']}:2: 'bands' sets nothing; write name=value name=value"),
                ((sound, "--settings", rows["b"]), 78,
                 f"{rows['b']}:1: no plugin has the parameters of 'bandz=2'; known: "),
                ((sound, "--settings", rows["c"]), 78, f"{rows['c']}:2: toy: bands: expected int in [1, 8]"),
                ((sound, "--scene", "root=x"), 2, "--scene is for datasets, and the file registers none"),
                ((sound, "--scene", "root"), 2, "--scene root: expected NAME=VALUE")):
            self.assertEqual(self.ended(self.run_words("plugins", "check", *words), code, said).out, "")


if __name__ == "__main__":
    main()
