"""Tables of figures: labels, of a sweep, and objects, of runs."""
import csv
import datetime
import hashlib
import json
import math
import pathlib
import statistics
import sys

from . import common

# 0.975 quantiles of Student's t for two to ten seeds.
STUDENT = dict(enumerate((12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262), 2))
SETTINGS = {"click": "click", "p01": "1 %", "p10": "10 %", "noise90": "90 % noise", "two": "two key-frames",
            "f10": "10 % of the frames", "sr16": "sparse x 16", "all": "all"}
NETWORKS = ("labels_fast", "labels_paper", "labels_today")  # the hash grid with its branch, the paper's, the grid alone
METRICS = {"miou_present": "mIoU", "ece": "ECE", "entropy_auroc": "AUROC of entropy"}

ROOMS = ("living", "class", "room")
EXACT = ("objects.damage.shuffle=true",)
WORSE = (*EXACT, *(f"objects.damage.{what}" for what in ("split=0.2", "merge=0.2", "missing=0.2", "border_px=2")))
CASES = {"exact": EXACT, "degraded": WORSE, "assignment": (*EXACT, "objects.method={type: assignment, slots: 160}")}


def half_width(values):
    """Half of the 95 % interval of a mean."""
    return STUDENT[len(values)] * statistics.stdev(values) / math.sqrt(len(values))


def read(path):
    """{(experiment, variant, metric): {(scene, seed): value}} of a sweep's results."""
    path = path / "results.csv" if path.is_dir() else path
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise common.Failed(f"{path}: {error.strerror}; it is written by semfield sweep") from None
    values = {}
    try:
        for row in rows:
            key = row["experiment"], row["variant"], row["metric"]
            values.setdefault(key, {})[row["scene"], row["seed"]] = float(row["value"])
    except KeyError as key:
        raise common.Failed(f"{path}: there is no column {key}; give the results.csv of a sweep") from None
    return values


def shared_cells(values, metric, variant, networks, scene=None):
    """The cells of each network that all `networks` have, of one scene or of all."""
    of = [values.get((network, variant, metric), {}) for network in networks]
    keys = sorted(key for key in set.intersection(*map(set, of)) if scene in (None, key[0]))
    return [{key: cells[key] for key in keys} for cells in of]


def means(values, metric, variants, networks):
    """Of each network, over the cells that all have of these variants."""
    of = [shared_cells(values, metric, variant, networks) for variant in variants]
    joined = [[value for cells in of for value in cells[i].values()] for i in range(len(networks))]
    return [statistics.mean(found) if found else math.nan for found in joined]


def text(value, digits):
    return "n/a" if math.isnan(value) else f"{value:.{digits}f}"


def cell_text(cells):
    """A mean with half of its 95 % interval, which there is none of where a scene has one seed."""
    if not cells:
        return "n/a"
    of = [[value for key, value in cells.items() if key[0] == scene] for scene in {key[0] for key in cells}]
    mean = statistics.mean(cells.values())
    if min(map(len, of)) < 2:
        return f"{mean:.3f}"
    half = math.hypot(*(half_width(seeds) * len(seeds) / len(cells) for seeds in of))
    return f"{mean:.3f} ± {half:.3f}"


def print_table(values, metric, label, scene):
    rows = {name: shared_cells(values, metric, name, NETWORKS, scene) for name in SETTINGS.values()}
    title = f"{label}, {scene}" if scene else label
    if not any(of[0] for of in rows.values()):
        return print(f"{title}: no cell that all three have\n")
    print(f"| {title} | branch | paper | today | cells |\n|---|---|---|---|---|")
    for name, of in rows.items():
        print(f"| {name} | {' | '.join(map(cell_text, of))} | {len(of[0])} |")
    print()


def label_tables(words):
    """Tables of `semfield sweep configs/experiments/gpu.yaml`: mIoU of present classes, ECE and the AUROC of entropy.

One row a label setting: the hash grid with its semantic branch, the paper's networks and the hash grid alone, each
over the scenes and seeds that all three have, with how many those are. "±" is half of the 95 % interval: Student's t
over the seeds of a scene, the scenes' own half widths combined as independent ones; none where a scene has one seed.
It says nothing about other scenes. The last line has branch/paper of every setting, PSNR as branch/grid over all
settings, and `step`, the time of a step of the branch as a share of that of the grid alone."""
    parser = common.parser_of(label_tables)
    parser.add_argument("path", type=pathlib.Path, nargs="?", default="runs/gpu", metavar="FOLDER",
                        help="a sweep's folder or its results.csv (default: %(default)s)")
    parser.add_argument("--scenes", action="store_true", help="a table of every scene too")
    options = parser.parse_args(words)
    sys.stdout.reconfigure(encoding="utf-8")  # ± in any locale
    values = read(options.path)
    for what in ("frames", "pixels"):
        for variant in SETTINGS.values():
            first, *others = shared_cells(values, what, variant, NETWORKS)
            if any(cells != first for cells in others):
                raise common.Failed(f"{variant}: networks were scored on other {what}: their figures do not compare")
    scenes = sorted({scene for key, cells in values.items() if key[0] in NETWORKS for scene, _ in cells})
    for metric, label in METRICS.items():
        for scene in [None, *(scenes if options.scenes else [])]:
            print_table(values, metric, label, scene)
    line = {name: "/".join(text(mean, 3) for mean in means(values, "miou_present", [variant], NETWORKS[:2]))
            for name, variant in SETTINGS.items()}
    of = {metric: means(values, metric, SETTINGS.values(), NETWORKS[::2]) for metric in ("psnr", "train_s", "steps")}
    line["psnr"] = "/".join(text(mean, 2) for mean in of["psnr"])
    (branch_s, grid_s), (branch_steps, grid_steps) = of["train_s"], of["steps"]
    line["step"] = text(branch_s / branch_steps / (grid_s / grid_steps), 2)
    common.print_line("labels", line, dict.fromkeys(line, ""))
    return 0


def measure_objects(options, room, case, seed):
    settings = (*CASES[case], f"objects.seed={seed}")
    found = common.ask(options.build / "bin" / "semfield", "objects", options.folder / room, "--score",
                       "--out", options.out / f"{room}_{case}", *(word for one in settings for word in ("--set", one)))
    return {**found["score"], "seconds": found["seconds"]["all"]}


def measure_peer(options, room, case, seed):
    damage = ["--damage"] if case == "degraded_peer" else []
    return json.loads(common.run(options.peer, common.ROOT / "studies" / "peers" / "grouping_peer.py",
                                 options.packed / f"{room}.sfpack", "--seed", seed, *damage,
                                 "--device", "cuda" if options.device == "gpu" else "cpu"))


def fingerprint(run):
    """Of what the run has learned: a figure of its field cannot change while this stays."""
    total = hashlib.sha256()
    for file in sorted(file for file in (run / "checkpoints").rglob("*") if file.is_file()):
        total.update(file.name.encode() + file.read_bytes())
    return total.hexdigest()


def source_of(options):
    """Where the figures of this call come from."""
    ran = [json.loads(file.read_text()) for file in sorted(options.folder.glob("*/environment.json"))[:1]]
    device = ran[0].get("device", "cpu").split(",")[0] if ran else options.device
    if device == "cpu":
        device = f"{ran[0]['cpu']}, {ran[0]['threads']} threads" if ran else "CPU"
    command = f"scripts/release_check object_tables RUNS --{options.device}"
    command += " --peer PYTHON --packed FOLDER" if options.peer else ""
    return {"date": datetime.date.today().isoformat(), "commit": common.commit(), "device": device, "command": command,
            "n": options.seeds}


def kept_rows(path, source):
    """Rows of earlier calls of the same commit and device."""
    found = json.loads(path.read_text()) if path and path.exists() else {}
    return found["rows"] if found and all(found[key] == source[key] for key in ("commit", "device")) else {}


def table_row(name, found):
    def cell(key):
        values = [one[key] for one in found if key in one]
        more = f" ± {half_width(values):.3f}" if len(values) > 1 else ""
        return f"{statistics.mean(values):.3f}{more}" if values else "–"

    cells = " | ".join(cell(key) for key in ("pq", "sq", "rq", "mcov", "count_error"))
    return f"| {name.replace('/', ' | ')} | {cells} | {statistics.mean(one['seconds'] for one in found):.1f} |"


def object_tables(words):
    """Objects of rooms whose objects are known, as a table of figures and one line of means.

FOLDER has a trained run for each room, FOLDER/living, FOLDER/class and FOLDER/room, whose scenes hold instances, and
perhaps FOLDER/replica. Of each: exact segments with shuffled numbers, the same made worse (20 % split, 20 % joined, 20
% missing, borders moved by 2 pixels), and the method `assignment` on exact ones, for every seed, with 95 % intervals.
The last line has means over the three rooms and the seeds; n/a is what was not run."""
    parser = common.parser_of(object_tables)
    parser.add_argument("folder", type=pathlib.Path, metavar="FOLDER")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("object_tables"), help="folder of the objects")
    parser.add_argument("--seeds", type=int, default=3, help="how many (default: 3)")
    parser.add_argument("--only", default=",".join((*ROOMS, "replica")), metavar="ROOM,...")
    parser.add_argument("--peer", metavar="PYTHON", help="a Python with PyTorch: runs the peer too")
    parser.add_argument("--packed", type=pathlib.Path, metavar="FOLDER", help="where ROOM.sfpack lie, for --peer")
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE",
                        help="keeps the figures, with those of earlier calls of the same commit and device")
    for device, more in (("gpu", " (default)"), ("cpu", "")):
        parser.add_argument(f"--{device}", action="store_const", const=device, dest="device", default="gpu",
                            help=f"the runs were opened on the {device.upper()}{more}")
    common.add_build(parser)
    options = parser.parse_args(words)
    if options.peer and not options.packed:
        parser.error("--peer needs --packed FOLDER")
    source, unchanged = source_of(options), True
    rows = kept_rows(options.json, source)
    ways = dict.fromkeys(CASES, measure_objects)
    if options.peer:
        ways.update(dict.fromkeys(("peer", "degraded_peer"), measure_peer))
    for room in options.only.split(","):
        if not (options.folder / room).is_dir():
            common.say(f"{room}: no run {options.folder / room}")
            continue
        before = fingerprint(options.folder / room)
        for case, measure in ways.items():
            if room == "replica" and case not in ("exact", "peer"):
                continue
            found = [measure(options, room, case, seed) for seed in range(1, options.seeds + 1)]
            rows[f"{room}/{case}"] = found
            common.say(f"{room} {case}: pq={statistics.mean(one['pq'] for one in found):.3f}")
        unchanged = unchanged and fingerprint(options.folder / room) == before
    if options.json:
        options.json.write_text(json.dumps({**source, "rows": rows}, indent=1))
    if not rows:
        raise common.Failed(f"{options.folder}: no run of {options.only}")
    print("| room | segments | PQ-scene | SQ | RQ | mCov | objects miscounted | seconds |\n" + 8 * "|---" + "|")
    print("\n".join(table_row(*row) for row in rows.items()))

    def mean(case, key, rooms=ROOMS):
        found = [one[key] for room in rooms for one in rows.get(f"{room}/{case}", [])]
        return statistics.mean(found) if found else None

    on_gpu = options.device == "gpu"
    figures = {**{f"{case}_pq": mean(case, "pq") for case in (*CASES, "peer")},
               "replica_pq": mean("exact", "pq", ["replica"]),
               "seconds_gpu": mean("exact", "seconds") if on_gpu else None, "peer_seconds": mean("peer", "seconds"),
               "cpu_pq": None if on_gpu else mean("exact", "pq"),
               "cpu_seconds": None if on_gpu else mean("exact", "seconds"),
               "miou_change": 0 if unchanged else None, "psnr_change": 0 if unchanged else None,
               "count_error": mean("exact", "count_error")}
    common.print_line("objects", figures, dict.fromkeys(figures, ".3f"))
    return 0
