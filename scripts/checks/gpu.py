"""CUDA tests under NVIDIA's compute-sanitizer."""
import collections
import concurrent.futures
import os
import re
import shutil
import subprocess
import time

from . import common

TOOLS = ("memcheck", "initcheck", "racecheck")
# NVIDIA's: nothing here can repair them, and initcheck must see what they write, so they are counted apart.
LIBRARIES = re.compile("nvjet|cutlass|cublas")
# Kernels that read what bulk copies of Hopper have written, the outputs of the fused NeRF network and cuBLASLt's in
# bf16: initcheck of CUDA 13.0 does not follow those copies and takes all of it for unwritten.
BEHIND_BULK_COPIES = re.compile("fused::.*(weight_gradient|per_ray|head_gradient|unpack)_kernel|mask_and_sum_kernel|"
                                "_kernel<([^<>]*, )?__nv_bfloat16>")
# These take all of the device's memory: one at a time.
GREEDY = re.compile("CudaRun.(MemoryThatIsNotThere|AStepThatDoesNotFit)")


def names_of(listed):
    """Full names of the tests that --gtest_list_tests names."""
    suite = ""
    for line in listed.splitlines():
        if line.startswith("  "):
            yield suite + line.split()[0]
        else:
            suite = line.split()[0]


def gpu_sanitize(words):
    """Runs every test of cuda_test by itself under NVIDIA's compute-sanitizer, several at a time, on a build of
scripts/gpu_check. Racecheck makes training tests hundreds of times slower: seconds for a step of the fused NeRF network
on 8 rays, and minutes on 256. Findings name their kernels; those of NVIDIA's libraries, and initcheck's behind bulk
copies, are counted apart.

The last line is `gpu_sanitize: TOOL=PASSED/ALL ... findings=... of_libraries=... behind_bulk_copies=... failed=...
unfinished=...`."""
    parser = common.parser_of(gpu_sanitize)
    parser.add_argument("tools", nargs="*", metavar="TOOL", help=f"default: {' '.join(TOOLS)}")
    parser.add_argument("--tests", default="*", help="a filter as --gtest_filter takes it (default: all)")
    parser.add_argument("--jobs", type=int, default=(os.cpu_count() + 1) // 2, help="tests at a time (half the cores)")
    parser.add_argument("--test-s", type=int, default=600, help="seconds a test may take (default: %(default)s)")
    parser.add_argument("--all-s", type=int, default=86400, help="seconds for everything; what is left is unfinished")
    options = parser.parse_args(words)
    tools, build = options.tools or TOOLS, common.ROOT / "build" / "cuda"
    program = next((path for path in build.rglob("cuda_test") if os.access(path, os.X_OK) and path.is_file()), None)
    if program is None or not shutil.which("compute-sanitizer"):
        raise common.Failed("no build/cuda/.../cuda_test, or no compute-sanitizer; run scripts/gpu_check first, on a "
                            "machine with CUDA")
    log, end = build / "gpu_sanitize", time.monotonic() + options.all_s
    shutil.rmtree(log, ignore_errors=True)
    log.mkdir()
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": "2"}
    names = list(names_of(common.run(program, "--gtest_list_tests", f"--gtest_filter={options.tests}")))

    def one(tool, name):
        """What came of a test; what the tool printed is in its log."""
        left = min(options.test_s, end - time.monotonic())
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
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        results = {pair: pool.submit(one, *pair) for pair in pairs if not GREEDY.match(pair[1])}
    results = {pair: result.result() for pair, result in results.items()}
    results.update({pair: one(*pair) for pair in pairs if GREEDY.match(pair[1])})
    line, figures = [], collections.Counter(dict.fromkeys(("findings", "of_libraries", "behind_bulk_copies"), 0))
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
        line.append(f"{tool}={of_tool.count('passed')}/{len(of_tool)}")
    for (tool, name), result in results.items():
        if result in ("failed", "unfinished"):
            print(f"{tool} {name} {result}")
    for result in ("failed", "unfinished"):
        figures[result] = list(results.values()).count(result)
    print("gpu_sanitize: " + " ".join(line + [f"{key}={value}" for key, value in figures.items()]))
    return 1 if figures["findings"] or figures["failed"] else 0
