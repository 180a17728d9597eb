"""Pastes what verbs say is next: next_lines_test.py --program FILE --scenes FOLDER. Every line has to end with exit code 0, with
shorter times and coarser meshes, in the order printed, and those of `init` in the other order too; what such a command says is next as well, once."""
import argparse
import os
import re
import sys
import tempfile

sys.dont_write_bytecode = True
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from page_commands import Scratch  # noqa: E402

NEXT = re.compile(r"^(?:next {8}| {12})(semfield \S.*?)(?: +# .+)?$", re.M)
SAY_NEXT = ["init", "inspect", "train", "serve", "eval", "render", "mesh", "objects", "view"]  # `prepare`: tests/capture
SHOWN_S = 2  # that a page is served for


def next_of(said):
    return NEXT.findall(said)


class Paster:
    def __init__(self, scratch):
        self.scratch = scratch
        self.pasted, self.faults, self.telling = set(), [], set()

    def paste(self, command, backwards=False):
        """Runs the command, and then what it says is next."""
        if command in self.pasted:
            return
        self.pasted.add(command)
        verb = command.split()[1]
        short = re.sub(r"(--time )[0-9.]+[mh]\b", r"\g<1>2s", command) + {"tune": " --time 2s", "mesh": " --resolution 64"}.get(verb, "")
        code, said = self.scratch.serve(short, SHOWN_S) if verb in ("serve", "view") else self.scratch.run(short)
        if code != 0:
            self.faults.append(f"`{command}` ends with {code}:\n{said[-2000:]}")
            return
        following = next_of(said)
        if following:
            self.telling.add(verb)
        for line in reversed(following) if backwards else following:
            self.paste(line)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", required=True)
    parser.add_argument("--scenes", required=True, help="folder that page_scenes.py made")
    options = parser.parse_args()
    faults, telling, count = [], set(), 0
    # Photographs without labels, and the labelled room in both orders.
    for start, more in (("semfield inspect data/my_photos", []), ("semfield init data/room_0", ["semfield objects runs/room_0"])):
        for backwards in (False, True) if " init " in start else (False,):
            with tempfile.TemporaryDirectory(prefix="semfield_next_") as folder:
                paster = Paster(Scratch(folder, os.path.abspath(options.program), options.scenes, ()))
                for command in [start, *more]:
                    paster.paste(command, backwards)
            faults += paster.faults
            telling |= paster.telling
            count += len(paster.pasted)
    faults += [f"`semfield {verb}` says nothing that is next" for verb in SAY_NEXT if verb not in telling]
    for fault in faults:
        print(fault)
    print(f"next lines: commands={count} faults={len(faults)}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
