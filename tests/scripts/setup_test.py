#!/usr/bin/env python3
"""scripts/setup with a stand-in for CMake: one line of progress, the rest in a log."""

import shutil

from program import *

STAND_INS = {
    "dpkg-query": """[ "${!#}" = "$MISSING" ] || echo 'install ok installed'""",
    "nproc": "echo 2",
    "apt-get": "[ $1 = update ]",
    "cmake": r"""case $1 in
  --version) echo 'cmake version 3.0.0';;
  --preset) [ "$FAILS" != configure ] || { echo 'CMake Error: no presets'; exit 1; };;
  --build)
    for ((i = 1; i <= 200; ++i)); do
      echo "[$i/200] Building object_$i.o"
      [ $i != 7 ] || printf 'a.cpp:1: warning: odd\nmore of it\n'
      if [ $i = 150 ] && [ "$FAILS" = build ]; then
        printf 'FAILED: object_150.o\nc++ the whole command\nb.cpp:2: error: wrong\n    the line\n'
        echo '[151/200] Building object_151.o'
        echo 'ninja: build stopped'
        exit 1
      fi
    done;;
esac"""}


class SetupScript(ProgramCase):
    def setUp(self):
        super().setUp()
        (self.dir / "scripts").mkdir()
        for name in ("setup", "help.sh"):
            shutil.copy(SOURCE / "scripts" / name, self.dir / "scripts")
        for name, text in STAND_INS.items():
            self.write(f"bin/{name}", f"#!/usr/bin/env bash\n{text}\n").chmod(0o700)

    def printed(self, code, fails="never", **more):
        env = {**os.environ, "FAILS": fails, "PATH": f"{self.dir}/bin:{os.environ['PATH']}", **more}
        done = subprocess.run(["scripts/setup"], cwd=self.dir, env=env, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, text=True)
        self.assertEqual(done.returncode, code, done.stdout)
        return done.stdout

    def test_it_says_every_tenth_and_keeps_the_rest_in_a_log(self):
        out = self.printed(0)
        self.assertEqual(out.count("\n"), 13, out)
        self.has(out, "about 5 min", " 1 of 200\n", " 20 of 200\n", " 200 of 200\n",
                 "warnings: 1; log: build/setup.log\n")
        self.has((self.dir / "build/setup.log").read_text(), "[200/200] Building object_200.o",
                 "a.cpp:1: warning: odd\nmore of it")

    def test_it_rewrites_one_line_on_a_terminal(self):
        code, out = self.on_terminal(["scripts/setup"], {"PATH": f"{self.dir}/bin:{os.environ['PATH']}"})
        self.assertEqual((code, out.count("\n")), (0, 2), out)
        self.has(out, " 199 of 200 \r", " 200 of 200 \r")

    def test_it_shows_the_lines_that_failed_and_names_the_log(self):
        out = self.printed(1, "build")
        self.has(out, "FAILED: object_150.o\nb.cpp:2: error: wrong\n    the line\n", f"{self.dir}/build/setup.log\n")
        self.lacks(out, "the whole command")

    def test_it_shows_why_it_could_not_configure(self):
        self.has(self.printed(1, "configure"), "CMake Error: no presets\n", "3.0.0")

    def test_it_does_without_what_is_only_wished_for(self):
        wished = {"SEMFIELD_WISHED_PACKAGES": "here nowhere"}
        out = self.printed(0, MISSING="nowhere", **wished)
        self.has(out, "setup: nowhere ")
        self.lacks(out, "setup: here")
        self.printed(69, MISSING="cmake", **wished)  # needed, and the stand-in installs nothing


if __name__ == "__main__":
    main()
