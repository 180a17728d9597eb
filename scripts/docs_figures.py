"""Tables of pages that are made from the data in docs/evidence, for docs_check.

A page asks for one by a pair of comments; what is between them is replaced:

  <!-- figures benchmark: lego 60 cpu, lego 60 gpu, room 60 cpu -->  rows by scene, seconds and device, of benchmark.json
  <!-- /figures -->
  <!-- figures rows: all -->  every row of it
  <!-- /figures -->
  <!-- figures labels: walk -->  a scene's rows by label setting, of gpu_cells.csv and gpu_cells_h100.csv
  <!-- /figures -->
  <!-- figures objects: living, class -->  rooms by their segments, of objects.json; `means` is a row of means over the first three
  <!-- /figures -->
  <!-- figures settings: objects -->  rows by variant of a sweep, of objects_settings.csv
  <!-- /figures -->
  <!-- figures sources: all -->  where each file of data comes from
  <!-- /figures -->

A row that the data lacks is an error. Means of several seeds have half their 95 % interval (Student's t) and the number of seeds.

Every file of data has a date, a commit, a device, the command that wrote it and the number n of runs behind a figure: as its own members, in each of its rows,
or, where the format has no room for them, in sources.json."""
import collections
import csv
import json
import math
import os
import re
import statistics

EVIDENCE = "docs/evidence"
DATA = f"{EVIDENCE}/benchmark.json"
SOURCE = ("date", "commit", "device", "command", "n")
CELLS = {"paper": ("docs/evidence/gpu_cells.csv", "labels_paper"), "preset": ("docs/evidence/gpu_cells_h100.csv", "labels_fast"),
         "grid": ("docs/evidence/gpu_cells.csv", "labels_today")}
SETTINGS = ["all", "click", "1 %", "10 %", "90 % noise", "two key-frames", "10 % of the frames", "sparse x 16"]
LABELS_HEAD = ("| labels | mIoU: paper's networks | room preset | grid alone | PSNR: paper | preset | AbsRel: paper | preset | ECE: paper | preset |\n"
               "|---|---|---|---|---|---|---|---|---|---|\n")
STUDENT = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}
PART = re.compile(r"(<!-- figures (?P<kind>benchmark|rows|labels|objects|settings|sources): (?P<rows>[^>]*?) -->\n).*?(<!-- /figures -->)", re.S)
HEAD = "| scene, preset | trained for | PSNR | mIoU | device | date, commit |\n|---|---|---|---|---|---|\n"
NAMES = {"lego": "lego, an object", "bonsai": "bonsai, a table in its room", "room": "shipped room, labels on 10 % of the frames", "walk": "Replica walk, all labels",
         "classroom": "modelled classroom, all labels", "studio": "studio room, 35 photos", "record3d": "door, scanned by a phone", "hololens": "room, scanned by a HoloLens",
         "llff_room": "LLFF room"}
ROOMS = {"living": "living room", "class": "classroom", "room": "shipped room", "replica": "Replica apartment 0"}
SEGMENTS = {"exact": "exact", "degraded": "made worse", "assignment": "exact, `assignment`", "peer": "exact, peer in PyTorch",
            "degraded_peer": "made worse, peer in PyTorch"}
OBJECTS_HEAD = "| room | segments | PQ-scene | SQ | RQ | mCov | objects miscounted | seconds |\n|---|---|---|---|---|---|---|---|\n"


def chosen(rows, asked):
    """The newest row of a scene, a time and a kind of device: 'lego 60 cpu'."""
    scene, seconds, device = asked.split()
    found = [row for row in rows if row["scene"] == scene and row["seconds"] == float(seconds) and row["device"].startswith("NVIDIA") == (device == "gpu")]
    return max(found, key=lambda row: row["date"]) if found else None


def line_of(row):
    device = re.sub(r".*, (\d+) threads", r"\1 CPU threads", row["device"]).replace("NVIDIA ", "").replace(" 80GB HBM3", "")
    miou = f"{row['miou_present']:.3f}" if row.get("miou_present") is not None else "–"
    return (f"| {NAMES[row['scene']]}, `{row['preset']}` | {row['seconds']:.0f} s | {row['psnr']:.1f} dB | {miou} | {device} | {row['date']}, {row['commit']} |\n")


def rows_table(rows):
    """All of benchmark.json, for docs/evidence/benchmark.md."""
    def cell(row, key, digits):
        return f"{row[key]:.{digits}f}" if key in row else "–"
    out = ("| scene | preset | training | steps | PSNR, dB | mean of views | SSIM | AbsRel | mIoU | views | device | date, commit |\n|" + "---|" * 12 + "\n")
    for row in rows:
        out += (f"| {row['scene']} | `{row['preset']}` | {row['seconds']:g} s | {row['steps']} | {cell(row, 'psnr', 2)} | {cell(row, 'psnr_of_views', 2)} | {cell(row, 'ssim', 3)} | "
                f"{cell(row, 'absrel', 3)} | {cell(row, 'miou_present', 3)} | {row.get('frames', '–')} | {row['device']} | {row['date']}, {row['commit']} |\n")
    return out


def cells_of(root):
    """{(column, scene, setting, metric): [value of each seed]}"""
    cells = collections.defaultdict(list)
    for column, (name, experiment) in CELLS.items():
        with open(os.path.join(root, name), encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if row["experiment"] == experiment and row["value"]:
                    cells[column, row["scene"], row["variant"], row["metric"]].append(float(row["value"]))
    return cells


def mean_of(values, digits):
    if not values:
        return "–"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    half = STUDENT[len(values)] * statistics.stdev(values) / math.sqrt(len(values))
    return f"{statistics.mean(values):.{digits}f} ± {half:.{digits}f} ({len(values)})"


def labels_table(cells, scene):
    out = LABELS_HEAD
    for setting in SETTINGS:
        def of(column, metric, digits=3):
            return mean_of(cells[column, scene, setting, metric], digits)
        out += f"| {setting} | {of('paper', 'miou_present')} | {of('preset', 'miou_present')} | {of('grid', 'miou_present')} "
        for metric, digits in (("psnr", 1), ("absrel", 3), ("ece", 3)):
            values = cells["preset", scene, setting, metric]
            out += f"| {of('paper', metric, digits)} | {mean_of([statistics.mean(values)] if values else [], digits)} "
        out += "|\n"
    return out


def read_json(root, name):
    with open(os.path.join(root, EVIDENCE, name), encoding="utf-8") as file:
        return json.load(file)


def objects_table(rows, rooms):
    """Rows by room and segments; the mean of a room without such segments is left out."""
    def line(name, case, found, mean):
        cells = [mean([one[key] for one in found if key in one], 3) for key in ("pq", "sq", "rq", "mcov", "count_error")]
        return f"| {name} | {SEGMENTS[case]} | {' | '.join(cells)} | {statistics.mean(one['seconds'] for one in found):.1f} |\n"
    out = OBJECTS_HEAD
    for room in rooms:
        for case in SEGMENTS:
            if room != "means" and f"{room}/{case}" in rows:
                out += line(ROOMS[room], case, rows[f"{room}/{case}"], mean_of)
            elif room == "means" and all(f"{one}/{case}" in rows for one in list(ROOMS)[:3]):
                found = [run for one in list(ROOMS)[:3] for run in rows[f"{one}/{case}"]]
                out += line("means of the three", case, found, lambda values, digits: mean_of([statistics.mean(values)] if values else [], digits))
    return out


def settings_table(root, name):
    """Of a sweep's results.csv: a row per variant, a column per metric, in their order."""
    cells = collections.defaultdict(list)
    with open(os.path.join(root, EVIDENCE, f"{name}_settings.csv"), encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["value"]:
                cells[row["variant"], row["metric"]].append(float(row["value"]))
    metrics = list(dict.fromkeys(metric for _, metric in cells))
    out = f"| setting | {' | '.join(f'`{metric}`' for metric in metrics)} |\n|{'---|' * (1 + len(metrics))}\n"
    for variant in dict.fromkeys(variant for variant, _ in cells):
        out += f"| {variant} | {' | '.join(mean_of(cells[variant, metric], 1 if metric.endswith('_s') else 3) for metric in metrics)} |\n"
    return out


def source_of(root, name, written):
    """{member of SOURCE: what the file or sources.json states}; what rows state is joined."""
    stated = {}
    if name.endswith(".json"):
        data = read_json(root, name)
        rows = data if isinstance(data, list) else [data]
        for key in SOURCE:
            values = sorted({str(row[key]) for row in rows if row.get(key) is not None}) if all(key in row for row in rows) else []
            if len(values) > 2:
                values = [f"{values[0]} to {values[-1]}"] if key == "date" else [f"{len(values)} of them, in its rows"]
            if values:
                stated[key] = "; ".join(values)
    return {**written.get(name, {}), **stated}


def sources_of(root):
    """{file of data: its source}"""
    folder = os.path.join(root, EVIDENCE)
    names = sorted(name for name in os.listdir(folder) if name.endswith((".json", ".csv")) and name != "sources.json") if os.path.isdir(folder) else []
    written = read_json(root, "sources.json") if os.path.exists(os.path.join(folder, "sources.json")) else {}
    return {name: source_of(root, name, written) for name in names}


def sourceless(root):
    """Sentences about files of data that do not state where they come from."""
    for name, source in sources_of(root).items():
        missing = [key for key in SOURCE if not source.get(key)]
        if missing:
            yield f"{EVIDENCE}/{name}: has no {', '.join(missing)}; its script writes them, or {EVIDENCE}/sources.json has them"


def sources_table(root, page):
    out = "| data | date | commit | device | command | n |\n|---|---|---|---|---|---|\n"
    for name, source in sources_of(root).items():
        cells = [f"`{source[key]}`" if key == "command" else str(source[key]) for key in SOURCE if key in source]
        out += f"| [{name}]({os.path.relpath(f'{EVIDENCE}/{name}', os.path.dirname(page))}) | {' | '.join(cells)} |\n"
    return out


def renewed(path, text, root, faults):
    def part(match):
        if match["kind"] == "labels":
            return match[1] + labels_table(cells_of(root), match["rows"]) + match[4]
        if match["kind"] == "objects":
            return match[1] + objects_table(read_json(root, "objects.json")["rows"], match["rows"].split(", ")) + match[4]
        if match["kind"] == "settings":
            return match[1] + settings_table(root, match["rows"]) + match[4]
        if match["kind"] == "sources":
            return match[1] + sources_table(root, path) + match[4]
        rows = read_json(root, "benchmark.json")
        if match["kind"] == "rows":
            return match[1] + rows_table(rows) + match[4]
        out = HEAD
        for asked in match["rows"].split(", "):
            row = chosen(rows, asked)
            if row is None:
                faults.append(f"{path}: {DATA} has no row '{asked}'; measure it with scripts/benchmark")
            else:
                out += line_of(row)
        return match[1] + out + match[4]
    return PART.sub(part, text)


def stale(root, pages, write):
    """Sentences about parts that are not what the data say; with `write` they are renewed instead."""
    faults = list(sourceless(root))
    for path, text in pages.items():
        fresh = renewed(path, text, root, faults)
        if fresh == text:
            continue
        if write:
            with open(os.path.join(root, path), "w", encoding="utf-8") as file:
                file.write(fresh)
        else:
            faults.append(f"{path}: a table of figures is not that of the data in docs/evidence; run scripts/docs_check --write")
    return faults


def figures_of(text):
    """Numbers in such parts."""
    return re.findall(r"(?<=\| )(?:[\d.]+ dB|\d+\.\d+)(?= [|±])", "".join(match[0] for match in PART.finditer(text)))
