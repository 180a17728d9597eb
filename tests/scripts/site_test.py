"""scripts/site --check on a small repository: a whole one passes, and every kind of broken link is named and counted.

site_test.py SOURCE [--built]: with --built the pages are built too, which takes mkdocs; without it the exit code is 69."""
import os
import shutil
import subprocess
import sys
import tempfile

SOURCE, BUILT = sys.argv[1], "--built" in sys.argv
NO_MKDOCS = 69
DOCS = "docs"  # other tests look for documents that sources name

WHOLE = {
    "README.md": f"# Small\n\nRead [a page]({DOCS}/guide/page.md#second-heading), [code](code/main.cpp) and [elsewhere](https://example.org/a).\n",
    f"{DOCS}/index.md": "# Index\n\n## All pages\n\n### Start\n\n| page | what |\n|---|---|\n| [index](index.md) | this |\n| [README](../README.md) | all |\n\n"
                     "### Guide\n\n| page | what |\n|---|---|\n| [page](guide/page.md) | how |\n",
    f"{DOCS}/guide/page.md": "# Page\n\n## Second `heading`\n\n`[no](link.md)` ![drawn](../images/a.svg) [up](../../README.md) [part](../../parts/one/README.md)\n\n"
                          "```text\n[no link](either.md)\n# no heading\n```\n",
    f"{DOCS}/images/a.svg": "<svg xmlns='http://www.w3.org/2000/svg'/>\n",
    f"{DOCS}/site.css": "a { color: red }\n",
    "parts/one/README.md": f"# One\n\n[Page](../../{DOCS}/guide/page.md)\n",
    "code/main.cpp": "int main() {}\n",
}

# What is written instead, and the one sentence that it costs.
BROKEN = [
    ({"README.md": f"# Small\n\n[gone]({DOCS}/gone.md)\n"}, f"README.md: {DOCS}/gone.md: no such file"),
    ({"README.md": f"# Small\n\n[gone]({DOCS}/guide/page.md#third)\n"}, f"{DOCS}/guide/page.md has no heading of that name"),
    ({"README.md": "# Small\n\n[own](#no-heading)\n"}, "README.md has no heading of that name"),
    ({"README.md": "# Small\n\n[out](../elsewhere.md)\n"}, "../elsewhere.md: no such file"),
    ({"README.md": "# Small\n\n[odd](https://exa_mple)\n"}, "no name of a host"),
    ({"README.md": "# Small\n\n[odd](ftp://example.org)\n"}, "a link starts with https://"),
    ({f"{DOCS}/guide/more.md": "# More\n"}, f"no table under 'All pages' lists {DOCS}/guide/more.md"),
    ({"NEWS.md": "# News\n"}, "no table under 'All pages' lists NEWS.md"),
    ({f"{DOCS}/images/b.svg": "<svg/>\n"}, f"{DOCS}/images/b.svg: no page links to it"),
]
# These only the built pages show.
BROKEN_BUILT = [
    ({"parts/one/README.md": "# One\n\nThree things:\n- this\n- that\n"}, "'- this' is shown as text"),
    ({"parts/one/README.md": '# One\n\n<img src="https://example.org/a.png">\n'}, "is loaded from another host"),
    ({"parts/one/README.md": '# One\n\n<a href="gone.html">x</a>\n'}, "gone.html: no such file"),
    ({f"{DOCS}/site.css": "a { background: url(https://example.org/a.png) }\n"}, "is loaded from another host"),
]


def check(files, *options):
    """Exit code, last line and the other lines of a check of these files."""
    with tempfile.TemporaryDirectory(prefix="site of ") as root:
        for name in ("scripts/site", "scripts/site_links.py", "mkdocs.yml"):
            os.makedirs(os.path.join(root, os.path.dirname(name)), exist_ok=True)
            shutil.copyfile(os.path.join(SOURCE, name), os.path.join(root, name))
        for name, text in files.items():
            os.makedirs(os.path.join(root, os.path.dirname(name)), exist_ok=True)
            with open(os.path.join(root, name), "w", encoding="utf-8") as file:
                file.write(text)
        done = subprocess.run([sys.executable, os.path.join(root, "scripts/site"), "--check", *options], capture_output=True, text=True)
        source = os.path.join(root, "build/site/source/code/main.cpp.html")
        return done.returncode, done.stdout.strip().split("\n")[-1], done.stderr, os.path.exists(source)


def expect(what, text):
    if not what:
        sys.exit(text)


options = [] if BUILT else ["--markdown"]
code, line, errors, source = check(WHOLE, *options)
if BUILT and code == NO_MKDOCS:
    print("mkdocs or mkdocs-material is not installed: the built pages are NOT checked")
    sys.exit(NO_MKDOCS)
expect(code == 0 and not errors and line.startswith("site: pages=") and line.endswith(" links_broken=0"), f"{code} {line}\n{errors}")
expect(not BUILT or source, "a linked source file is a page")
expect(BUILT or line.startswith("site: pages=4 links=10 "), line)
for change, sentence in BROKEN_BUILT if BUILT else BROKEN:
    code, line, errors, _ = check({**WHOLE, **change}, *options)
    expect(code == 1 and sentence in errors and not line.endswith("=0"), f"{change}: {code} {line}\n{errors}")
print(f"{1 + len(BROKEN_BUILT if BUILT else BROKEN)} repositories")
