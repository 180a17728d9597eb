"""Tables of pages that are made from the data in docs/evidence when the pages are built (scripts/docs_pages). A page asks for one by a comment:

  <!-- table benchmark.json: scene seconds psnr -->                     a row per row of a list, these members as columns
  <!-- table objects.json: pq mcov -->                                  a row per group of runs: means over its runs
  <!-- table gpu_cells.csv scene=walk experiment=labels_paper|labels_today: miou_present psnr -->   a row per variant of sweeps, some rows of theirs
  <!-- sources -->                                                      where each file of data comes from

Means of several seeds have half their 95 % interval (Student's t) and the number of seeds.

Every file of data has a date, a commit, a device, the command that wrote it and the number n of runs behind a figure: as its own members, in each of its rows,
or, where the format has no room for them, in sources.json."""
import csv
import json
import math
import os
import re
import statistics

EVIDENCE = "docs/evidence"
SOURCE = ("date", "commit", "device", "command", "n")
STUDENT = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}
MARK = re.compile(r"<!-- table (?P<files>[^:>]*): (?P<columns>[^>]*?) -->\n|<!-- sources -->\n")


def read_json(root, name):
    with open(os.path.join(root, EVIDENCE, name), encoding="utf-8") as file:
        return json.load(file)


def mean_of(values):
    if not values or isinstance(values[0], str):
        return values[0] if values else "–"
    if len(values) == 1 and values[0] == int(values[0]):
        return f"{values[0]:.0f}"
    digits = 1 if max(values) >= 10 else 3
    mean = f"{statistics.mean(values):.{digits}f}"
    if len(values) == 1:
        return mean
    return f"{mean} ± {STUDENT[len(values)] * statistics.stdev(values) / math.sqrt(len(values)):.{digits}f} ({len(values)})"


def rows_of(root, words):
    """(name of the row, column, value) of files of data; words are names of files and filters KEY=VALUE|VALUE."""
    filters = dict(word.split("=") for word in words if "=" in word)
    for name in (word for word in words if "=" not in word):
        if name.endswith(".csv"):
            with open(os.path.join(root, EVIDENCE, name), encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    if row["value"] and all(row[key] in allowed.split("|") for key, allowed in filters.items()):
                        many = "|" in filters.get("experiment", "")
                        yield row["variant"], row["metric"] + (f", {row['experiment']}" if many else ""), float(row["value"])
            continue
        data = read_json(root, name)
        groups = ((i, [row]) for i, row in enumerate(data)) if isinstance(data, list) else data["rows"].items()
        for group, runs in groups:
            for run in runs:
                yield from ((group, key, value) for key, value in run.items() if not isinstance(value, (dict, list)))


def table_of(root, files, columns):
    cells = {}
    for row, column, value in rows_of(root, files):
        cells.setdefault(row, {}).setdefault(column, []).append(value)
    found = list(dict.fromkeys(column for row in cells.values() for column in row))
    shown = [column for asked in columns for column in found if column == asked or column.startswith(asked + ", ")]
    lost = [asked for asked in columns if not any(column.split(", ")[0] == asked for column in shown)]
    if lost:
        raise SystemExit(f"docs_tables: {' '.join(files)} has no {', '.join(lost)}")
    named = isinstance(next(iter(cells)), str)
    out = f"|{' |' * named} {' | '.join(shown)} |\n|{'---|' * (named + len(shown))}\n"
    for name, row in cells.items():
        out += f"|{f' {name} |' * named} {' | '.join(mean_of(row.get(column, [])) for column in shown)} |\n"
    return out


def sources_of(root):
    """{file of data: {member of SOURCE: what it or sources.json states}}; what rows state is joined."""
    folder = os.path.join(root, EVIDENCE)
    names = sorted(name for name in os.listdir(folder) if name.endswith((".json", ".csv")) and name != "sources.json") if os.path.isdir(folder) else []
    out = dict(read_json(root, "sources.json")) if os.path.exists(os.path.join(folder, "sources.json")) else {}
    for name in names:
        data = read_json(root, name) if name.endswith(".json") else []
        rows = data if isinstance(data, list) else [data]
        stated = {key: sorted({str(row[key]) for row in rows}) for key in SOURCE if rows and all(row.get(key) is not None for row in rows)}
        out[name] = {**out.get(name, {}), **{key: "; ".join(values if len(values) < 3 else [values[0], "…", values[-1]]) for key, values in stated.items()}}
    return {name: out[name] for name in names}


def sources_table(root):
    out = "| data | date | commit | device | command | n |\n|---|---|---|---|---|---|\n"
    for name, source in sources_of(root).items():
        out += f"| [{name}]({name}) | {' | '.join(f'`{source[key]}`' if key == 'command' else str(source[key]) for key in SOURCE)} |\n"
    return out


def filled(root, text):
    return MARK.sub(lambda m: table_of(root, m["files"].split(), m["columns"].split()) if m["files"] else sources_table(root), text)
