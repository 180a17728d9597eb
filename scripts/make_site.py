#!/usr/bin/env python3
"""Builds the site of the documents with mkdocs: scripts/make_site.py [--pages FOLDER] [--out FOLDER]

Pages are those of the CMake target docs_pages, in build/release/docs; navigation is the list under "All pages" of docs/index.md.
Read it in a browser, search included: python3 -m http.server --directory build/site"""
import argparse
import json
import os
import re
import shutil
import subprocess
import sys

sys.dont_write_bytecode = True
REPOSITORY = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
sys.path.insert(0, os.path.join(REPOSITORY, "cmake"))
from make_pages import pages_of, resolve  # noqa: E402

INDEX = "docs/index.md"
NO_MKDOCS = 69


def navigation(pages):
    """mkdocs' `nav`: the parts of the index, and READMEs of folders by the folder's name."""
    tree, folders, listed = [], {}, set()
    for part in pages[INDEX].partition("\n## All pages\n")[2].split("\n### ")[1:]:
        rows = [resolve(INDEX, row) for row in re.findall(r"^\| \[[^]]*\]\(([^)#]+\.md)\)", part, re.M)]
        listed.update(rows)
        tree.append((part.partition("\n")[0], [row for row in rows if row in pages]))
    for page in sorted(set(pages) - listed):
        folders.setdefault(page.split("/")[0], []).append({os.path.dirname(page).partition("/")[2] or page: page})
    tree[-1][1].extend({folder: rows} for folder, rows in folders.items())
    return [{name: rows[0] if len(rows) == 1 else rows} for name, rows in tree]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", default=os.path.join(REPOSITORY, "build/release/docs"), help="folder that the target docs_pages wrote")
    parser.add_argument("--out", default=os.path.join(REPOSITORY, "build/site"), help="folder of the built site")
    options = parser.parse_args()
    out, pages = os.path.abspath(options.out), pages_of(options.pages)
    if INDEX not in pages:
        sys.exit(f"site: no pages in {options.pages}; cmake --build build/release --target docs_pages")
    # Debian's packages belong to its own interpreter, which may not be the first of PATH.
    python = next((name for name in (sys.executable, "/usr/bin/python3")
                   if subprocess.run([name, "-c", "import mkdocs, material, pymdownx"], stderr=subprocess.DEVNULL).returncode == 0), None)
    if python is None:
        print("site: mkdocs is missing; NOTHING WAS BUILT. As root: apt-get install mkdocs mkdocs-material", file=sys.stderr)
        return NO_MKDOCS
    work = out + ".work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(options.pages, os.path.join(work, "pages"))
    for path, text in pages.items():  # names of files are titles of blocks; comments are for tests
        text = re.sub(r"^(`{3,}\w+) (?:file=(\S+))?.*", lambda m: m[1] + (f' title="{m[2]}"' if m[2] else ""), re.sub(r"^<!--.*?-->\n", "", text, flags=re.M | re.S), flags=re.M)
        with open(os.path.join(work, "pages", path), "w", encoding="utf-8") as file:
            file.write(text)
    with open(os.path.join(work, "mkdocs.yml"), "w", encoding="utf-8") as file:  # YAML reads JSON
        json.dump({"INHERIT": os.path.join(REPOSITORY, "mkdocs.yml"), "docs_dir": "pages", "site_dir": out, "nav": navigation(pages)}, file)
    done = subprocess.run([python, "-m", "mkdocs", "build", "--clean", "--strict", "-f", os.path.join(work, "mkdocs.yml")], stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        sys.stderr.write(done.stderr)
        return done.returncode
    shutil.rmtree(work)
    print(f"site: {out}/index.html; with search: python3 -m http.server --directory {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
