#!/usr/bin/env python3
"""Checks the documents as their reader meets them: tests/docs/docs_check.py [--list] [--pages FOLDER] [--root FOLDER]

It counts words, looks for figures and files of data without a source, broken links and phrases that no engineer would say aloud, in pages and in messages of the program.
--pages looks at links and phrases of the pages in build/PRESET/docs, where the generated ones are; --list prints the words of each page. The last line is
`docs: words=... figures=... figures_without_source=... links=... links_broken=... banned_phrases=... readme_words=...`.

A word has a letter; code and comments do not count. A figure is a number that somebody measured: before dB, ms, fps or GFLOP/s, behind PSNR, mIoU, SSIM, AbsRel, AUROC, ECE
or accuracy, as a time or a memory that something takes, or in a column of a table that has such a heading. Its source is a command together with a date, a commit or a
release, in its section or in the text of a heading above; or a link in its section to the evidence, the decision, the data or the section that has one."""
import argparse
import os
import re
import sys
import urllib.parse

sys.dont_write_bytecode = True
REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(REPOSITORY, "cmake"))
from make_pages import FENCE, LINK, SOURCE, links_of, pages_of, resolve, sources_in, sources_of  # noqa: E402

GENERATED = {f"docs/reference/{name}.md" for name in ("codes", "cpp", "plugins", "python", "verbs")}  # by the target docs_pages
# What only the site would show: a list or table that an empty line has to separate from the text above, HTML that loads or links.
RUN_ON = re.compile(r"(?:\A|\n\n)(?![-*|] |[#<>\s]|\d+\. )[^\n]+(?:\n[^\n]+)*?\n((?:[-*|] |\d+\. )[^\n]*)")
LOADED = re.compile(r"(?:url\(|@import )[\"']?((?:https?:)?//[^\"')]+)")
HTML = re.compile(r"<(?:a|img|script|link|iframe)\b[^>]*")
MOST_WORDS, MOST_README_WORDS = 46400, 900
COMMENT = re.compile(r"<!--.*?-->", re.S)
CODE_SPAN = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.S)
LITERAL = re.compile(r'"((?:[^"\\]|\\.)*)"' r"|(?<=[( ])'([^']{12,})'")
HISTORY = ("CHANGELOG.md", "docs/decisions.md")  # say what was before; their figures are of their day

# What is said, and what an engineer would say. Each is looked for in prose: no code, no links, no generated part.
BANNED = [
    (r"\b(?:is|are|was|were|be) told\b|\b(?:is|are|was) said\b", "is reported; the program says"),
    (r"\btells\b(?! \w+ apart)", "says, shows, reports"),
    (r"\banswers? (?:gradients|for (?:lanes|what))\b", "returns"),
    (r"\b(?:neighbours'|neighbours of that hour|which neighbours share|the neighbours at work)", "other processes"),
    (r"\b(?:once|one|two|three|four|\d[\d,]*(?:\.\d+)?|bytes|numbers|operations|points?|predictions|rays|samples|slots|labels?) an? "
     r"(?:cell|device|frame|image|launch|level|pixel|ray|region|row|run|sample|step|table|view)\b", "per ray, per step"),
    (r"\bin place of\b", "instead of"),
    (r"\bwhoever\b", "anyone who; if you"),
    (r"\bthat there (?:is|are)\b", "existing; leave it out"),
    (r"\b(?:stands?|stood) (?:in|beside|below|behind|on the|alone)\b|\bbeside\b|\b(?:data|examples|figures?|files?|folders?|libraries|pages?|presets|rows|tests?|it) "
     r"(?:lies?|lay) (?:in|beside|below|there|where|with)\b", "is in, is next to, in addition to"),
    (r"\b(?:earlier versions?|earlier state of this|version before|program before|old program|since then|until now|as before|than before|of before|(?:none|no one) of today|"
     r"of today)\b", "say what is true today"),
    (r"(?-i:\bprocessors?\b)", "CPU, GPU"),
    (r"\bmend(?:s|ed|ing)?\b", "fix"),
    (r"\b(?:is|are) held against\b|\bholds? (?:it|them) against\b", "is compared with, is checked against"),
    (r"\banew\b", "again"),
    (r"\bsome (?:\d+|ten|twenty|thirty|fifty)\b", "about 30"),
    (r"\bof (?:one's|somebody's) own\b", "your own"),
    (r"\bunasked\b", "by default"),
    (r"\b(?:go|goes|going|went) on\b", "continue"),
    (r"\bshall\b", "should, must"),
    (r"\b(?:at hand|by means of|not before long|in the first line|so to speak|what else|of which many|of whom many)\b|\bthe one with the\b.*\bthe other with\b", "plain words"),
    (r"\bis no (?:axis|change|clicks?|colour|direction|file of|film|grid|JSON|list|pair|part|run|session|software)\b(?! folder)", "is not a"),
    (r"\b(?:matrix|row|pose) an? (?:line|pose)\b|\brights of (?:others|somebody)\b|\bformat of the ending\b|\b(?:believed|thought) of\b|\bcalled as\b", "per line; licence; extension"),
]

METRIC = r"(?:PSNR|mIoU|SSIM|AbsRel|AUROC|ECE|accuracy|PQ(?:-scene)?|mCov)"
FIGURE = re.compile(rf"\d[\d.]* ?(?:dB|ms|µs|fps|GFLOP/s|TFLOP/s)\b|\b{METRIC}(?: \([^)]*\))?(?: of| is| was| =|:)? \d?\.?\d+\b"
                    r"|\b(?:takes?|took|after|in|needs?|within) (?:about )?\d[\d.]* (?:s|seconds?|minutes?|MB|GB)\b(?! of training)", re.I)
MEASURED_COLUMN = re.compile(rf"\b(?:{METRIC}|dB|ms|seconds|GFLOP/s|samples per second|SQ|RQ)\b", re.I)
NUMBER = re.compile(r"^[*<>±+\-]*\d[\d.,]*")
DATE = r"\b20\d\d-\d\d(?:-\d\d)?\b|\b\d{1,2} (?:January|February|March|April|May|June|July|August|September|October|November|December) 20\d\d\b"
COMMIT = r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*\d)[0-9a-f]{7,10}\b|\bversion \d+\.\d+\.\d+"
WHEN = re.compile(f"{DATE}|{COMMIT}")
COMMAND = re.compile(r"(?:^|`|\$ )(?:\./)?(?:semfield|scripts/|python3|studies/|train |mpirun)", re.M)
SOURCE_LINK = re.compile(r"\]\((?:[^)\s]*evidence/[^)\s]*|[^)\s]*decisions\.md#[^)\s]*|[^)\s]*\.(?:json|csv|bib)|[^)\s]*README\.md#measured)\)")


def words_of(text):
    text = re.sub(r"\]\([^)]*\)", "]", COMMENT.sub("", FENCE.sub("", text)))
    return sum(1 for token in text.split() if re.search(r"[^\W\d_]", token))


def banned_of(text):
    """(what is said, what to say) of each phrase."""
    plain = re.sub(r"\]\([^)]*\)", "]", CODE_SPAN.sub("``", COMMENT.sub("", FENCE.sub("\n", text))))
    joined = re.sub(r"[ \t]*\n(?=[^\n|#*-])", " ", plain)
    return [(match[0], instead) for phrase, instead in BANNED for match in re.finditer(phrase, joined, re.I)]


def messages_of(root):
    """(file and line, text) of the literals in sources that have more than one word."""
    endings = (".cpp", ".h", ".cu", ".py", ".js", ".html")
    for path, source in sources_in(root, ("app", "framework", "plugins", "python"), endings):
        for number, line in enumerate(source.split("\n"), 1):
            found = [] if line.lstrip().startswith(("//", "#", "*")) else LITERAL.findall(line)
            yield from ((f"{path}:{number}", text) for text in map("".join, found) if " " in text)


def sections_of(text):
    """{anchor: (heading, own text, text of the headings above)} of a page."""
    above, out = [], {}
    parts = ["", ""] + re.split(r"^(#+) +(.*)$", text, flags=re.M)
    for depth, heading, own in zip(parts[0::3], parts[1::3], parts[2::3]):
        above = above[:max(0, len(depth) - 1)] + [""] * (len(depth) - 1 - len(above))
        out[anchor_of(heading)] = (heading, own, "\n".join(above))
        above.append(own)
    return out


def figures_of(own):
    """Measured numbers of a section."""
    found, columns = [], []
    for line in COMMENT.sub("", FENCE.sub("", own)).split("\n"):
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        columns = columns or [bool(MEASURED_COLUMN.search(cell)) for cell in cells] if cells else []
        found += [cell for cell, measured in zip(cells, columns) if measured and NUMBER.match(cell)]
        found += [m[0] for cell, measured in zip(cells or [line], columns or [False]) if not measured for m in FIGURE.finditer(cell)]
    return found


def has_source(section, sections):
    """Whether a section has a source, says where in its page one is, or links to where one is."""
    _, own, above = section
    if SOURCE_LINK.search(own) or WHEN.search(own + above) and COMMAND.search(own + above):
        return True
    return any(has_source(sections[anchor], {}) for anchor in re.findall(r"\]\(#([^)\s]+)\)", own) if anchor in sections)


def anchor_of(heading):
    """Lower case, punctuation dropped, blanks to hyphens."""
    return re.sub(r"[^\w\- ]", "", re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()).replace(" ", "-")


def anchors_of(text):
    """Anchors of a page; one that is there gets a number."""
    anchors = set()
    for base in map(anchor_of, re.findall(r"^#+ +(.*?) *$", FENCE.sub("", text), re.M)):
        anchors.add(next(anchor for anchor in (base, *(f"{base}-{number}" for number in range(1, 1000))) if anchor not in anchors))
    return anchors


def is_external(target):
    return re.match(r"[a-z][a-z0-9+.-]*:", target) is not None


def fault_of_address(target):
    """What is wrong with the form of an address elsewhere; None when nothing is."""
    address = urllib.parse.urlsplit(target)
    if address.scheme not in ("http", "https"):
        return "a link starts with https://, or is relative"
    return None if re.fullmatch(r"(localhost|127\.0\.0\.1|[\w-]+(\.[\w-]+)+)", address.hostname or "") else "no name of a host"


def check(root, pages):
    """Number of links, and a sentence for each fault. Pages are those of the tree, where links to generated pages are taken as they are, or the built ones."""
    anchors = {path: anchors_of(text) for path, text in pages.items()}
    count, faults, reached = 0, [], set()
    for path, text in pages.items():
        prose = re.sub(r"<!--.*?-->\n?", "", FENCE.sub("\n", text), flags=re.S)
        faults += [f"{path}: '{line}' is shown as text; an empty line before a list or table is missing" for line in RUN_ON.findall(prose)]
        faults += [f"{path}: '{tag}': Markdown has links and images" for tag in HTML.findall(LINK.sub("", prose))]
        for target in links_of(text):
            count += 1
            if is_external(target):
                fault = fault_of_address(target)
                faults += [f"{path}: {target}: {fault}"] if fault else []
                continue
            name, _, anchor = target.partition("#")
            file = resolve(path, name) if name else path
            reached.add(file)
            if file.startswith("..") or not (file in pages or file in GENERATED or os.path.exists(os.path.join(root, file))):
                faults.append(f"{path}: {target}: no such file")
            elif anchor and file in anchors and anchor not in anchors[file]:
                faults.append(f"{path}: {target}: {file} has no heading of that name")
    index = "docs/index.md"
    listed = {resolve(index, link) for link in links_of(pages.get(index, "").partition("\n## All pages\n")[2])}
    faults += [f"{index}: lists no {page} under 'All pages'" for page in pages if listed and page not in listed and (page.startswith("docs/") or "/" not in page)]
    made, book = "", os.path.join(root, "docs/images/made.json")
    if os.path.exists(book):
        with open(book, encoding="utf-8") as file:
            made = file.read()
    for where, _, names in os.walk(os.path.join(root, "docs")):
        for file in (resolve("", os.path.relpath(os.path.join(where, name), root)) for name in names):
            if not file.endswith((".md", ".css")) and file not in reached:
                faults.append(f"{file}: no page links to it")
            if file.endswith((".jpg", ".png", ".gif")) and f'"{os.path.basename(file)}"' not in made:
                faults.append(f"{file}: scripts/pictures did not make it")
            if file.endswith(".css"):
                with open(os.path.join(root, file), encoding="utf-8") as sheet:
                    faults += [f"{file}: {address}: is loaded from another host" for address in LOADED.findall(sheet.read())]
    return count, faults


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print the words of each page")
    parser.add_argument("--pages", help="folder that the target docs_pages wrote")
    parser.add_argument("--root", default=REPOSITORY, help="the repository to check: this one")
    options = parser.parse_args()
    pages = pages_of(options.root)
    built = pages_of(options.pages) if options.pages else pages
    links, broken = check(options.root, built)
    texts = [*sorted(built.items()), *messages_of(options.root)]
    said = [f"{place}: '{phrase}': write: {instead}" for place, text in texts for phrase, instead in banned_of(text)]
    faults = broken + said
    for name, source in sources_of(options.root).items():
        lacks = [key for key in SOURCE if not source.get(key)]
        faults += [f"docs/evidence/{name}: has no {', '.join(lacks)}; its script writes them, or docs/evidence/sources.json has them"] if lacks else []
    figures = without = words = 0
    for path, text in sorted(pages.items()):
        words += words_of(text)
        if options.list:
            print(f"{words_of(text):6} {path}")
        if path.startswith(HISTORY):
            continue
        # Links between pages of evidence name no folder.
        sections = sections_of(re.sub(r"\]\((?=\w+\.md)", "](evidence/", text) if path.startswith("docs/evidence/") else text)
        for section in sections.values():
            found = figures_of(section[1])
            figures += len(found)
            if found and not has_source(section, sections):
                without += len(found)
                faults.append(f"{path}: '{section[0]}' has {len(found)} figures without a source, such as '{found[0]}'")
    readme = len(pages.get("README.md", "").split())
    faults += [f"{words} words; at most {MOST_WORDS} are read"] if words > MOST_WORDS else []
    faults += [f"README.md: {readme} words; at most {MOST_README_WORDS}"] if readme > MOST_README_WORDS else []
    for fault in faults:
        print(f"docs_check: {fault}", file=sys.stderr)
    print(f"docs: words={words} figures={figures} figures_without_source={without} links={links} links_broken={len(broken)} banned_phrases={len(said)} readme_words={readme}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
