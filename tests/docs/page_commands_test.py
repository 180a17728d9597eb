"""page_commands.py on small pages: what it runs, in which order, and that each mistake of a page is named. Argument: the folder of sources."""
import os
import stat
import subprocess
import sys
import tempfile

SOURCE = sys.argv[1]
# Stands for the program: writes down what it is called with, and fails on request.
PROGRAM = """#!/bin/sh
echo "$*" >> said
[ "$1" != serve ] || { trap 'exit 130' INT; echo 'serve: open http://127.0.0.1/'; while :; do sleep 0.05; done; }
[ "$1" != fail ]
"""
SH = "```sh\n{}\n```\n"


def play(page):
    """Exit code and what is printed."""
    with tempfile.TemporaryDirectory(prefix="page of ") as folder:
        program, scenes, path = (os.path.join(folder, name) for name in ("semfield", "scenes", "page.md"))
        os.mkdir(scenes)
        for name, text in ((program, PROGRAM), (path, page)):
            with open(name, "w", encoding="utf-8") as file:
                file.write(text)
        os.chmod(program, stat.S_IRWXU)
        done = subprocess.run([sys.executable, os.path.join(SOURCE, "tests/docs/page_commands.py"), "--program", program, "--scenes", scenes, path],
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        return done.returncode, done.stdout


def expect(page, code, sentence):
    got, said = play(page)
    if got != code or sentence not in said:
        sys.exit(f"expected {code} and '{sentence}', got {got}:\n{said}\nof the page\n{page}")


# What is right: order, comments, lines that go on, files of the page, replacements, serving, exit codes, blocks that are not run.
expect(SH.format("semfield one  # first\nsemfield two \\\n  three") + SH.format("printf 'one\\ntwo three\\n' | cmp - said"), 0, "commands=3 faults=0")
expect("<!-- run:\nfirst semfield zero\n--time 5m => --time 1s\n-->\n" + SH.format("semfield one --time 5m") + SH.format("printf 'zero\\none --time 1s\\n' | cmp - said"), 0, "commands=3 faults=0")
expect(SH.format("semfield one --time 10m") + SH.format("printf 'one --time 2s\\n' | cmp - said"), 0, "commands=2 faults=0")
expect("```yaml file=configs/a.yaml\na: 1\n```\n" + SH.format("grep -q 'a: 1' configs/a.yaml\ngrep -q 'steps: 60' configs/presets/room.yaml\ntest -f configs/my_photos.yaml"), 0, "commands=3")
expect(SH.format("semfield serve x\nsemfield after"), 0, "commands=2 faults=0")
expect("<!-- run: exit 1 -->\n" + SH.format("semfield fail"), 0, "commands=1 faults=0")
expect("<!-- not run: takes hours -->\n" + SH.format("semfield fail"), 0, "commands=0 faults=0")
expect("```console\n$ semfield one\nwhat it prints\n```\n" + SH.format("echo one | cmp - said"), 0, "commands=2 faults=0")
expect("<!-- run: needs no_such_program_at_all -->\n" + SH.format("semfield one"), 69, "NOT RUN for want of no_such_program_at_all")

# What is wrong.
expect(SH.format("semfield fail"), 1, "`semfield fail` ends with 1, not 0")
expect("<!-- run: exit 1 -->\n" + SH.format("semfield one"), 1, "ends with 0, not 1")
expect(SH.format("no_such_program_at_all"), 1, "ends with 127, not 0")
expect("```text\nsemfield one\n```\n", 1, "is in a block marked 'text'")
expect("```\n$ ./scripts/demo now\n```\n", 1, "is in a block marked ''")
expect("<!-- run: --long => --short -->\n" + SH.format("semfield one"), 1, "the block does not have '--long'")
expect("<!-- run: quickly -->\n" + SH.format("semfield one"), 1, "'quickly' of a comment before a block means nothing")
expect("<!-- not run: -->\n" + SH.format("semfield fail"), 1, "`semfield fail` ends with 1")  # no reason given
print("17 pages")
