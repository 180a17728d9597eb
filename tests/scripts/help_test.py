"""Every script says what it takes on request, and does nothing when it is called wrongly: help_test.py SCRIPTS_FOLDER"""
import os
import shutil
import subprocess
import sys
import tempfile

scripts = sys.argv[1]
# Its options belong to ctest, or are read by the script itself behind its first word.
passes_flags_on = {"test"}
failed = []


def check(name, truth, what):
    if not truth:
        failed.append(f"{name}: {what}")


with tempfile.TemporaryDirectory() as folder:
    # A copy: what runs all the same finds no tree to work on.
    copy = os.path.join(folder, "scripts")
    shutil.copytree(scripts, copy, ignore=shutil.ignore_patterns("__pycache__"))
    before = sorted(os.listdir(folder)) + sorted(os.listdir(copy))
    asked = 0
    for name in sorted(os.listdir(copy)):
        path = os.path.join(copy, name)
        with open(path, encoding="utf-8") as file:
            text = file.read()
        if not text.startswith("#!"):
            continue  # a part of another script
        asked += 1

        def run(*words):
            command = [sys.executable, "-B", path] if "python" in text.split("\n", 1)[0] else ["bash", path]
            return subprocess.run(command + list(words), cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)

        for flag in ("--help", "-h"):
            answer = run(flag)
            check(name, answer.returncode == 0, f"{flag} exits with {answer.returncode}: {answer.stderr}")
            check(name, name in answer.stdout, f"{flag} does not say how it is called: {answer.stdout}")
            check(name, len(answer.stdout) > 80, f"{flag} says too little: {answer.stdout}")
        if name in passes_flags_on:
            continue
        answer = run("--nonsense")
        check(name, answer.returncode == 2, f"--nonsense exits with {answer.returncode}: {answer.stderr}")
        check(name, answer.stdout.count("\n") < 30 and "--nonsense" in answer.stdout + answer.stderr or "usage" in answer.stdout + answer.stderr,
              f"--nonsense is not named: {answer.stderr}")
    after = sorted(os.listdir(folder)) + sorted(os.listdir(copy))
    check("all", after == before, f"something was written: {set(after) - set(before)}")
    check("all", asked >= 12, f"only {asked} scripts were asked")
    for words, name in ((["a", "b"], "demo"), (["a"], "setup")):
        answer = subprocess.run(["bash", os.path.join(copy, name)] + words, capture_output=True, text=True, timeout=60)
        check(name, answer.returncode == 2 and "unexpected word" in answer.stderr, f"too many words: {answer.stderr}")

print("\n".join(failed) or f"{asked} scripts")
sys.exit(1 if failed else 0)
