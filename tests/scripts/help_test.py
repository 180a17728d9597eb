"""Every script says what it takes on request, and does nothing when it is called wrongly: help_test.py SCRIPTS_FOLDER"""
import os
import shutil
import subprocess
import sys
import tempfile

scripts = sys.argv[1]
failed = []


def check(name, truth, what):
    if not truth:
        failed.append(f"{name}: {what}")


with tempfile.TemporaryDirectory() as folder:
    # A copy: what runs all the same finds no tree to work on.
    copy = os.path.join(folder, "scripts")
    for part in ("scripts", "cmake", "tests/scripts", "tests/page", "tests/handover"):  # with modules that steps import
        shutil.copytree(os.path.join(os.path.dirname(scripts), part), os.path.join(folder, part),
                        ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(os.path.join(os.path.dirname(scripts), "tests/program.py"), os.path.join(folder, "tests"))

    def run(name, *words):
        with open(os.path.join(copy, name), encoding="utf-8") as file:
            program = [sys.executable, "-B"] if "python" in file.readline() else ["bash"]
        return subprocess.run([*program, os.path.join(copy, name), *words], cwd=folder, stdin=subprocess.DEVNULL,
                              capture_output=True, text=True, timeout=60)

    def listing():
        return sorted(os.path.join(root, name) for root, _, names in os.walk(folder) for name in names)

    before = listing()
    asked = [(name,) for name in sorted(os.listdir(copy)) if "." not in name and name != "checks"]
    asked += [("release_check", line.split()[0]) for line in run("release_check", "--list").stdout.splitlines()]
    for words in asked:
        for flag in ("--help",) if len(words) > 1 else ("--help", "-h"):
            answer = run(*words, flag)
            if answer.returncode == 69 and "needs the Python module numpy" in answer.stderr:
                continue
            check(words, answer.returncode == 0, f"{flag} exits with {answer.returncode}: {answer.stderr}")
            check(words, words[-1] in answer.stdout, f"{flag} does not say how it is called: {answer.stdout}")
            check(words, len(answer.stdout) > 80, f"{flag} says too little: {answer.stdout}")
        if words == ("test",):
            continue  # its options belong to ctest
        answer = run(*words, "--nonsense")
        check(words, answer.returncode in (2, 69), f"--nonsense exits with {answer.returncode}: {answer.stderr}")
    check("all", listing() == before, f"something was written: {set(listing()) - set(before)}")
    check("all", len(asked) >= 20, f"only {asked} were asked")
    for words in ("demo", "a", "b"), ("setup", "a"):
        check(words, run(*words).returncode == 2, "too many words")

print("\n".join(failed) or f"{len(asked)} scripts and steps")
sys.exit(1 if failed else 0)
