#!/usr/bin/env python3
"""Training steps on 1, 2, ... ranks or GPUs, and whether their bits agree.

    studies/scale.py --only cpu,bits --out FOLDER                        # keeps scale.json
    studies/scale.py --combine docs/evidence/scale.json FOLDER/scale.json --out docs/evidence   # adds figures to the data

A step's time is that of batches of steps in metrics.jsonl of `semfield train`, which mpirun starts for several ranks.
Exit code 1 when bits differ.
"""
import argparse
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile

from common import machine, read, table, today, write

PARTS = ("cpu", "gpu", "bits")
# Rays: on each rank, and of all ranks together.
SIZES = {("paper", "cpu"): (256, 1024), ("hash", "cpu"): (256, 1024), ("paper", "cuda"): (1024, 4096),
         ("hash", "cuda"): (8192, 8192)}
NARROW = {"passes.0.sampler.samples": 8, "passes.1.sampler.samples": 8, "semantics.hidden_width": 16,
          "passes.0.field.width": 32, "passes.0.field.view_width": 16}
HASH_GPU = {"passes.0.sampler.samples": 32, "passes.0.position.log2_entries": 19,
            "passes.0.position.finest_resolution": 2048}


def sizes_of(results, step, device):
    return (16, 32) if results["quick"] else SIZES[step, device]


def ms(seconds):
    """Three digits, and all of those before the point."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.3g}"


def speedup(results, where, step, ranks, strong):
    """(row, rays per second of `ranks` ranks over those of one); (None, None) where either was not measured."""
    rays = sizes_of(results, step, where["device"])[1 if strong else 0]
    rows = {(r["machine"], r["step"], r["ranks"], r["rays"]): r for r in results["rows"]}
    one, many = (rows.get((where["name"], step, n, rays if strong else rays * n)) for n in (1, ranks))
    if not one or not many:
        return None, None
    return many, one["seconds"]["median"] / many["seconds"]["median"] * many["rays"] / one["rays"]


def measured_text(results):
    text = "".join(f"- {m['name']}: {m['about']}.\n" for m in results["machines"])
    for where in results["machines"]:
        for step in ("paper", "hash"):
            rows, (weak, strong) = [], sizes_of(results, step, where["device"])
            for n in sorted({r["ranks"] for r in results["rows"]
                             if (r["machine"], r["step"]) == (where["name"], step)}):
                rows.append([str(n)])
                for is_strong in (True, False):
                    row, factor = speedup(results, where, step, n, is_strong)
                    s = row and row["seconds"]
                    spread = f"{ms(s['median'])} ({ms(s['min'])} .. {ms(s['max'])})" if row else "not measured"
                    rows[-1] += [spread, f"{factor:.2f}" if row else "-"]
            if rows:
                head = ["ranks", f"{strong} rays in all, ms", "x of n", f"{weak} rays per rank, ms", "x of n"]
                ranks = "GPUs" if where["device"] == "cuda" else "CPU ranks"
                text += f"\n{step.capitalize()} step on {ranks}, {where['name']}:\n\n" + table(head, rows)
    if results["bits"]:
        of = {}
        for b in results["bits"]:
            of.setdefault((b["name"], b["machine"]), []).append(b)
        text += "\n" + table(["training", "machine", "ranks x threads", "bits"], [
            [name, where, ", ".join(f"{b['ranks']} x {b['threads']}" for b in rows),
             "; ".join(f"{b['ranks']} x {b['threads']}: {b['difference']}" for b in rows if b["difference"]) or "equal"]
            for (name, where), rows in of.items()])
    return text


def merged(old, fresh):
    """Fresh figures in the place of those of the same measurement."""
    if old["quick"] != fresh["quick"]:
        sys.exit("scale: figures of --quick and others do not go together")
    keys = {"machines": ("name",), "rows": ("machine", "step", "device", "ranks", "rays"),
            "bits": ("machine", "name", "ranks", "threads")}
    out = {"quick": old["quick"]}
    for part, names in keys.items():
        rows = {tuple(r[n] for n in names): r for r in [*old[part], *fresh[part]]}
        out[part] = list(rows.values())
    return out


class Bench:
    def __init__(self, options, folder):
        from semfield.program import program
        self.options, self.folder, self.program, self.runs = options, pathlib.Path(folder), program(), 0
        self.results = {"quick": options.quick, "machines": [], "rows": [], "bits": []}
        e, load = machine(), os.getloadavg()[0]
        about = f"{e['version']}, {e['compiler']}, {e['build_type']}, {today()}, load {load:.1f} before"
        self.cores = len(os.sched_getaffinity(0))
        self.cpu = {"name": f"{e['cpu']}, {self.cores} cores", "device": "cpu", "units": self.cores, "about": about}
        smi = shutil.which("nvidia-smi") and subprocess.run(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"],
                                                            capture_output=True, text=True, check=False)
        names = smi.stdout.split("\n")[:-1] if smi and smi.returncode == 0 else []
        self.gpu = names and {"name": f"{len(names)} x {names[0]}", "device": "cuda", "units": len(names),
                              "about": about}

    def start(self, ranks, words, pinned=False):
        """Runs the program as `ranks` processes that work together, each on a core of its own where `pinned`."""
        launcher = []
        if ranks > 1:
            if not shutil.which("mpirun"):
                sys.exit("scale: mpirun is not in PATH; install openmpi-bin, or ask for --ranks 1")
            launcher = ["mpirun", "-n", str(ranks)] + (["--allow-run-as-root"] if os.geteuid() == 0 else [])
            own_cores = pinned and ranks <= self.cores
            launcher += (["--use-hwthread-cpus", "--map-by", "hwthread", "--bind-to", "hwthread:if-supported"]
                         if own_cores else ["--oversubscribe", "--bind-to", "none"])
        pin = (lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})) if pinned and ranks == 1 else None
        done = subprocess.run([*launcher, self.program, *map(str, words)], capture_output=True, text=True,
                              preexec_fn=pin, timeout=900, check=False)
        if done.returncode != 0:
            said = [text for text in done.stderr.splitlines() if text.startswith("semfield: ")] + [done.stderr[-600:]]
            sys.exit(f"scale: `{' '.join(map(str, words))}` on {ranks} ranks ended with {done.returncode}: {said[0]}")

    def train(self, step, config, device, ranks, threads, rays, steps, batch, set=None, pinned=False, precision=None):
        """A run folder; its configuration is next to it."""
        self.runs += 1
        run = self.folder / f"run_{self.runs}"
        shipped = pathlib.Path(__file__).resolve().parent.parent / "configs"
        tree = {"include": [str(shipped / config), str(shipped / "bench/small_room.yaml")], "name": f"scale_{step}",
                "train": {"steps": steps, "rays": rays},
                "runtime": {"device": device, "threads": threads},
                "report": {"log_every_steps": batch}}
        if precision:
            tree["runtime"]["precision"] = precision
        write(f"{run}.yaml", json.dumps(tree))  # JSON is YAML
        more = [word for key, value in (set or {}).items() for word in ("--set", f"{key}={value}")]
        print(f"{step} step, {rays} rays, {ranks} ranks of {threads} threads, {device}", file=sys.stderr)
        self.start(ranks, ["train", f"{run}.yaml", "--out", run, "-q", *more], pinned)
        return run

    def steps(self, where):
        """Every training once per round, so that what drifts meets all alike; the first batch of each is not timed."""
        device, trainings = where["device"], {}
        most = min(self.options.ranks or where["units"], where["units"])
        for step in ("paper", "hash"):
            weak, strong = sizes_of(self.results, step, device)
            ranks = [2 ** e for e in range(11) if 2 ** e <= most]
            wanted = [(n, strong) for n in ranks]
            wanted += [(n, weak * n) for n in ranks if step == "paper" or device == "cuda"]
            trainings.update({(step, n, rays): [] for n, rays in wanted})
        for _ in range(self.options.repeats):
            for (step, n, rays), seconds in trainings.items():
                own = rays // n
                if self.options.quick:
                    batch, batches, set = 2, 2, NARROW if step == "paper" else {}
                elif device == "cuda":
                    batch, batches, set = (32, 5, {}) if step == "paper" else (64, 5, HASH_GPU)
                elif step == "paper":  # a step takes seconds on one rank; the fewer it takes, the more are timed
                    batch, batches, set = 4 if own < 32 else 1, 2 if own >= 512 else 3 if own >= 128 else 5, {}
                else:
                    batch, batches, set = 40 if own < 128 else 10, 5, {}
                config = "paper.yaml" if step == "paper" else "bench/hash_step.yaml"
                threads = max(1, self.cores // n) if device == "cuda" else 1
                run = self.train(step, config, device, n, threads, rays, batch * (batches + 1), batch, set,
                                 pinned=device == "cpu", precision="bf16" if device == "cuda" else "fp32")
                rows = [r for r in map(json.loads, read(run / "metrics.jsonl").splitlines())
                        if r.get("kind", "train") == "train"]
                seconds += [(b["train_s"] - a["train_s"]) / (b["step"] - a["step"]) for a, b in zip(rows, rows[1:])]
                shutil.rmtree(run)
        self.results["machines"].append(where)
        for (step, n, rays), seconds in trainings.items():
            spread = {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}
            self.results["rows"].append({"machine": where["name"], "step": step, "device": device, "ranks": n,
                                         "rays": rays, "seconds": spread, "batches": len(seconds)})

    def bits(self, where):
        """The same training in every arrangement of ranks and threads, compared tensor by tensor with the first. Several
        GPUs promise no equal bits."""
        import semfield as sf  # here, so that --combine works without the module
        device, quick = where["device"], self.options.quick
        if device == "cuda":
            return
        arrangements = [(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2)][:3 if quick else 6]
        for preset in ("quickstart",) if quick else ("quickstart", "quickstart_frequency"):
            name, first = preset, None
            for ranks, threads in arrangements:
                if self.options.ranks and ranks > self.options.ranks:
                    continue
                rays, steps = (64, 4) if quick else (256, 20)
                run = self.train(preset, preset + ".yaml", device, ranks, threads, rays, steps, 1)
                with sf.resume(run) as loaded:
                    tensors = {key: value.tobytes() for key, value in loaded.parameters().items()}
                first = first or tensors
                differs = [key for key in first if tensors.get(key) != first[key]]
                difference = f"{len(differs)} tensors differ, the first is {differs[0]}" if differs else ""
                self.results["bits"].append({"machine": where["name"], "name": name, "ranks": ranks, "threads": threads,
                                             "difference": difference})
                shutil.rmtree(run)
        if where not in self.results["machines"]:
            self.results["machines"].append(where)

    def run(self):
        only = self.options.only.split(",") if self.options.only else PARTS
        for part, where in (("cpu", self.cpu), ("gpu", self.gpu)):
            if part in only and where:
                self.steps(where)
            if "bits" in only and where:
                self.bits(where)
        return self.results


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", help="folder for scale.json")
    p.add_argument("--ranks", type=int, default=0, help="ranks at most (default: as many as there are cores or GPUs)")
    p.add_argument("--only", default="", help="parts to measure, with commas: " + ", ".join(PARTS))
    p.add_argument("--repeats", type=int, default=2, help="rounds, each of which starts every training once")
    p.add_argument("--quick", action="store_true", help="narrow networks and few rays, for tests")
    p.add_argument("--combine", nargs="*", default=[], metavar="FILE",
                   help="scale.json of other machines; without --only nothing else is measured")
    options = p.parse_args()
    found = [json.loads(read(file)) for file in options.combine]
    if not found or options.only:
        with tempfile.TemporaryDirectory() as folder:
            found.append(Bench(options, folder).run())
    results = found[0]
    for more in found[1:]:
        results = merged(results, more)
    if options.out:
        write(f"{options.out}/scale.json", json.dumps(results, indent=1) + "\n")
    print(measured_text(results))
    return 1 if any(b["difference"] for b in results["bits"]) else 0


if __name__ == "__main__":
    sys.exit(main())
