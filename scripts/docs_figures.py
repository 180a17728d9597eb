"""Tables of pages that are made from docs/evidence/benchmark.json, for docs_check.

A page asks for one by a pair of comments; what is between them is replaced:

  <!-- figures benchmark: lego 60 cpu, lego 60 gpu, room 60 cpu -->  rows by scene, seconds and device
  <!-- /figures -->

Each row has its device, date and commit, so that a figure in a page is that of a run that scripts/benchmark made. A row that the data lacks is an error."""
import json
import os
import re

DATA = "docs/evidence/benchmark.json"
PART = re.compile(r"(<!-- figures benchmark: (?P<rows>[^>]*?) -->\n).*?(<!-- /figures -->)", re.S)
HEAD = "| scene, preset | trained for | PSNR | mIoU | device | date, commit |\n|---|---|---|---|---|---|\n"
NAMES = {"lego": "lego, an object", "bonsai": "bonsai, a table in its room", "room": "shipped room, labels on 10 % of the frames", "walk": "Replica walk, all labels",
         "classroom": "modelled classroom, all labels", "studio": "studio room, 35 photos", "record3d": "door, scanned by a phone", "hololens": "room, scanned by a HoloLens",
         "llff_room": "LLFF room"}


def chosen(rows, asked):
    """The newest row of a scene, a time and a kind of device: 'lego 60 cpu'."""
    scene, seconds, device = asked.split()
    found = [row for row in rows if row["scene"] == scene and row["seconds"] == float(seconds) and row["device"].startswith("NVIDIA") == (device == "gpu")]
    return max(found, key=lambda row: row["date"]) if found else None


def line_of(row):
    device = re.sub(r".*, (\d+) threads", r"\1 CPU threads", row["device"]).replace("NVIDIA ", "").replace(" 80GB HBM3", "")
    miou = f"{row['miou_present']:.3f}" if row.get("miou_present") is not None else "–"
    return (f"| {NAMES[row['scene']]}, `{row['preset']}` | {row['seconds']:.0f} s | {row['psnr']:.1f} dB | {miou} | {device} | {row['date']}, {row['commit']} |\n")


def renewed(path, text, rows, faults):
    def part(match):
        out = HEAD
        for asked in match["rows"].split(", "):
            row = chosen(rows, asked)
            if row is None:
                faults.append(f"{path}: {DATA} has no row '{asked}'; measure it with scripts/benchmark")
            else:
                out += line_of(row)
        return match[1] + out + match[3]
    return PART.sub(part, text)


def stale(root, pages, write):
    """Sentences about parts that are not what the data say; with `write` they are renewed instead."""
    asking = {path: text for path, text in pages.items() if PART.search(text)}
    if not asking:
        return []
    with open(os.path.join(root, DATA), encoding="utf-8") as file:
        rows = json.load(file)
    faults = []
    for path, text in asking.items():
        fresh = renewed(path, text, rows, faults)
        if fresh == text:
            continue
        if write:
            with open(os.path.join(root, path), "w", encoding="utf-8") as file:
                file.write(fresh)
        else:
            faults.append(f"{path}: a table of figures is not that of {DATA}; run scripts/docs_check --write")
    return faults


def figures_of(text):
    """Numbers in such parts."""
    return re.findall(r"(?<=\| )(?:[\d.]+ dB|0\.\d+)(?= \|)", "".join(match[0] for match in PART.finditer(text)))
