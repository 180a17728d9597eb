"""scripts/docs_check on a small repository: what it counts, and that each kind of fault is named. Argument: the folder of sources."""
import json
import os
import re
import subprocess
import sys
import tempfile

SOURCE = sys.argv[1]
DOCS = "docs"  # other tests look for documents that sources name
CELLS = "experiment,scene,variant,seed,metric,value\nlabels_paper,walk,click,1,miou_present,0.5\n"
CELLS_TODAY = "experiment,scene,variant,seed,metric,value\n" + "".join(f"labels_fast,walk,click,{seed},miou_present,{seed}\n" for seed in (1, 2, 3))
ROW = {"scene": "lego", "preset": "object", "seconds": 60.0, "device": "NVIDIA H100 80GB HBM3", "date": "2026-11-26", "commit": "0cb12932", "command": "scripts/benchmark FOLDER", "n": 1,
       "psnr": 34.72}
SEED = {"pq": 0.9, "sq": 1, "rq": 0.9, "mcov": 0.5, "count_error": 0.1, "seconds": 2}
OBJECTS = {"date": "2026-11-26", "commit": "0cb12932", "device": "a CPU", "command": "scripts/object_tables RUNS", "n": 2,
           "rows": {f"{room}/exact": [SEED, {**SEED, "pq": 0.8}] for room in ("living", "class", "room")}}
SOURCES = {name: {key: OBJECTS[key] for key in ("date", "commit", "device", "command", "n")} for name in ("gpu_cells.csv", "gpu_cells_h100.csv")}
PAGE = "# Page\n\nSix plain words of a page `code`.\n\n```sh\nsemfield one\n```\n\n<!-- not run: takes hours -->\n```sh\nsemfield two\nsemfield three\n```\n"
SOURCED = "## Measured\n\n`semfield train` on 26 November 2026:\n\n| what | PSNR, dB |\n|---|---|\n| lego | 34.72 |\n"


def check(page, *options, readme="# Small\n\n[Page](" + DOCS + "/page.md)\n", row=ROW, sources=SOURCES, source=""):
    """Exit code, the values of the last line, what is printed, and the page afterwards."""
    with tempfile.TemporaryDirectory(prefix="docs of ") as root:
        for name, text in {"README.md": readme, "app/verb.cpp": source, f"{DOCS}/page.md": page, f"{DOCS}/evidence/benchmark.json": json.dumps([row]), f"{DOCS}/evidence/objects.json": json.dumps(OBJECTS),
                           f"{DOCS}/evidence/sources.json": json.dumps(sources),
                           f"{DOCS}/evidence/gpu_cells.csv": CELLS, f"{DOCS}/evidence/gpu_cells_h100.csv": CELLS_TODAY,
                           f"{DOCS}/more.md": "# More\n\n[data](evidence/benchmark.json) [cells](evidence/gpu_cells.csv) [more](evidence/gpu_cells_h100.csv)\n"
                                             "[objects](evidence/objects.json) [sources](evidence/sources.json)\n"}.items():
            os.makedirs(os.path.join(root, os.path.dirname(name)), exist_ok=True)
            with open(os.path.join(root, name), "w", encoding="utf-8") as file:
                file.write(text)
        done = subprocess.run([sys.executable, os.path.join(SOURCE, "scripts/docs_check"), "--root", root, *options], capture_output=True, text=True)
        values = dict(re.findall(r"(\w+)=(\d+)", done.stdout.strip().split("\n")[-1]))
        with open(os.path.join(root, DOCS, "page.md"), encoding="utf-8") as file:
            return done.returncode, values, done.stderr, file.read()


def expect(page, code, sentence="", **wanted):
    got, values, said, _ = check(page)
    wrong = {name: values.get(name) for name, value in wanted.items() if values.get(name) != str(value)}
    if got != code or sentence not in said or wrong:
        sys.exit(f"expected {code}, '{sentence}', {wanted}; got {got}, {values}:\n{said}\nof\n{page}")


# What counts: words have letters, and code and comments are none; commands by whether something runs them.
expect(PAGE, 0, words=16, commands_run=1, commands_marked=2, figures=0, banned_phrases=0, links_broken=0, readme_words=3)
expect(PAGE + SOURCED, 0, figures=1, figures_without_source=0)
expect(PAGE + "## Link\n\nIt has 27.9 dB ([all](evidence/benchmark.json)).\n", 0, figures=1, figures_without_source=0)
expect("# Page\n\n`semfield eval` of version 0.1.0.\n\n## Below\n\nmIoU 0.75\n", 0, figures=1, figures_without_source=0)

# What is wrong.
expect(PAGE + "## Bare\n\nIt has 27.9 dB.\n", 1, "'Bare' has 1 figures without a source, such as '27.9 dB'", figures_without_source=1)
expect(SOURCED.replace("on 26 November 2026", "once"), 1, "'Measured' has 1 figures", figures_without_source=1)
expect(SOURCED.replace("`semfield train`", "Measured"), 1, "'Measured' has 1 figures", figures_without_source=1)
expect(PAGE + "The field is told\nwhat a ray tells.\n", 1, "'is told': write: is reported", banned_phrases=2)
expect(PAGE + "`is told` is code.\n", 0, banned_phrases=0)
code, values, said, _ = check(PAGE, source='// The user is told.\nrefuse("a \\"field\\" is told");\n')
if code != 1 or values["banned_phrases"] != "1" or "app/verb.cpp:2: 'is told'" not in said:
    sys.exit(f"a message with a banned phrase passes: {code} {said}")
expect(PAGE + "[gone](gone.md)\n", 1, "gone.md: no such file", links_broken=1)
expect(PAGE + "```text\nsemfield hidden\n```\n", 1, "'semfield hidden' is in a block that nothing runs")
expect(PAGE + "word " * 45000, 1, "words; at most 45000 are read")
code, values, said, _ = check(PAGE, readme=f"# Small\n\n[Page]({DOCS}/page.md)\n" + "word " * 900)
if code != 1 or "at most 900" not in said:
    sys.exit(f"a long README passes: {code} {values}")

# Tables of figures are those of the data, and --write makes them so.
EMPTY = PAGE + "<!-- figures benchmark: lego 60 gpu -->\n<!-- /figures -->\n"
expect(EMPTY, 1, "run scripts/docs_check --write")
code, values, said, written = check(EMPTY, "--write")
if code != 0 or "| lego, an object, `object` | 60 s | 34.7 dB | – | H100 | 2026-11-26, 0cb12932 |\n" not in written:
    sys.exit(f"the table is not written: {code} {said}\n{written}")
expect(written, 0, figures=1, figures_without_source=0)
expect(written.replace("34.7 dB", "35.7 dB"), 1, "a table of figures is not that of the data")
expect(EMPTY.replace("lego 60", "lego 61"), 1, "has no row 'lego 61 gpu'")

# Means of seeds: 1, 2 and 3 have the mean 2 and half an interval of 4.303 / sqrt(3).
code, values, said, written = check(PAGE + "<!-- figures labels: walk -->\n<!-- /figures -->\n", "--write")
if code != 0 or "| click | 0.500 | 2.000 ± 2.484 (3) | – |" not in written:
    sys.exit(f"the table of labels is not written: {code} {said}\n{written}")

# Objects: of 0.9 and 0.8 half an interval is 12.706 * 0.0707 / sqrt(2).
code, values, said, written = check(PAGE + "<!-- figures objects: living, means -->\n<!-- /figures -->\n", "--write")
if code != 0 or "| living room | exact | 0.850 ± 0.635 (2) | 1.000 ± 0.000 (2) |" not in written or "| means of the three | exact | 0.850 | 1.000 |" not in written:
    sys.exit(f"the table of objects is not written: {code} {said}\n{written}")

# A file of data without a source is refused, and the table of sources shows it.
for wrong, sentence in ({"row": {**ROW, "commit": None}}, "evidence/benchmark.json: has no commit"), ({"sources": {}}, "evidence/gpu_cells.csv: has no date, commit, device"):
    code, values, said, _ = check(PAGE, **wrong)
    if code != 1 or sentence not in said:
        sys.exit(f"data without a source pass: {code} {said}")
code, values, said, written = check(PAGE + "<!-- figures sources: all -->\n<!-- /figures -->\n", "--write")
if code != 0 or "| 2026-11-26 | 0cb12932 | NVIDIA H100 80GB HBM3 | `scripts/benchmark FOLDER` | 1 |" not in written:
    sys.exit(f"the table of sources is not written: {code} {said}\n{written}")
print("24 repositories")
