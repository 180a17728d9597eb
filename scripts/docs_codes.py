"""The page of all codes of errors and findings, from the sources."""
import os
import re

FOLDERS = ("app", "framework", "plugins", "python", "tests/numerics")
EXIT_CODES = {"failure": 1, "usage": 2, "data": 65, "no_input": 66, "unavailable": 69, "internal": 70, "cannot_create": 73,
              "io": 74, "config": 78}
IN_A_LIST = "in a list"
LONGEST_SENTENCE = 120
# Where the first of many places would say too little.
SENTENCES = {
    "config.value.choice": "expected one of …, got '…'",
    "config.value.range": "expected a number in […, …], got …",
    "config.value.type": "expected a number, got '…'",
    "files.path.unusable": "'…': Permission denied",
    "internal.check.failed": "….cpp:…: … (violated: …)",
    "plugin.module.unloadable": "cannot load plugin '…': undefined symbol: …",
    "scene.image.turned": "colour image '…' is … pixels, the camera …: one is turned by a quarter against the other",
    "usage.value.invalid": "--threads many: expected a whole number",
}
HEAD = """# Codes

Every error and every finding has a code at the end of its line, such as `[config.key.unknown]`. Sentences may change from version to version; a code stays with its
cause, and a change is in the [changelog](../../CHANGELOG.md). Programs read it as `code` in [JSON](json.md), in the answers of the [labelling page](labelling_http.md) and in the
exceptions of the [Python package](../guide/python.md#errors).

The second column is the [exit code](command_line.md#exit-codes) of an error that ends the program. *In a list* are findings, all of which one pass over an input reports at once:
the program ends with 65 where the data are wrong and with 78 where the configuration is. Warnings and notes end nothing. The third column is what one of the places says, with …
for values.
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
        if call in ("warning", "note", "error_json"):
            return call.replace("error_json", "HTTP"), said
        kind = before["kind"] or self.wrappers.get(call) or (call not in ("report", "error") and wrappers.get(call))
        if call is None and not kind and self.text[:start].endswith("return "):
            kind = (re.search(r"ErrorKind::(\w+)", self.text[start:]) or [None, None])[1]
        return (str(EXIT_CODES[kind]) if kind else IN_A_LIST if call else None), said


def collect(root):
    """{code: (endings, sentence)}"""
    codes, sources, wrappers = {}, [], {}
    for path in sorted(os.path.join(where, name) for folder in FOLDERS for where, _, names in os.walk(os.path.join(root, folder)) for name in names):
        if path.endswith((".cpp", ".h", ".cu", ".py")) and not path.endswith("_test.cpp") and "/tests/" not in path[len(root) + 1:].removeprefix("tests"):
            with open(path, encoding="utf-8") as file:
                text = file.read()
            if CODE.search(text) or "(Code code" in text:
                sources.append(Source(text, path.endswith(".py")))
                wrappers.update(sources[-1].wrappers if path.endswith(".h") else {})
    for source in sources:
        for start, end in source.literals:
            code = CODE.fullmatch(source.text, start, end)
            found = code and source.use(start, end, wrappers)
            if found:
                endings, sentence = codes.get(code[1], (set(), ""))
                codes[code[1]] = (endings | {found[0]} - {None}, sentence or found[1])
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
