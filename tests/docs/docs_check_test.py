"""docs_check.py and cmake/make_pages.py on small repositories: what is counted, and that each kind of fault is named. Argument: the folder of sources."""
import json
import os
import re
import subprocess
import sys
import tempfile

sys.dont_write_bytecode = True
SOURCE = sys.argv[1]
sys.path.insert(0, os.path.join(SOURCE, "cmake"))
import make_pages  # noqa: E402

DOCS = "docs"  # other tests look for documents that sources name
ROW = {"scene": "lego", "seconds": 60.0, "device": "NVIDIA H100", "date": "2026-11-26", "commit": "0cb12932", "command": "scripts/benchmark FOLDER", "n": 1, "psnr": 34.72}
CELLS = "experiment,scene,variant,seed,metric,value\n" + "".join(f"labels,walk,click,{seed},miou,{seed}\n" for seed in (1, 2, 3)) + "other,walk,click,1,miou,9\n"
SOURCES = {"cells.csv": {key: ROW[key] for key in ("date", "commit", "device", "command", "n")}}
PAGE = "# Page\n\nSix plain words of a page `code`.\n\n```sh\nsemfield one\n# no heading [no link](gone.md)\n```\n"
SOURCED = "## Measured\n\n`semfield train` on 26 November 2026:\n\n| what | PSNR, dB |\n|---|---|\n| lego | 34.72 |\n"
FILES = {
    "README.md": f"# Small\n\n[Page]({DOCS}/page.md)\n",
    "code/main.cpp": "int main() {}\n",
    f"{DOCS}/images/a.svg": "<svg xmlns='http://www.w3.org/2000/svg'/>\n",
    f"{DOCS}/evidence/rows.json": json.dumps([ROW]), f"{DOCS}/evidence/cells.csv": CELLS,
    f"{DOCS}/evidence/sources.json": json.dumps(SOURCES),
    f"{DOCS}/more.md": "# More\n\n## Second `heading`\n\n[data](evidence/rows.json) [cells](evidence/cells.csv) [sources](evidence/sources.json)\n"
                       "![drawn](images/a.svg) [code](../code/main.cpp) [page](page.md) `[no](link.md)` [elsewhere](https://example.org/a) [codes](reference/codes.md#any)\n",
}


def write(root, files):
    for name, text in files.items():
        os.makedirs(os.path.dirname(os.path.join(root, name)), exist_ok=True)
        with open(os.path.join(root, name), "w", encoding="utf-8") as file:
            file.write(text)


def expect(page, code, sentence="", files=(), **wanted):
    """Checks a repository with this page, and with files instead of others."""
    with tempfile.TemporaryDirectory(prefix="docs of ") as root:
        write(root, {**FILES, f"{DOCS}/page.md": page, **dict(files)})
        done = subprocess.run([sys.executable, os.path.join(SOURCE, "tests/docs/docs_check.py"), "--root", root], capture_output=True, text=True)
    values = dict(re.findall(r"(\w+)=(\d+)", done.stdout.strip().split("\n")[-1]))
    wrong = {name: values.get(name) for name, value in wanted.items() if values.get(name) != str(value)}
    if done.returncode != code or sentence not in done.stderr or wrong:
        sys.exit(f"expected {code}, '{sentence}', {wanted}; got {done.returncode}, {values}:\n{done.stderr}\nof\n{page}")


# What counts: words have letters, and code and comments are none.
expect(PAGE, 0, words=22, figures=0, banned_phrases=0, links_broken=0, links=9, readme_words=3)
expect(PAGE + SOURCED, 0, figures=1, figures_without_source=0)
expect(PAGE + "## Link\n\nIt has 27.9 dB ([all](evidence/rows.json)).\n", 0, figures=1, figures_without_source=0)
expect("# Page\n\n`semfield eval` of version 0.1.0.\n\n## Below\n\nmIoU 0.75\n", 0, figures=1, figures_without_source=0)
expect(PAGE + "`is told` is code.\n\nA sentence\n\n- and a list\n  of two\n- items\n", 0, banned_phrases=0)

# What is wrong.
expect(PAGE + "## Bare\n\nIt has 27.9 dB.\n", 1, "'Bare' has 1 figures without a source, such as '27.9 dB'", figures_without_source=1)
expect(SOURCED.replace("on 26 November 2026", "once"), 1, "'Measured' has 1 figures", figures_without_source=1)
expect(SOURCED.replace("`semfield train`", "Measured"), 1, "'Measured' has 1 figures", figures_without_source=1)
expect(PAGE + "The field is told\nwhat a ray tells.\n", 1, "'is told': write: is reported", banned_phrases=2)
expect(PAGE, 1, "app/verb.cpp:2: 'is told'", {"app/verb.cpp": '// The user is told.\nrefuse("a \\"field\\" is told");\n'}, banned_phrases=1)
expect(PAGE + "word " * 50000, 1, "words; at most ")
expect(PAGE, 1, "at most 900", {"README.md": f"# Small\n\n[Page]({DOCS}/page.md)\n" + "word " * 900})
for text, sentence in [
    ("[gone](gone.md)", "gone.md: no such file"), ("[gone](more.md#third)", f"{DOCS}/more.md has no heading of that name"), ("[own](#no-heading)", "has no heading of that name"),
    ("[out](../../elsewhere.md)", "elsewhere.md: no such file"), ("[odd](https://exa_mple)", "no name of a host"), ("[odd](ftp://example.org)", "a link starts with https://"),
    ("Three things:\n- this\n- that", "'- this' is shown as text"), ('<img src="https://example.org/a.png">', "Markdown has links and images"),
]:
    expect(f"{PAGE}\n{text}\n", 1, sentence, links_broken=1)
expect(PAGE, 1, f"{DOCS}/images/b.svg: no page links to it", {f"{DOCS}/images/b.svg": "<svg/>\n"})
expect(PAGE + "![drawn](images/b.png)\n", 1, f"{DOCS}/images/b.png: scripts/pictures did not make it", {f"{DOCS}/images/b.png": "", f"{DOCS}/images/made.json": '{"a.png": {}}'})
expect(PAGE, 1, f"index.md: lists no {DOCS}/page.md", {f"{DOCS}/index.md": "# Index\n\n## All pages\n\n[more](more.md) [index](index.md) [readme](../README.md)\n"})
expect(PAGE, 1, f"{DOCS}/site.css: https://example.org/a.png: is loaded from another host", {f"{DOCS}/site.css": "a { background: url(https://example.org/a.png) }\n"})
expect(PAGE, 1, "evidence/rows.json: has no commit", {f"{DOCS}/evidence/rows.json": json.dumps([{**ROW, "commit": None}])})
expect(PAGE, 1, "evidence/cells.csv: has no date, commit, device", {f"{DOCS}/evidence/sources.json": "{}"})

# Tables of data. Of 1, 2 and 3 half an interval is 4.303 / sqrt(3).
with tempfile.TemporaryDirectory(prefix="data of ") as folder:
    write(folder, FILES)
    for mark, row in [("table rows.json: scene psnr", "| lego | 34.7 |"), ("table cells.csv experiment=labels: miou", "| click | 2.000 ± 2.484 (3) |"),
                      ("table cells.csv experiment=labels|other: miou", "| click | 2.000 ± 2.484 (3) | 9 |"),
                      ("sources", "| 2026-11-26 | 0cb12932 | NVIDIA H100 | `scripts/benchmark FOLDER` | 1 |")]:
        text = make_pages.filled(folder, f"before\n<!-- {mark} -->\nafter\n")
        if row not in text or "<!--" in text:
            sys.exit(f"expected '{row}' of {mark}, got\n{text}")
print("36 repositories and tables")
