// A report's input, read from run folders.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <set>

#include "core/error.h"
#include "core/files.h"
#include "scene/class_table.h"
#include "train/report.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

struct ImageKind {
  const char *suffix, *caption;
};
constexpr std::array<ImageKind, 6> kKinds{{{"_rgb_truth.png", "colour, truth"},
                                           {"_rgb.png", "colour, rendered"},
                                           {"_label_truth_vis.png", "label, truth"},
                                           {"_label_vis.png", "label, rendered"},
                                           {"_entropy_vis.png", "entropy"},
                                           {"_depth_vis.png", "depth"}}};

std::string text_or_empty(const std::string& path) { return fs::is_regular_file(path) ? read_text_file(path) : std::string(); }

// Folder name, or with its parent's when another run has the same.
std::string unique_name(const fs::path& folder, std::set<std::string>& taken) {
  const fs::path path = fs::absolute(folder).lexically_normal();
  const fs::path leaf = path.has_filename() ? path : path.parent_path();
  const std::string base = leaf.filename().string();
  std::string name = base;
  if (taken.contains(name)) name = leaf.parent_path().filename().string() + "/" + base;
  for (int number = 2; !taken.insert(name).second; ++number) name = fmt::format("{} ({})", base, number);
  return name;
}

std::vector<ReportStrip> read_strips(const fs::path& folder, int most_frames) {
  std::set<std::string> frames, with_truth;  // frames shown beside their truth come first
  if (fs::is_directory(folder)) {
    for (const fs::directory_entry& entry : fs::directory_iterator(folder)) {
      const std::string name = entry.path().filename().string();
      if (name.ends_with("_rgb.png")) frames.insert(name.substr(0, name.size() - 8));
      if (name.ends_with("_rgb_truth.png")) with_truth.insert(name.substr(0, name.size() - 14));
    }
  }
  if (!with_truth.empty()) frames = with_truth;
  const std::vector<std::string> all(frames.begin(), frames.end());
  const std::size_t count = std::min(all.size(), static_cast<std::size_t>(std::max(0, most_frames)));
  std::vector<ReportStrip> strips;
  for (std::size_t i = 0; i < count; ++i) {
    ReportStrip strip{all[i * all.size() / count], {}, {}};
    for (const ImageKind& kind : kKinds) {
      const std::string bytes = text_or_empty((folder / (strip.name + kind.suffix)).string());
      if (!bytes.empty()) strip.images.push_back({kind.caption, std::vector<std::uint8_t>(bytes.begin(), bytes.end())});
    }
    strips.push_back(std::move(strip));
  }
  return strips;
}

}  // namespace

ReportInput read_report_input(const std::vector<std::string>& run_folders, int most_frames) {
  if (run_folders.empty()) throw Error(ErrorKind::usage, "a report needs a run folder", "give one or more folders that `train` printed");
  ReportInput input;
  std::set<std::string> taken;
  std::vector<std::string> names;
  for (const std::string& path : run_folders) {
    const RunFolder folder = RunFolder::read(path);
    ReportRun run;
    run.name = unique_name(path, taken);
    run.rows = read_metrics(folder.metrics_path());
    run.config = text_or_empty(folder.config_path());
    const std::string environment = text_or_empty(folder.environment_path());
    if (!environment.empty()) run.environment = parse_environment(environment, folder.environment_path());
    const std::string left_out = text_or_empty(folder.left_out_path());
    if (!left_out.empty()) run.left_out = parse_left_out(left_out, folder.left_out_path());
    names.push_back(run.name);
    input.runs.push_back(std::move(run));
  }
  const RunFolder first = RunFolder::read(run_folders.front());
  if (fs::is_regular_file(first.classes_path())) {
    const ClassTable table = ClassTable::load(first.classes_path());
    for (int c = 0; c < table.valid_count(); ++c) input.classes.push_back({table.valid(c).name, table.valid(c).color});
  }
  for (const MetricsRow& row : input.runs.front().rows) {
    if (row.kind == "eval") input.split = row.split;
  }
  const fs::path render = fs::path(first.path()) / "render" / (input.split.empty() ? "test" : input.split);
  input.strips = read_strips(render, most_frames);
  input.title = join(names, " · ");
  return input;
}

}  // namespace semfield
