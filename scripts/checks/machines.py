"""The suite and trainings under conditions that no test makes: odd machines, kills, hours, compute-sanitizer."""
import collections
import concurrent.futures
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import time

from . import common

# Preloaded: programs believe in as many cores as SEMFIELD_ODD_CORES says.
SHIM = r"""
#include <sched.h>
#include <cstdlib>
extern "C" int sched_getaffinity(pid_t, size_t size, cpu_set_t* set) noexcept {
  const size_t cores = std::strtoul(std::getenv("SEMFIELD_ODD_CORES"), nullptr, 10);
  CPU_ZERO_S(size, set);
  for (size_t core = 0; core < cores; ++core) CPU_SET_S(core, size, set);
  return 0;
}
"""
# Loops of the shell while the suite runs.
BUSY = 'for i in 1 2 3; do (while :; do :; done) & done; "$@"; code=$?; kill $(jobs -p); exit $code'
# Of this user's build: these write into it, or call an interpreter that may lie in this user's home.
OF_THE_USER = "^(docs_.*|out_of_tree|drill|tables|site.*)$"
CORES = [str(core) for core in sorted(os.sched_getaffinity(0))]
# Of each condition what a machine that can have it passes, words before ctest, and environment; {} is the work folder.
CONDITIONS = {
    "one_core": ("true", ["taskset", "-c", CORES[0]], {}),
    "two_cores": ("test $(nproc) -gt 1", ["taskset", "-c", ",".join(CORES[:2])], {}),
    "sixteen_cores": ("true", [], {"LD_PRELOAD": "{}/shim.so", "SEMFIELD_ODD_CORES": "16"}),
    "another_user": ("test $(id -u) = 0", ["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"],
                     {"HOME": "{}/tmp/another_user"}),
    "german_locale": ("locale -a | grep -iE '^de_DE.utf-?8$'  # localedef -i de_DE -f UTF-8 de_DE.UTF-8", [],
                      {"LC_ALL": "de_DE.UTF-8"}),
    "odd_temporary_names": ("true", [], {"TMPDIR": "{}/tmp/a b's"}),
    "memory_as_disk": ("test $(stat -f -c %T /dev/shm) = tmpfs",
                       ["sh", "-c", '"$@"; code=$?; rm -rf "$TMPDIR"; exit $code', "sh"],
                       {"TMPDIR": f"/dev/shm/odd_machines.{os.getpid()}"}),
    "busy": ("true", ["bash", "-c", BUSY, "bash"], {}),
    "odd_checkout": ("true", [], {}),
}


def build_oddly(work):
    """A build of this checkout in a folder of an odd name."""
    copy = work / "tmp" / "a b's" / "semfield"
    copy.mkdir(parents=True)
    files = "git ls-files -z --cached --others --exclude-standard"
    common.run("sh", "-c", f'{files} | xargs -0 cp --parents -t "$0"', copy, cwd=common.ROOT)
    common.run("cmake", "--preset", "release", cwd=copy)
    common.run("cmake", "--build", "--preset", "release", cwd=copy)
    return copy / "build" / "release"


def suite(name, before, more, build, behind, work):
    """Exit code of ctest under the condition, and what it printed; in an empty folder for its own files, so that the
    build may be somebody else's."""
    if name == "sixteen_cores":
        words = (os.environ.get("CXX", "c++"), "-O1", "-shared", "-fPIC", "-x", "c++", "-o", work / "shim.so", "-")
        common.run(*words, input=SHIM)
    build = build_oddly(work) if name == "odd_checkout" else build
    behind += ["-E", OF_THE_USER] if name == "another_user" else []
    more = {key: value.replace("{}", str(work)) for key, value in more.items()}
    folder = pathlib.Path(more.get("TMPDIR", work / "tmp" / name))
    for path in (work / name, folder):
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o777)
    (work / name / "CTestTestfile.cmake").write_text(f'subdirs("{build}")\n')
    words = [*before, "ctest", "--test-dir", work / name, "--output-on-failure", "--timeout", "3600",
             "--parallel", str(os.cpu_count()), *behind]
    environment = {**os.environ, "TMPDIR": str(folder), "TEST_TMPDIR": str(folder), **more}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, errors="replace")
    (work / f"{name}.log").write_text(done.stdout + done.stderr)
    return done.returncode, done.stdout


def odd_machines(*conditions: "default: all but odd_checkout, which builds in a folder of an odd name",
                 R: "of tests, for ctest" = None, keep=None, build=common.BUILD):
    """Runs the suite as other machines would: one core, sixteen, another user, another locale, odd temporary folders, a
busy machine, every instruction set. One line a condition, names of failed tests below it."""
    build = build.resolve()
    if not (build / "CTestTestfile.cmake").exists():
        raise common.Failed(f"{build} is no build with tests; build it with ./scripts/test")
    isas = re.search("^SEMFIELD_ISA:[^=]*=(.+)$", (build / "CMakeCache.txt").read_text(), re.M)
    known = dict(CONDITIONS)
    for isa in (isas[1] if isas else "generic").split(";"):
        has_it = "true" if isa == "generic" else f"grep -w {({'avx512': 'avx512f'}).get(isa, isa)} /proc/cpuinfo"
        known[f"isa_{isa}"] = (has_it, [], {"SEMFIELD_ISA": isa})
    if not set(conditions) <= set(known):
        raise common.Failed(f"the conditions are {', '.join(known)}")
    figures = collections.Counter(conditions=0, failed=0, absent=0)
    with common.work_folder(keep) as work:
        work.chmod(0o755)
        for name in conditions or [name for name in known if name != "odd_checkout"]:
            needed, before, more = known[name]
            if subprocess.run(["sh", "-c", needed], capture_output=True).returncode != 0:
                figures["absent"] += 1
                print(f"{name}: not run: this machine does not pass {needed}", flush=True)
                continue
            try:
                code, text = suite(name, before, more, build, ["-R", R] if R else [], work)
            except common.Failed as error:
                code, text = 1, str(error)
            figures.update(conditions=1, failed=int(code != 0))
            passed = re.search(r"tests passed.* out of (\d+)", text)
            faults = re.findall(r"^\t *(\d+ - .*)", text, re.M) or [text[-300:]]
            print(f"{name}: " + ("\n    ".join(["failed", *faults]) if code else f"{passed[1]} tests passed"),
                  flush=True)
    return figures


def run_test(build, program, cases, **settings):
    """Runs cases of a test of the program with SEMFIELD_... settings; its exit code."""
    build = build.resolve()
    room = build / "tests/semfield_analytic_room"
    if not room.exists():
        raise common.Failed(f"there is no {room}; build it with ./scripts/test")
    words = [sys.executable, common.ROOT / "tests" / program, "-k", cases]
    settings = {"BINARY": build / "bin/semfield", "ANALYTIC_ROOM": room,
                "FAULT_SHIM": build / "tests/crash/libsemfield_fault_shim.so", "CACHE": "off", **settings}
    environment = {**os.environ, "PYTHONPATH": str(common.ROOT / "tests"), **{f"SEMFIELD_{key}": str(value) for key, value in settings.items()}}
    return subprocess.run(["nice", *words], env=environment).returncode


def torture(kills: "how many" = 1000, calls: "how many" = None, *, build=common.BUILD):
    """Kills the real program with SIGKILL at random moments of a training, resumes it each time, and compares the bits
in the end with those of a run left alone. With CALLS also one kill at each of so many of a run's file calls, spread
evenly; 0: at every one. Builds nothing: run ./scripts/test first."""
    return (run_test(build, "run/process_test.py", "random_kills", TORTURE_KILLS=kills)
            or calls and run_test(build, "crash/program_test.py", "killed_at_its_file_calls", TORTURE_CALLS=calls))


def sweep_torture(kills: "how many" = 100, *, build=common.BUILD):
    """Starts two processes of one sweep in its folder and kills them at random moments, by SIGKILL and SIGTERM, until
so many are killed. No finished result may be lost or changed, every exit code is a documented one, and the run to the
end gives the figures of a sweep left alone. Builds nothing: run ./scripts/test first."""
    return run_test(build, "sweep/sweep_verb_test.py", "lose_no_result", SWEEP_KILLS=kills)


def soak(hours: "how many" = 2.0, *, keep=None, threads: "of the training; 0: all" = 0, build=common.BUILD):
    """Trains for hours and watches resident memory and open files; fails when either grows after the first tenth."""
    seconds = int(3600 * hours)
    # The first evaluations and checkpoints fall into the tenth that does not count.
    every = 120 if seconds > 7200 else seconds // 60 + 1
    with common.work_folder(keep) as folder, open(folder / "train.txt", "w", encoding="utf-8") as log:
        begin, samples = time.monotonic(), []
        training = subprocess.Popen(
            [build / "bin" / "semfield", "train", common.QUICKSTART, "--out", folder / "run",
             "--time", f"{seconds}s", "--threads", str(threads), "--set", f"report.eval_every_s={every}",
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
    common.check(code == 0 and late_files <= early_files, "the training failed, or open files grow")
    return {"seconds": last, "exit": code, "early_peak_kb": early_kb, "late_peak_kb": late_kb, "growth_percent": growth,
            "files": f"{early_files}/{late_files}"}


# NVIDIA's: nothing here can repair them, and initcheck must see what they write, so they are counted apart.
LIBRARIES = re.compile("nvjet|cutlass|cublas")
# Kernels that read what bulk copies of Hopper have written, the outputs of the fused NeRF network and cuBLASLt's in
# bf16: initcheck of CUDA 13.0 does not follow those copies and takes all of it for unwritten.
BEHIND_BULK_COPIES = re.compile("fused::.*(weight_gradient|per_ray|head_gradient|unpack)_kernel|mask_and_sum_kernel|"
                                "_kernel<([^<>]*, )?__nv_bfloat16>")
# These take all of the device's memory: one at a time.
GREEDY = re.compile("CudaRun.(MemoryThatIsNotThere|AStepThatDoesNotFit)")


def gpu_sanitize(*tools: "default: memcheck initcheck racecheck", tests: "a filter as --gtest_filter takes it" = "*",
                 jobs: "tests at a time" = (os.cpu_count() + 1) // 2, test_s: "seconds a test may take" = 600,
                 all_s: "seconds for everything; what is left is unfinished" = 86400):
    """Runs every test of cuda_test by itself under NVIDIA's compute-sanitizer, several at a time, on a build of
scripts/gpu_check. Racecheck makes training tests hundreds of times slower: seconds for a step of the fused NeRF network
on 8 rays, and minutes on 256. Findings name their kernels; those of NVIDIA's libraries, and initcheck's behind bulk
copies, are counted apart. A tool's figure is how many tests of all passed."""
    tools, build = tools or ("memcheck", "initcheck", "racecheck"), common.ROOT / "build" / "cuda"
    program = next((path for path in build.rglob("cuda_test") if os.access(path, os.X_OK) and path.is_file()), None)
    if program is None or not shutil.which("compute-sanitizer"):
        raise common.Failed("no build/cuda/.../cuda_test, or no compute-sanitizer; run scripts/gpu_check first, on a "
                            "machine with CUDA")
    log, end = build / "gpu_sanitize", time.monotonic() + all_s
    shutil.rmtree(log, ignore_errors=True)
    log.mkdir()
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": "2"}
    listed = log / "tests.json"
    common.run(program, "--gtest_list_tests", f"--gtest_filter={tests}", f"--gtest_output=json:{listed}")
    names = [f"{suite['name']}.{one['name']}" for suite in json.loads(listed.read_text())["testsuites"]
             for one in suite["testsuite"]]

    def one(tool, name):
        """What came of a test; what the tool printed is in its log."""
        left = min(test_s, end - time.monotonic())
        if left < 5:
            return "unfinished"
        # The program's own checks find errors of the API, and tests provoke them. No --kernel-name: racecheck of
        # compute-sanitizer 2025.3.1 ends with errors of its own where it does not follow every kernel.
        more = ["--report-api-errors", "no"] if tool == "memcheck" else []
        path = log / f"{tool}.{name.replace('/', '_')}.log"
        with open(path, "w", encoding="utf-8") as file:
            try:
                subprocess.run(["compute-sanitizer", "--tool", tool, "--print-limit", "2000", *more, program,
                                f"--gtest_filter={name}"], env=environment, stdout=file, stderr=file, timeout=left)
            except subprocess.TimeoutExpired:
                return "unfinished"
        text = path.read_text(errors="replace")
        if re.search(r"terminated before first instrumented API call|^\[  SKIPPED", text, re.M):
            return "nothing to check"
        return "passed" if re.search(r"^\[       OK", text, re.M) else "failed"

    pairs = [(tool, name) for tool in tools for name in names]
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        results = {pair: pool.submit(one, *pair) for pair in pairs if not GREEDY.match(pair[1])}
    results = {pair: result.result() for pair, result in results.items()}
    results.update({pair: one(*pair) for pair in pairs if GREEDY.match(pair[1])})
    figures = dict.fromkeys(("findings", "of_libraries", "behind_bulk_copies"), 0)
    for tool in tools:
        own = collections.Counter()
        for path in log.glob(f"{tool}.*.log"):
            # `at KERNEL(...)+0x...`, a race twice in one line.
            for found in re.findall(r"^=========.* at .*\+0x[0-9a-f]+", path.read_text(errors="replace"), re.M):
                kind = ("of_libraries" if LIBRARIES.search(found) else "behind_bulk_copies"
                        if tool == "initcheck" and BEHIND_BULK_COPIES.search(found) else "findings")
                figures[kind] += 1
                own.update([re.sub(r"\+0x[0-9a-f]+", "", found.strip("= "))] if kind == "findings" else [])
        for found, count in own.most_common(20):
            print(f"{count:7} {tool}: {found}")
        of_tool = [result for (of, _), result in results.items() if of == tool and result != "nothing to check"]
        figures[tool] = f"{of_tool.count('passed')}/{len(of_tool)}"
    for (tool, name), result in results.items():
        if result in ("failed", "unfinished"):
            print(f"{tool} {name} {result}")
    for result in ("failed", "unfinished"):
        figures[result] = list(results.values()).count(result)
    return figures
