"""The table of figures of objects, of runs."""
import datetime
import hashlib
import json
import pathlib
import statistics

from docs_parts import half_width

from . import common

ROOMS = ("living", "class", "room")
EXACT = ("objects.damage.shuffle=true",)
WORSE = (*EXACT, *(f"objects.damage.{what}" for what in ("split=0.2", "merge=0.2", "missing=0.2", "border_px=2")))
CASES = {"exact": EXACT, "degraded": WORSE, "assignment": (*EXACT, "objects.method={type: assignment, slots: 160}")}


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
