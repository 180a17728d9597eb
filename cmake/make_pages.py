#!/usr/bin/env python3
"""Writes the pages as a reader gets them: cmake/make_pages.py FOLDER. Everything in docs/, every page of the tree with tables of data filled in, the
sources and folders that they link to, and docs/reference/codes.md and cpp.md, from the sources. `semfield help --pages FOLDER` adds what the program knows of itself,
python/docs/reference.py the Python module; the CMake target docs_pages calls all three for build/PRESET/docs."""
import argparse
import csv
import json
import math
import os
import pathlib
import re
import shutil
import statistics
import urllib.parse

REPOSITORY = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
NOT_OURS = re.compile(r"\.|build|(?:runs|out|data|__pycache__)$")
FENCE = re.compile(r"^(`{3,})[^`\n]*\n.*?^\1`*[ ]*$\n?", re.M | re.S)
# A code span, or the target of a link or an image.
LINK = re.compile(r"(?P<code>(?<!`)(?P<ticks>`+)(?!`).*?(?<!`)(?P=ticks)(?!`))|\]\((?P<target>[^)\s]+)(?:\s+\"[^\"]*\")?\)", re.S)


def pages_of(root):
    """{path: text} of every Markdown file."""
    pages = {}
    for where, folders, names in os.walk(root):
        folders[:] = sorted(folder for folder in folders if not NOT_OURS.match(folder))
        for name in sorted(names):
            if name.endswith(".md"):
                path = os.path.join(where, name)
                with open(path, encoding="utf-8") as file:
                    pages[os.path.relpath(path, root).replace(os.sep, "/")] = file.read()
    return pages


def sources_in(root, folders, endings):
    """(path, text) of sources that are no tests."""
    for path in sorted(os.path.join(where, name) for folder in folders
                       for where, _, names in os.walk(os.path.join(root, folder)) for name in names):
        if path.endswith(endings) and not re.search("_test.cpp$|./tests/", path[len(root) + 1:]):
            with open(path, encoding="utf-8") as file:
                yield os.path.relpath(path, root), file.read()


def links_of(text):
    return [m["target"] for m in LINK.finditer(FENCE.sub("", text)) if m["target"]]


def resolve(page, target):
    """Path in the repository of what `target` means in `page`."""
    return os.path.normpath(os.path.join(os.path.dirname(page), urllib.parse.unquote(target))).replace(os.sep, "/")


# Tables of pages that are made from the data in docs/evidence when the pages are built. A page asks for one by a comment:
#
#   <!-- table benchmark.json: scene seconds psnr -->                     a row per row of a list, these members as columns
#   <!-- table gpu_cells.csv scene=walk experiment=labels_paper|labels_today: miou_present psnr -->   a row per variant of sweeps, some rows of theirs
#   <!-- sources -->                                                      where each file of data comes from
#
# Means of several seeds have half their 95 % interval (Student's t) and the number of seeds.
#
# Every file of data has a date, a commit, a device, the command that wrote it and the number n of runs behind a figure: as its own members, in each of its rows,
# or, where the format has no room for them, in sources.json.
EVIDENCE = "docs/evidence"
SOURCE = ("date", "commit", "device", "command", "n")
# 0.975 quantiles of Student's t for two to ten seeds.
STUDENT = dict(enumerate((12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262), 2))
MARK = re.compile(r"<!-- table (?P<files>[^:>]*): (?P<columns>[^>]*?) -->\n|<!-- sources -->\n")


def read_json(root, name):
    with open(os.path.join(root, EVIDENCE, name), encoding="utf-8") as file:
        return json.load(file)


def half_width(values):
    """Half of the 95 % interval of a mean."""
    return STUDENT[len(values)] * statistics.stdev(values) / math.sqrt(len(values))


def mean_of(values):
    if not values or isinstance(values[0], str):
        return values[0] if values else "–"
    if len(values) == 1 and values[0] == int(values[0]):
        return f"{values[0]:.0f}"
    digits = 1 if max(values) >= 10 else 3
    mean = f"{statistics.mean(values):.{digits}f}"
    if len(values) == 1:
        return mean
    return f"{mean} ± {half_width(values):.{digits}f} ({len(values)})"


def rows_of(root, words):
    """(name of the row, column, value) of files of data; words are names of files and filters KEY=VALUE|VALUE."""
    filters = dict(word.split("=") for word in words if "=" in word)
    for name in (word for word in words if "=" not in word):
        if name.endswith(".csv"):
            with open(os.path.join(root, EVIDENCE, name), encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    if row["value"] and all(row[key] in allowed.split("|") for key, allowed in filters.items()):
                        many = "|" in filters.get("experiment", "")
                        yield row["variant"], row["metric"] + (f", {row['experiment']}" if many else ""), float(row["value"])
            continue
        for number, row in enumerate(read_json(root, name)):
            yield from ((number, key, value) for key, value in row.items() if not isinstance(value, (dict, list)))


def table_of(rows, columns):
    cells = {}
    for row, column, value in rows:
        cells.setdefault(row, {}).setdefault(column, []).append(value)
    found = list(dict.fromkeys(column for row in cells.values() for column in row))
    shown = [column for asked in columns for column in found if column == asked or column.startswith(asked + ", ")]
    lost = [asked for asked in columns if not any(column.split(", ")[0] == asked for column in shown)]
    if lost:
        raise SystemExit(f"make_pages: no data have {', '.join(lost)}")
    named = isinstance(next(iter(cells)), str)
    out = f"|{' |' * named} {' | '.join(shown)} |\n|{'---|' * (named + len(shown))}\n"
    for name, row in cells.items():
        out += f"|{f' {name} |' * named} {' | '.join(mean_of(row.get(column, [])) for column in shown)} |\n"
    return out


def sources_of(root):
    """{file of data: {member of SOURCE: what it or sources.json states}}; what rows state is joined."""
    folder = os.path.join(root, EVIDENCE)
    names = sorted(name for name in os.listdir(folder) if name.endswith((".json", ".csv")) and name != "sources.json") if os.path.isdir(folder) else []
    out = dict(read_json(root, "sources.json")) if os.path.exists(os.path.join(folder, "sources.json")) else {}
    for name in names:
        data = read_json(root, name) if name.endswith(".json") else []
        rows = data if isinstance(data, list) else [data]
        stated = {key: sorted({str(row[key]) for row in rows}) for key in SOURCE if rows and all(row.get(key) is not None for row in rows)}
        out[name] = {**out.get(name, {}), **{key: "; ".join(values if len(values) < 3 else [values[0], "…", values[-1]]) for key, values in stated.items()}}
    return {name: out[name] for name in names}


def sources_table(root):
    out = "| data | date | commit | device | command | n |\n|---|---|---|---|---|---|\n"
    for name, source in sources_of(root).items():
        out += f"| [{name}]({name}) | {' | '.join(f'`{source[key]}`' if key == 'command' else str(source[key]) for key in SOURCE)} |\n"
    return out


def filled(root, text):
    def part(mark):
        table = lambda: table_of(rows_of(root, mark["files"].split()), mark["columns"].split())
        return table() if mark["files"] else sources_table(root)
    return MARK.sub(part, text)


# The page of all codes of errors and findings, from the sources.
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
    "usage.value.invalid": "train: --steps: 'many' is not 1 to 1000000000",
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
# Comments and literals that are no sentences, of C++ and of Python.
NOTHING = (re.compile(rf'({LITERAL})|R"(\w*)\(.*?\)\2"|//[^\n]*|(?<!\w)\'(?:[^\'\\]|\\.)+\'', re.S),
           re.compile(rf'(?<!")({LITERAL})(?!")|""".*?"""|#[^\n]*', re.S))
TOKEN = re.compile(rf"{LITERAL}|[()\[\]{{}};,]")


def arguments(text):
    """Texts of the arguments behind a code."""
    depth, begin = 0, None
    for token in TOKEN.finditer(text):
        depth += (token[0] in "([{") - (token[0] in ")]}")
        ends = depth < 0 or token[0] == ";"
        if ends or depth == 0 and token[0] == ",":
            if begin is not None:
                yield text[begin:token.start()]
            begin = token.end()
        if ends:
            return


def sentence_of(text, before, python):
    """The literals of an argument, or of the variable that it names, as a sentence, values as …; "": there are none."""
    made = re.fullmatch(r"\s*[a-z]\w*", text) and before.rpartition(f" {text.strip()} = ")
    text, out, last = made[2].partition(";")[0] if made and made[1] else text, "", 0
    for literal in re.finditer(LITERAL, text):
        between = text[last:literal.start()]
        if out and re.search(r"\?|(?<!:):(?!:)", between):
            break
        glued = not re.sub(r"fmt::format\(|std::string\(|\b[fr]?$", "", between).strip()
        out += ("" if glued else "…") + literal[0][1:-1]
        last = literal.end()
    out += "…" if out and "{" not in out and re.search(r"\w", re.sub(LITERAL, "", text[last:])) else ""
    out = out.replace("{{", "{").replace("}}", "}").replace("\\n", " ").replace("\\", "")
    out = re.sub(r"\{[^{}]*\}" if python else r"\{(?::[^{}]*)?\}", "…", out)
    out = re.sub(r"^(?:…?[.:;,]? ?)+", "", " ".join(out.split()))
    if not re.search(r"[a-z]{2,}.* |: …", out):
        return ""
    return out if len(out) <= LONGEST_SENTENCE else out[:LONGEST_SENTENCE].rsplit(" ", 1)[0] + " …"


def use_of(before, behind, python, wrappers):
    """How what has the code ends (an exit code, a class of Python, "in a list", "warning", "note", "HTTP"; None: said
    elsewhere), and its sentence; None where no code is expected. `before` and `behind` are the texts around it."""
    match = BEFORE.search(before[-120:])
    if not match:
        return None
    if python:
        *_, raised = [None, *re.finditer(r"raise (\w+)\(", before)]
        return (f"`{raised[1]}`", sentence_of(before[raised.end():], "", True)) if raised else (None, "")
    call, kind = match["call"], match["kind"] or wrappers.get(match["call"])
    places = list(arguments(behind))[1 if call in ("error", "warning", "note") else 0:2 if call else 1]
    said = next(filter(None, (sentence_of(place, before, False) for place in places)), "")
    if call in ("warning", "note", "error_json"):
        return call.replace("error_json", "HTTP"), said
    if call is None and not kind and before.endswith("return "):
        kind = (re.search(r"ErrorKind::(\w+)", behind) or [None, None])[1]
    return (str(EXIT_CODES[kind]) if kind else IN_A_LIST if call else None), said


def collect(root):
    """{code: (endings, sentence)}"""
    codes, sources, shared = {}, [], {}
    for path, text in sources_in(root, FOLDERS, (".cpp", ".h", ".cu", ".py")):
        python = path.endswith(".py")
        text = NOTHING[python].sub(lambda m: m[1] or " ", text)  # without comments and literals that are no sentences
        sources.append((text, python, dict(WRAPPER.findall(text))))
        shared.update(sources[-1][2] if path.endswith(".h") else {})
    shared = {call: kind for call, kind in shared.items() if call not in ("report", "error")}
    for text, python, own in sources:
        for code in CODE.finditer(text):
            if found := use_of(text[:code.start()], text[code.end():], python, {**shared, **own}):
                endings, sentence = codes.get(code[1], (set(), ""))
                codes[code[1]] = (endings | {found[0]} - {None}, sentence or found[1])
    return codes


def codes_page(root):
    codes, text, area = collect(root), HEAD, ""
    for code in sorted(codes, key=lambda c: c.split(".")):
        endings, sentence = codes[code]
        if code.split(".")[0] != area:
            area = code.split(".")[0]
            text += f"\n## {area}\n\n| code | exit code | sentence |\n|---|---|---|\n"
        said = re.sub(r"[|*\[]", r"\\\g<0>", SENTENCES.get(code) or sentence or "…").replace("<", "&lt;")
        text += f"| `{code}` | {', '.join(sorted(endings or {IN_A_LIST}))} | {said} |\n"
    return text


HEADERS = [
    ("For plugins", ["plugin/parametric.h", "core/workspace.h", "plugin/module.h", "plugin/encoder.h", "plugin/field.h", "plugin/mlp/field.h", "plugin/sampler.h", "plugin/head.h", "plugin/loss.h",
                     "scene/dataset.h", "plugin/grouping.h", "plugin/registry.h", "plugin/kernels.h", "scene/loading/posed_photographs.h",
                     "labels/label_files.h", "config/params.h", "core/view.h", "core/error.h", "core/rng.h"]),
    ("For programs", ["train/trainer.h", "train/run.h", "eval/evaluator.h", "scene/camera.h"]),
]


def cpp_page():
    """The C++ interface: the headers of plugins and programs without what is private."""
    out = ("# C++ interface\n\nHeaders are installed below `include/semfield`; these are shown without what is private. The [plugin quick start](../guide/plugin_quick_start.md) and "
           "[training from C++](../guide/driving_training.md) show their use; what stays from version to version is in [promises](compatibility.md#promises).\n")
    for group, headers in HEADERS:
        out += f"\n## {group}\n"
        for header in headers:
            with open(os.path.join(REPOSITORY, "framework", header), encoding="utf-8") as file:
                about, _, text = file.read().partition("#pragma once\n")
            text = re.sub(r"^ private:\n.*?(?=^};)", "", re.sub(r"^(?:#include .*|namespace .*|}  // namespace.*)\n", "", text, flags=re.M), flags=re.M | re.S)
            text = re.sub(r"\n{3,}", "\n\n", text).strip()
            out += f"\n### {header}\n\n{about.replace('// ', '').strip()}\n\n```cpp\n{text}\n```\n"
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", help="what was in it is removed")
    out = parser.parse_args().folder
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(os.path.join(REPOSITORY, "docs"), os.path.join(out, "docs"))
    pages = {path: filled(REPOSITORY, text) for path, text in pages_of(REPOSITORY).items()}
    pages["docs/reference/codes.md"] = codes_page(REPOSITORY)
    pages["docs/reference/cpp.md"] = cpp_page()
    for path, text in pages.items():
        place = pathlib.Path(out, path)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
        for linked in (resolve(path, target.partition("#")[0]) for target in links_of(text) if target[0] != "#"):
            if os.path.isfile(os.path.join(REPOSITORY, linked)) and linked not in pages and not linked.startswith("docs/"):  # sources
                pathlib.Path(out, linked).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(os.path.join(REPOSITORY, linked), os.path.join(out, linked))
            elif os.path.isdir(os.path.join(REPOSITORY, linked)):
                shutil.copytree(os.path.join(REPOSITORY, linked), os.path.join(out, linked), ignore=shutil.ignore_patterns("*.md", "__pycache__"), dirs_exist_ok=True)


if __name__ == "__main__":
    main()
