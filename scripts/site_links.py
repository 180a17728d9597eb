"""Pages of the tree, their links and anchors, and what is wrong with them."""
import os
import re
import urllib.parse

NOT_OURS = re.compile(r"\.|build|(?:runs|out|data|__pycache__)$")
GENERATED = {f"docs/reference/{name}.md" for name in ("codes", "cpp", "plugins", "python", "verbs")}  # by the target docs_pages
FENCE = re.compile(r"^(`{3,})[^`\n]*\n.*?^\1`*[ ]*$\n?", re.M | re.S)
# A code span, or the target of a link or an image.
LINK = re.compile(r"(?P<code>(?<!`)(?P<ticks>`+)(?!`).*?(?<!`)(?P=ticks)(?!`))|\]\((?P<target>[^)\s]+)(?:\s+\"[^\"]*\")?\)", re.S)
# What only the site would show: a list or table that an empty line has to separate from the text above, HTML that loads or links.
RUN_ON = re.compile(r"(?:\A|\n\n)(?![-*|] |[#<>\s]|\d+\. )[^\n]+(?:\n[^\n]+)*?\n((?:[-*|] |\d+\. )[^\n]*)")
LOADED = re.compile(r"(?:url\(|@import )[\"']?((?:https?:)?//[^\"')]+)")
HTML = re.compile(r"<(?:a|img|script|link|iframe)\b[^>]*")


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


def links_of(text):
    return [m["target"] for m in LINK.finditer(FENCE.sub("", text)) if m["target"]]


def anchor_of(heading):
    """Lower case, punctuation dropped, blanks to hyphens."""
    return re.sub(r"[^\w\- ]", "", re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()).replace(" ", "-")


def anchors_of(text):
    """Anchors of a page; one that is there gets a number."""
    anchors = set()
    for base in map(anchor_of, re.findall(r"^#+ +(.*?) *$", FENCE.sub("", text), re.M)):
        anchors.add(next(anchor for anchor in (base, *(f"{base}-{number}" for number in range(1, 1000))) if anchor not in anchors))
    return anchors


def resolve(page, target):
    """Path in the repository of what `target` means in `page`."""
    return os.path.normpath(os.path.join(os.path.dirname(page), urllib.parse.unquote(target))).replace(os.sep, "/")


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
    for where, _, names in os.walk(os.path.join(root, "docs")):
        for file in (resolve("", os.path.relpath(os.path.join(where, name), root)) for name in names):
            if not file.endswith((".md", ".css")) and file not in reached:
                faults.append(f"{file}: no page links to it")
            if file.endswith(".css"):
                with open(os.path.join(root, file), encoding="utf-8") as sheet:
                    faults += [f"{file}: {address}: is loaded from another host" for address in LOADED.findall(sheet.read())]
    return count, faults
