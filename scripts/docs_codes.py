"""The page of all codes of errors and findings, from the sources."""
import os
import re

FOLDERS = ("app", "framework", "plugins", "python", "bench", "tests/numerics")
EXIT_CODES = {"failure": 1, "usage": 2, "data": 65, "no_input": 66, "unavailable": 69, "internal": 70, "cannot_create": 73,
              "io": 74, "config": 78}
IN_A_LIST = "in a list"
LONGEST_SENTENCE = 120
# Where one of many places would say too little.
SENTENCES = {
    "checkpoint.file.damaged": "bytes are too few for a header",
    "config.value.choice": "expected one of …, got '…'",
    "config.value.range": "expected a number in […, …], got …",
    "config.value.type": "expected a number, got '…'",
    "device.field.slow": "fp32 runs layer by layer on a GPU, 3 to 15 times slower than bf16",
    "export.process.failed": "the last words of the process",
    "files.path.unusable": "'…': Permission denied",
    "files.zip.damaged": "not a zip archive: its end is missing",
    "internal.check.failed": "….cpp:…: … (violated: …)",
    "internal.view.shape": "is …, expected …",
    "objects.edit.invalid": "an object is a number from 1 on",
    "objects.found.unreadable": "'…' has no … numbers of …",
    "plugin.module.unloadable": "cannot load plugin '…': undefined symbol: …",
    "plugin.python.raised": "…: ValueError: … (plugin.py:12)",
    "ranks.process.lost": "MPI failed while …: …",
    "render.cameras.entry": "is not an object of keys and values",
    "render.cameras.format": "not valid JSON: …",
    "render.video.failed": "… (exit code …)",
    "run.metrics.damaged": "not a JSON object",
    "scene.bounds.missed": "none of the rays of the training cameras can meet the bounds …",
    "scene.colmap.format": "'…' is not a number",
    "scene.image.turned": "colour image '…' is … pixels, the camera …: one is turned by a quarter against the other",
    "scene.pose.convention": "poses have OpenGL axes (y up, z backward) where OpenCV axes are expected: …",
    "system.library.missing": "…: cannot open shared object file",
    "train.steps.chosen": "… steps, chosen from …",
    "usage.value.invalid": "--threads many: expected a whole number",
}
HEAD = """# Codes

Every error and every finding has a code after its sentence, at the end of the line:

```text
semfield: room.yaml:7:11: train: unknown key 'rayss'; did you mean 'rays'? [config.key.unknown]
```

Sentences may change from version to version; a code stays with its cause, and a change is in the [changelog](../../CHANGELOG.md). Search pages and sources for it. Programs read it
as `code`: in the findings of `semfield inspect --json` ([json](json.md)), in the answers of the labelling page ([HTTP](labelling_http.md)), and in the exceptions of the
[Python package](../guide/python.md#errors).

The second column is the [exit code](command_line.md#exit-codes) of an error that ends the program. *In a list* are findings, all of which one pass over an input reports at once:
the program ends with 65 where the data are wrong and with 78 where the configuration is. Warnings and notes end nothing. The third column is what one of the places says that
use the code, with … for values.
"""
CODE = re.compile(r'"([a-z0-9_]+(?:\.[a-z0-9_]+){1,3})"')
# What is before a code: the kind of an error, the name of a function that takes a code first, a variable.
BEFORE = re.compile(r"(?:ErrorKind::(?P<kind>\w+),|kind\(\),|\b(?P<call>refuse\w*|fail|report|error|warning|note|error_json)\(|"
                    r"\b(?:value_or|Code)\(|code ?= ?|code: str =|OtherSize out\{|\breturn|\belse)\s*$")
# A function that takes a code and throws an error of one kind.
WRAPPER = re.compile(r"\b(\w+)(?: = \[&\])?\(Code code,[^;]*?\{\s+(?:throw|return) Error\(ErrorKind::(\w+), code,", re.S)
LITERAL = r'"(?:[^"\\\n]|\\.)*"'
CPP = re.compile(rf'//[^\n]*|R"(\w*)\(.*?\)\1"|(?P<text>{LITERAL})|(?<!\w)\'(?:[^\'\\]|\\.)+\'', re.S)
PYTHON = re.compile(rf'#[^\n]*|""".*?"""|(?P<text>{LITERAL})|\'(?:[^\'\\\n]|\\.)*\'', re.S)


class Source:
    """A file: its text, the same without comments and insides of literals, and the places of the literals."""

    def __init__(self, text, python):
        self.text, self.python = text, python
        tokens = list((PYTHON if python else CPP).finditer(text))
        self.literals = [token.span() for token in tokens if token["text"]]
        self.blank = (PYTHON if python else CPP).sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
        self.wrappers = dict(WRAPPER.findall(text))

    def codes(self):
        for start, end in self.literals:
            found = CODE.fullmatch(self.text, start, end)
            if found:
                yield start, end, found[1]

    def arguments(self, at):
        """Places of the arguments behind the one that ends at `at`."""
        depth, begin, places = 0, None, []
        while at < len(self.blank) and depth >= 0 and self.blank[at] != ";":
            c = self.blank[at]
            depth += (c in "([{") - (c in ")]}")
            if depth < 0 or depth == 0 and c == ",":
                places += [] if begin is None else [(begin, at)]
                begin = at + 1
            at += 1
        return places

    def sentence(self, begin, end):
        """The literals of an argument, or of the variable that it names, as a sentence, values as …; "" where there are none."""
        name = self.blank[begin:end].strip()
        made = [m.end() for m in re.finditer(rf"\b{name} = ", self.blank[:begin])] if re.fullmatch(r"[a-z]\w*", name) else []
        if made:
            begin, end = made[-1], self.blank.index(";", made[-1])
        out, last = "", begin
        for start, stop in self.literals:
            if start < begin or stop > end:
                continue
            between = self.blank[last:start]
            if re.search(r"\?|(?<!:):(?!:)", between) and out:
                break
            glued = not re.sub(r"fmt::format\(|std::string\(|\b[fr]?$", "", between).strip()
            out += ("" if glued else "…") + self.text[start + 1:stop - 1]
            last = stop
        if out and "{" not in out and re.search(r"\w", self.blank[last:end]):
            out += "…"
        out = re.sub(r"\{[^{}]*\}" if self.python else r"\{(?::[^{}]*)?\}", "…", out.replace("{{", "{").replace("}}", "}").replace("\\n", " ").replace("\\", ""))
        out = re.sub(r"^(?:…?[.:;,]? ?)+", "", " ".join(out.split()))
        if not re.search(r"[a-z]{2,}.* |: …", out):
            return ""
        return out if len(out) <= LONGEST_SENTENCE else out[:LONGEST_SENTENCE].rsplit(" ", 1)[0] + " …"

    def use(self, start, end, wrappers):
        """How what has the code ends (an exit code, a class of Python, "in a list", "warning", "note", "HTTP"; None: said elsewhere), and its
        sentence; None where no code is expected."""
        before = BEFORE.search(self.text[max(0, start - 120):start])
        if not before:
            return None
        if self.python:
            raised = list(re.finditer(r"raise (\w+)\(", self.blank[:start]))
            return (f"`{raised[-1][1]}`", self.sentence(raised[-1].end(), start)) if raised else (None, "")
        call = before["call"]
        places = self.arguments(end)[1:2] if call in ("error", "warning", "note") else self.arguments(end)[:2 if call else 1]
        said = next(filter(None, (self.sentence(*place) for place in places)), "")
        if before["kind"]:
            return str(EXIT_CODES[before["kind"]]), said
        if call in ("warning", "note", "error_json"):
            return {"error_json": "HTTP"}.get(call, call), said
        if call is None:
            kind = self.text[:start].endswith("return ") and re.search(r"ErrorKind::(\w+)", self.text[start:])
            return (str(EXIT_CODES[kind[1]]) if kind else None), said
        kind = self.wrappers.get(call) or (wrappers.get(call) if call not in ("report", "error") else None)
        return (str(EXIT_CODES[kind]) if kind else IN_A_LIST), said


def sources(root):
    for folder in FOLDERS:
        for where, folders, names in os.walk(os.path.join(root, folder)):
            folders[:] = sorted(name for name in folders if name != "tests")
            for name in sorted(names):
                if name.endswith((".cpp", ".h", ".cu", ".py")) and not name.endswith("_test.cpp"):
                    with open(os.path.join(where, name), encoding="utf-8") as file:
                        text = file.read()
                    if CODE.search(text) or "(Code code" in text:
                        yield name, Source(text, name.endswith(".py"))


def collect(root):
    """{code: (endings, sentence)}"""
    codes, every = {}, list(sources(root))
    wrappers = {call: kind for name, source in every if name.endswith(".h") for call, kind in source.wrappers.items()}
    for _, source in every:
        for start, end, code in source.codes():
            found = source.use(start, end, wrappers)
            if found:
                endings, sentence = codes.get(code, (set(), ""))
                codes[code] = (endings | {found[0]} - {None}, sentence or found[1])
    return codes


def page(root):
    codes, text, area = collect(root), HEAD, ""
    for code in sorted(codes, key=lambda c: c.split(".")):
        endings, sentence = codes[code]
        if code.split(".")[0] != area:
            area = code.split(".")[0]
            text += f"\n## {area}\n\n| code | exit code | sentence |\n|---|---|---|\n"
        said = re.sub(r"[|*\[]", r"\\\g<0>", SENTENCES.get(code) or sentence or "…").replace("<", "&lt;")
        text += f"| `{code}` | {', '.join(sorted(endings or {IN_A_LIST}))} | {said} |\n"
    return text
