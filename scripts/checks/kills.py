"""Runs that are killed, and one that lasts for hours."""
import os
import pathlib
import subprocess
import time

from . import common


def run_test(build, program, cases, **settings):
    """Runs cases of a test program of the build with SEMFIELD_... settings; its exit code."""
    path = build / "tests" / program
    if not path.exists():
        raise common.Failed(f"there is no {path}; build it with ./scripts/test")
    environment = {**os.environ, **{f"SEMFIELD_{key}": str(value) for key, value in settings.items()}}
    return subprocess.run(["nice", path, f"--gtest_filter={cases}"], env=environment).returncode


def torture(words):
    """Kills the real program with SIGKILL at random moments of a training, resumes it each time, and compares the bits
in the end with those of a run left alone. With CALLS also one kill at each of so many of a run's file calls, spread
evenly; 0: at every one. Builds nothing: run ./scripts/test first."""
    parser = common.parser_of(torture)
    parser.add_argument("kills", type=int, nargs="?", default=1000, metavar="KILLS", help="how many (default: 1000)")
    parser.add_argument("calls", type=int, nargs="?", metavar="CALLS")
    common.add_build(parser)
    options = parser.parse_args(words)
    code = run_test(options.build, "run/run_process_test", "Process.RandomKillsLoseNoRunAndChangeNoBit",
                    TORTURE_KILLS=options.kills)
    if code == 0 and options.calls is not None:
        code = run_test(options.build, "crash/crash_program_test", "Program.KilledAtItsFileCallsItGoesOn",
                        TORTURE_CALLS=options.calls)
    return code


def sweep_torture(words):
    """Starts two processes of one sweep in its folder and kills them at random moments, by SIGKILL and SIGTERM, until
so many are killed. No finished result may be lost or changed, every exit code is a documented one, and the run to the
end gives the figures of a sweep left alone. Builds nothing: run ./scripts/test first."""
    parser = common.parser_of(sweep_torture)
    parser.add_argument("kills", type=int, nargs="?", default=100, metavar="KILLS", help="how many (default: 100)")
    common.add_build(parser)
    options = parser.parse_args(words)
    return run_test(options.build, "sweep/sweep_verb_test", "SweepTorture.*", SWEEP_KILLS=options.kills)


def soak(words):
    """Trains for hours and watches resident memory and open files; fails when either grows after the first tenth.

The last line is `soak: seconds=... exit=... early_peak_kb=... late_peak_kb=... growth_percent=... files=EARLY/LATE`."""
    parser = common.parser_of(soak)
    parser.add_argument("hours", type=float, nargs="?", default=2, metavar="HOURS", help="how many (default: 2)")
    parser.add_argument("--keep", metavar="FOLDER", help="leave the run there")
    parser.add_argument("--threads", type=int, default=0, help="of the training (default: all)")
    common.add_build(parser)
    options = parser.parse_args(words)
    seconds = int(3600 * options.hours)
    # The first evaluations and checkpoints fall into the tenth that does not count.
    every = 120 if seconds > 7200 else seconds // 60 + 1
    with common.work_folder(options.keep) as folder, open(folder / "train.txt", "w", encoding="utf-8") as log:
        begin, samples = time.monotonic(), []
        training = subprocess.Popen(
            [options.build / "bin" / "semfield", "train", common.QUICKSTART, "--out", folder / "run",
             "--time", f"{seconds}s", "--threads", str(options.threads), "--set", f"report.eval_every_s={every}",
             "--set", f"report.checkpoint_every_s={every}"], stdout=log, stderr=log)
        process = pathlib.Path("/proc", str(training.pid))
        while training.poll() is None:
            try:
                status = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
                files = len(list((process / "fd").iterdir()))
                samples.append((time.monotonic() - begin, int(status["VmRSS"].split()[0]), files))
            except (OSError, KeyError):  # it ended just now
                break
            time.sleep(30 if seconds > 1200 else 2)
        code = training.wait()
    if not samples:
        raise common.Failed(f"the training ended at once with {code}")
    # The largest after the first tenth against the largest of the last half: a kilobyte a step would show as gigabytes.
    last = samples[-1][0]
    early = [sample[1:] for sample in samples if last / 10 <= sample[0] < last / 2] or [(0, 0)]
    late = [sample[1:] for sample in samples if sample[0] >= last / 2]
    (early_kb, early_files), (late_kb, late_files) = (map(max, zip(*part)) for part in (early, late))
    growth = 100 * (late_kb - early_kb) / max(early_kb, 1)
    print(f"soak: seconds={last:.0f} exit={code} early_peak_kb={early_kb} late_peak_kb={late_kb} "
          f"growth_percent={growth:.2f} files={early_files}/{late_files}")
    return 0 if code == 0 and growth < 1 and late_files <= early_files else 1
