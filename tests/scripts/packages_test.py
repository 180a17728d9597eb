"""The packages of a build: fields that Debian requires, and every installed file in exactly one of them.

packages_test.py CMAKE CPACK BUILD_FOLDER WORK_FOLDER"""
import glob
import os
import shutil
import subprocess
import sys

cmake, cpack, build, work = sys.argv[1:]


def run(*words):
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(words)} failed ({done.returncode}):\n{done.stdout}\n{done.stderr}")
    return done.stdout


shutil.rmtree(work, ignore_errors=True)
run(cpack, "--config", f"{build}/CPackConfig.cmake", "-B", f"{work}/packages", "-D", "CPACK_DEBIAN_COMPRESSION_TYPE=gzip")
run(cmake, "--install", build, "--prefix", f"{work}/usr")

packaged = {}
for file in glob.glob(f"{work}/packages/*.deb"):
    name = run("dpkg-deb", "-f", file, "Package").strip()
    for field in ["Version", "Architecture", "Maintainer", "Section", "Priority", "Depends", "Description", "Source"]:
        assert run("dpkg-deb", "-f", file, field).strip(), f"{name} has no field {field}"
    for line in run("dpkg-deb", "-c", file).splitlines():
        mode, path = line.split()[0], line.split(None, 5)[5].split(" -> ")[0].removeprefix("./")
        if not mode.startswith("d"):
            packaged.setdefault(path, []).append(name)
    for document in ["copyright", "changelog.Debian.gz"]:
        assert packaged[f"usr/share/doc/{name}/{document}"] == [name]

names = {name for owners in packaged.values() for name in owners}
assert {"semfield", "libsemfield-dev"} <= names <= {"semfield", "libsemfield-dev", "python3-semfield"}, names
assert packaged["usr/bin/semfield"] == ["semfield"]
assert packaged["usr/share/semfield/scenes/room/room.obj"] == ["semfield"]
assert packaged["usr/share/man/man1/semfield.1.gz"] == ["semfield"]
assert packaged["usr/include/semfield/core/files.h"] == ["libsemfield-dev"]

# A component that no package takes would be lost here, and one that two take could not be installed.
installed = {os.path.relpath(os.path.join(folder, name), work)
             for folder, _, files in os.walk(f"{work}/usr") for name in files}
lost = sorted(path for path in installed if path not in packaged)
assert not lost, f"in no package: {lost}"
twice = sorted(path for path, owners in packaged.items() if len(owners) > 1)
assert not twice, f"in several packages: {twice}"
print(f"{len(installed)} installed files lie in {sorted(names)}")
shutil.rmtree(work)
