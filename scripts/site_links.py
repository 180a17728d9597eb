"""Links and anchors of the repository's Markdown and of the pages that are built from it."""
import html.parser
import os
import re
import urllib.parse

NOT_OURS = {"build", "runs", "out", "data", "__pycache__"}
FENCE = re.compile(r"^(`{3,})[^`\n]*\n.*?^\1`*[ ]*$\n?", re.M | re.S)
# A code span, or the target of a link or an image.
LINK = re.compile(r"(?P<code>(?<!`)(?P<ticks>`+)(?!`).*?(?<!`)(?P=ticks)(?!`))|\]\((?P<target>[^)\s]+)(?:\s+\"[^\"]*\")?\)", re.S)


def pages_of(root):
    """{path: text} of every Markdown file of the repository."""
    pages = {}
    for where, folders, names in os.walk(root):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f not in NOT_OURS and not f.startswith("build"))
        for name in sorted(names):
            if name.endswith(".md"):
                path = os.path.join(where, name)
                with open(path, encoding="utf-8") as file:
                    pages[os.path.relpath(path, root).replace(os.sep, "/")] = file.read()
    return pages


def parts(text):
    """(is fenced, text) of a page, in order."""
    at = 0
    for fence in FENCE.finditer(text):
        yield False, text[at:fence.start()]
        yield True, fence[0]
        at = fence.end()
    yield False, text[at:]


def links_of(text):
    return [m["target"] for fenced, part in parts(text) if not fenced for m in LINK.finditer(part) if m["target"]]


def anchors_of(text):
    """Anchors that headings get: lower case, punctuation dropped, blanks to hyphens."""
    anchors = set()
    prose = "".join(part for fenced, part in parts(text) if not fenced)
    for heading in re.findall(r"^#+ +(.*?) *$", prose, re.M):
        shown = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        base = re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")
        anchor, number = base, 0
        while anchor in anchors:
            number += 1
            anchor = f"{base}-{number}"
        anchors.add(anchor)
    return anchors


def resolve(page, target):
    """Path in the repository of what `target` means in `page`."""
    return os.path.normpath(os.path.join(os.path.dirname(page), urllib.parse.unquote(target))).replace(os.sep, "/")


def is_external(target):
    return re.match(r"[a-z][a-z0-9+.-]*:", target) is not None


def fault_of_address(target):
    """What is wrong with the form of an address elsewhere; None when nothing is."""
    address = urllib.parse.urlsplit(target)
    if address.scheme == "mailto":
        return None if re.fullmatch(r"[^@\s]+@[^@\s]+\.[^@\s]+", address.path) else "no address of mail"
    if address.scheme not in ("http", "https"):
        return "a link starts with https://, or is relative"
    return None if re.fullmatch(r"(localhost|127\.0\.0\.1|[\w-]+(\.[\w-]+)+)", address.hostname or "") else "no name of a host"


def check_markdown(root, pages):
    """Number of links, and a sentence for each that is broken."""
    anchors = {path: anchors_of(text) for path, text in pages.items()}
    count, broken, reached = 0, [], set()
    for path, text in pages.items():
        for target in links_of(text):
            count += 1
            if is_external(target):
                fault = fault_of_address(target)
                if fault:
                    broken.append(f"{path}: {target}: {fault}")
                continue
            name, _, anchor = target.partition("#")
            file = resolve(path, name) if name else path
            reached.add(file)
            if file.startswith("..") or not os.path.exists(os.path.join(root, file)):
                broken.append(f"{path}: {target}: no such file")
            elif anchor and file in anchors and anchor not in anchors[file]:
                broken.append(f"{path}: {target}: {file} has no heading of that name")
    for where, _, names in os.walk(os.path.join(root, "docs")):
        files = (resolve("", os.path.relpath(os.path.join(where, name), root)) for name in names)
        broken += [f"{file}: no page links to it" for file in files if not file.endswith((".md", ".css")) and file not in reached]
    return count, broken


class Built(html.parser.HTMLParser):
    """Anchors and links of a built page, what it loads, and lines that Markdown left as text."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links, self.loads, self.faults = set(), [], [], []
        self.in_paragraph = self.in_code = False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors.update(given[key] for key in ("id", "name") if given.get(key))
        if tag in ("a", "area") and "href" in given:
            self.links.append(given["href"])
        loaded = given.get("href") if tag == "link" and given.get("rel") not in ("canonical", "next", "prev") else given.get("src")
        if loaded:
            self.loads.append(loaded)
        self.in_paragraph = tag == "p" or (self.in_paragraph and tag not in ("ul", "ol", "table", "pre", "div"))
        self.in_code = self.in_code or tag == "code"

    def handle_endtag(self, tag):
        self.in_paragraph = self.in_paragraph and tag != "p"
        self.in_code = self.in_code and tag != "code"

    def handle_data(self, text):
        if self.in_paragraph and not self.in_code:
            for line in re.findall(r"^(?:[-*|] |\d+\. |```).*", text, re.M):
                self.faults.append(f"'{line}' is shown as text; an empty line before a list or table is missing")


def check_site(out):
    """Number of pages and links of the built site, and a sentence for each fault."""
    built = {}
    for where, _, names in os.walk(out):
        for name in names:
            path = os.path.join(where, name)
            if name.endswith(".html"):
                with open(path, encoding="utf-8") as file:
                    built[path] = Built(file.read())
    count, broken = 0, []
    for path, page in sorted(built.items()):
        name = os.path.relpath(path, out)
        broken += [f"{name}: {fault}" for fault in page.faults]
        for target in page.links + page.loads:
            count += 1
            if is_external(target) or target.startswith("//"):
                fault = "is loaded from another host" if target in page.loads else fault_of_address(target)
                if fault:
                    broken.append(f"{name}: {target}: {fault}")
                continue
            file, _, anchor = urllib.parse.unquote(target).partition("#")
            file = file.partition("?")[0]
            base = out if file.startswith("/") else os.path.dirname(path)
            there = os.path.normpath(os.path.join(base, file.lstrip("/"))) if file else path
            if os.path.isdir(there):
                there = os.path.join(there, "index.html")
            if not os.path.isfile(there):
                broken.append(f"{name}: {target}: no such file")
            elif anchor and there in built and anchor not in built[there].anchors:
                broken.append(f"{name}: {target}: no such anchor")
    for where, _, names in os.walk(out):
        for sheet in (os.path.join(where, name) for name in names if name.endswith(".css")):
            with open(sheet, encoding="utf-8") as file:
                for address in re.findall(r"(?:url\(|@import )[\"']?((?:https?:)?//[^\"')]+)", file.read()):
                    broken.append(f"{os.path.relpath(sheet, out)}: {address}: is loaded from another host")
    return len(built), count, broken
