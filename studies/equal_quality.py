#!/usr/bin/env python3
"""Are two ways of computing the same training equally good? Trains one configuration with several seeds in each way and
prints the differences of the means with 95 % intervals. Every speed figure is paired with this check: PSNR within
0.1 dB, mIoU within 0.5 points.

    studies/equal_quality.py build/release/bin/semfield configs/quickstart.yaml --steps 3000 \\
        --way fp32 --way bf16:runtime.precision=bf16 --way avx2:@SEMFIELD_ISA=avx2

A way is name[:key=value[,key=value...]], a setting for --set, or with @ an environment variable; the first is the
reference. Exit code 1 when a mean is further away than allowed and the difference cannot be chance (its interval leaves
out the allowed band); "undecided" says that more seeds are needed.
"""
import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile

from common import half_width

ALLOWED = {"psnr": 0.1, "miou_present": 0.005}


def parse_way(text):
    name, _, rest = text.partition(":")
    return name, [part for part in rest.split(",") if part]


def train(program, config, settings, seed, steps, folder):
    command = [program, "train", config, "--out", folder, "--steps", str(steps), "--quiet",
               "--set", f"runtime.seed={seed}", "--set", "report.eval_every_s=0"]
    environment = dict(os.environ)
    for setting in settings:
        if setting.startswith("@"):
            key, value = setting[1:].split("=", 1)
            environment[key] = value
        else:
            command += ["--set", setting]
    done = subprocess.run(command, env=environment, text=True, capture_output=True)
    line = re.search(r"^train: (.*)$", done.stdout + done.stderr, re.M)
    if done.returncode != 0 or not line:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    return {key: float(value) for key, value in re.findall(r"(\w+)=([-\d.]+)(?= |$)", line.group(1))}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("config")
    parser.add_argument("--way", action="append", required=True)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    ways = [parse_way(text) for text in options.way]
    results = {name: [] for name, _ in ways}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, options.seeds + 1):
            for name, settings in ways:
                metrics = train(options.program, options.config, settings, seed, options.steps,
                                os.path.join(folder, f"{name}-{seed}"))
                results[name].append(metrics)
                print(f"seed {seed} {name}: psnr {metrics['psnr']:.3f} miou {metrics['miou_present']:.4f} "
                      f"{metrics['train_s']:.1f} s", flush=True)
    reference = ways[0][0]
    worse = False
    for name, _ in ways[1:]:
        for metric, allowed in ALLOWED.items():
            differences = [a[metric] - b[metric] for a, b in zip(results[name], results[reference])]
            mean = statistics.mean(differences)
            half = half_width(differences)
            if abs(mean) <= allowed:
                verdict = "equal" if abs(mean) + half <= allowed else "equal in the mean"
            else:
                verdict = "different" if abs(mean) - half > allowed else "undecided"
            worse = worse or verdict == "different"
            print(f"{name} - {reference}: {metric} {mean:+.4f} +- {half:.4f}, allowed {allowed}: {verdict}")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
