"""What a release has to show, in one line."""
import json
import re
import subprocess

from . import common, figures, hand_over

PROGRAM = ("framework", "plugins", "configs")  # what figures depend on
COMMIT = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*\d)[0-9a-f]{8}\b")


def counted(word, *words):
    """A figure of the last line of a script, which may fail by it."""
    done = subprocess.run([str(common.ROOT / words[0]), *words[1:]], capture_output=True, text=True)
    return int(re.search(rf"\b{word}=(\d+)", done.stdout)[1])


def is_old(commit):
    """Whether what figures depend on has changed since the commit."""
    try:
        return bool(common.run("git", "-C", common.ROOT, "diff", "--name-only", commit, "HEAD", "--", *PROGRAM).strip())
    except common.Failed:
        return True


def evidence():
    """Rows of evidence: {place: commits}."""
    for page in [common.ROOT / "README.md", *sorted((common.ROOT / "docs/evidence").iterdir())]:
        text = page.read_text(encoding="utf-8")
        if page.suffix == ".json":
            rows = json.loads(text)
            rows = rows.values() if isinstance(rows, dict) else rows
            yield from ((page.name, COMMIT.findall(json.dumps(row))) for row in rows)
        elif page.suffix == ".md":
            yield from ((page.name, COMMIT.findall(line)) for line in text.split("\n"))


def release(run, old: "FOLDER of what 1.0.0 made, as first_minute --runs takes it", *, build=common.BUILD):
    """Asks first_minute, pages, scripts/pictures and the documents. A row of evidence is old if framework, plugins or
configs differ from those of a commit that it names; the last line counts them, for files as for tables."""
    found = figures.first_minute(only=("terminal", "old"), program=build, runs=old)
    found |= hand_over.pages(run, build=build)
    found["pictures_stale"] = counted("stale", "scripts/pictures", "--stale")
    rows = [(place, commits) for place, commits in evidence() if commits]
    aged = {commit: is_old(commit) for commit in {one for _, commits in rows for one in commits}}
    old_rows = [place for place, commits in rows if all(aged[commit] for commit in commits)]
    for place in sorted(set(old_rows)):
        common.say(f"{place}: {old_rows.count(place)} old rows")
    found["evidence_rows_old"] = len(old_rows)
    found["words"] = counted("words", "tests/docs/docs_check.py", "--root", str(common.ROOT))
    return found
