#include "app/mesh/mesh_targets.h"

#include <algorithm>

#include "core/error.h"
#include "core/text.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

bool is_among(const std::string& name, const std::vector<std::string>& names) {
  return std::find(names.begin(), names.end(), name) != names.end();
}

void check_format(const std::string& name, const std::string& where) {
  if (is_among(name, known_formats())) return;
  const std::string near = did_you_mean(name, known_formats());
  throw Error(ErrorKind::usage, "mesh.format.unknown", where + ": unknown mesh format '" + name + "'",
              "one of " + join(known_formats()) + (near.empty() ? std::string() : "; did you mean " + near + "?"));
}

}  // namespace

const std::vector<std::string>& known_formats() {
  static const std::vector<std::string> names{"ply",   "obj",        "glb", "html", "las", "pcd",
                                              "splat", "splats.ply", "npz", "bt",   "ot",  "pgm"};
  return names;
}

bool MeshTargets::writes(const std::string& format) const { return is_among(format, formats); }
bool MeshTargets::surfaces() const { return writes("ply") || writes("obj") || writes("glb") || writes("html"); }
bool MeshTargets::points() const { return writes("las") || writes("pcd"); }
bool MeshTargets::splats() const { return writes("splat") || writes("splats.ply"); }
bool MeshTargets::maps() const { return writes("npz") || writes("bt") || writes("ot") || writes("pgm"); }
std::string MeshTargets::file(const std::string& format, const std::string& suffix) const {
  return stem.string() + suffix + "." + format;
}

MeshTargets mesh_targets(const MeshOptions& options) {
  std::error_code unknown;
  const bool folder = options.out.empty() || options.out.ends_with('/') || fs::is_directory(options.out, unknown);
  const fs::path into = options.out.empty() ? options.run : options.out;
  MeshTargets targets{folder ? into / "mesh" : into, options.formats};
  std::string ending;  // the longest that is known: "room.splats.ply" is no surface
  const std::string name = folder ? std::string() : targets.stem.filename().string();
  for (const std::string& format : known_formats())
    if (name.ends_with("." + format) && format.size() > ending.size()) ending = format;
  if (targets.formats.empty()) {
    const fs::path extension = folder ? fs::path() : targets.stem.extension();
    if (ending.empty() && !extension.empty()) check_format(extension.string().substr(1), "--out " + options.out);
    targets.formats = {ending.empty() ? "ply" : ending};
  }
  if (!ending.empty())  // "scan.v2" keeps its name
    targets.stem.replace_filename(name.substr(0, name.size() - ending.size() - 1));
  return targets;
}

std::vector<Coloring> mesh_colorings(const MeshOptions& options, bool has_classes) {
  if (!has_classes && (options.color == "class" || options.color == "both"))
    throw Error(ErrorKind::data, "run.semantics.none",
                "--color " + options.color + ": " + options.run + " has no semantics",
                "train with labels, or leave --color out");
  std::vector<Coloring> colorings;
  if (options.color != "class") colorings.push_back({false, ""});
  // A file that was named gets its name.
  if (has_classes && options.color != "photo")
    colorings.push_back({true, options.color == "class" && !options.out.empty() ? "" : "_classes"});
  return colorings;
}

}  // namespace semfield::app
