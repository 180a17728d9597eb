"""The container files, without a container tool: known instructions, stages that exist, the same steps in both.
docker_test.py SOURCE_FOLDER"""
import pathlib
import re
import sys


def instructions(image):
    """(instruction, words) of a Dockerfile, without comments."""
    lines = (pathlib.Path(sys.argv[1], "packaging/docker") / f"Dockerfile.{image}").read_text().splitlines()
    return [tuple(line.strip().split(None, 1)) for line in lines if line.strip() and not line.startswith("#")]


def check_text(image):
    """What can be checked of the text: known instructions alone, a base for every stage, stages that are there."""
    stages = []
    forms = {"FROM": r"[a-z0-9/._-]+:[A-Za-z0-9._-]+( AS ([a-z]+))?", "ENV": r"[A-Z_]+=[^ ].*"}
    for instruction, *words in instructions(image):
        if instruction not in "FROM COPY WORKDIR ENV RUN ENTRYPOINT CMD".split() or not words:
            sys.exit(f"Dockerfile.{image}: '{instruction}' is not known, or has no words")
        if not re.fullmatch(forms.get(instruction, ".*"), words[0]):
            sys.exit(f"Dockerfile.{image}: {instruction} {words[0]}: expected {forms[instruction]}")
        source = re.match("--from=([a-z]+)", words[0])
        if instruction == "COPY" and source and source[1] not in stages:
            sys.exit(f"Dockerfile.{image}: COPY {words[0]}: no such stage")
        if instruction == "FROM":
            stages.append(words[0].split()[-1])
    if not stages:
        sys.exit(f"Dockerfile.{image}: no FROM")


for image in ("cpu", "cuda"):
    check_text(image)
# The images differ in their base and the preset alone.
steps = {image: [(name, re.sub("^[^ ]*", "", rest) if name == "FROM" else rest.replace("package-cuda", "package"))
                 for name, rest in instructions(image)] for image in ("cpu", "cuda")}
assert steps["cpu"] == steps["cuda"], "Dockerfile.cpu and Dockerfile.cuda have other steps"
