"""scripts/setup with a stand-in for CMake: one line of progress, the rest in a log. setup_test.py SCRIPTS_FOLDER"""
import os
import pathlib
import pty
import shutil
import subprocess
import sys
import tempfile

STAND_INS = {
    "dpkg-query": "[ \"${!#}\" = \"$MISSING\" ] || echo 'install ok installed'",
    "nproc": "echo 2",
    "apt-get": "[ $1 = update ]",
    "cmake": r"""
      case $1 in
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
      esac""",
}

with tempfile.TemporaryDirectory() as folder:
    root = pathlib.Path(folder)
    (root / "scripts").mkdir()
    (root / "bin").mkdir()
    for name in ("setup", "help.sh"):
        shutil.copy(pathlib.Path(sys.argv[1]) / name, root / "scripts")
    for name, text in STAND_INS.items():
        (root / "bin" / name).write_text(f"#!/usr/bin/env bash\n{text}\n")
        (root / "bin" / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{root / 'bin'}:{os.environ['PATH']}"}

    def run(fails, code, *says, silent="", **more):
        """What it prints, with the parts that it must have and the one that it must not."""
        done = subprocess.run([root / "scripts/setup"], cwd=root, env={**environment, "FAILS": fails, **more}, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, text=True, encoding="utf-8")
        assert done.returncode == code, (fails, done.returncode, done.stdout)
        for part in says:
            assert part in done.stdout, (part, done.stdout)
        assert not silent or silent not in done.stdout, done.stdout
        return done.stdout

    # Every tenth, and the rest in a log.
    said = run("never", 0, "about 5 min", " 1 of 200\n", " 20 of 200\n", " 200 of 200\n", "warnings: 1; log: build/setup.log\n")
    assert said.count("\n") == 13, said
    log = (root / "build/setup.log").read_text()
    assert "[200/200] Building object_200.o" in log and "a.cpp:1: warning: odd\nmore of it" in log, log

    # One line on a terminal, rewritten.
    terminal, end = pty.openpty()
    with subprocess.Popen([root / "scripts/setup"], cwd=root, env={**environment, "FAILS": "never"}, stdin=end, stdout=end, stderr=end) as setup:
        os.close(end)
        said = b""
        try:
            while part := os.read(terminal, 4096):
                said += part
        except OSError:  # the other end is closed
            pass
    assert setup.returncode == 0 and said.count(b"\n") == 2, said
    assert b" 199 of 200 \r" in said and b" 200 of 200 \r" in said, said

    run("build", 1, "FAILED: object_150.o\nb.cpp:2: error: wrong\n    the line\n", f"{root / 'build/setup.log'}\n", silent="the whole command")
    run("configure", 1, "CMake Error: no presets\n", "3.0.0")
    wished = {"SEMFIELD_WISHED_PACKAGES": "here nowhere"}
    run("never", 0, "setup: nowhere ", silent="setup: here", MISSING="nowhere", **wished)
    run("never", 69, MISSING="cmake", **wished)  # needed, and the stand-in installs nothing
