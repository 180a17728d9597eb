// A report's input, read from run folders.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <iterator>
#include <nlohmann/json.hpp>
#include <set>

#include "config/config_tree.h"
#include "core/error.h"
#include "report/report.h"
#include "scene/classes/class_table.h"
#include "scene/output_names.h"
#include "system/files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

struct ImageKind {
  const char *suffix, *caption;
};
constexpr std::array<ImageKind, 7> kKinds{{{"_clicks.png", "photograph, clicks"},
                                           {"_rgb_truth.png", "colour, truth"},
                                           {"_rgb.png", "colour, rendered"},
                                           {"_label_truth_vis.png", "label, truth"},
                                           {"_label_vis.png", "label, rendered"},
                                           {"_entropy_vis.png", "entropy"},
                                           {"_depth_vis.png", "depth"}}};

std::string text_or_empty(const std::string& path) {
  return fs::is_regular_file(path) ? read_text_file(path) : std::string();
}

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

// "TYPE, room_0": the dataset's type and the folder or file that it lies in.
std::string scene_of(const std::string& config, const std::string& path) {
  if (config.empty()) return {};
  const ConfigNode root = parse_config_text(config, path);
  const ConfigNode* scene = root.find("scene");
  if (scene == nullptr || !scene->is_map()) return {};
  std::string text;
  for (const char* key : {"type", "root", "file"}) {
    const ConfigNode* value = scene->find(key);
    if (value == nullptr || !value->is_scalar() || value->text().empty()) continue;
    const fs::path place = fs::path(value->text()).lexically_normal();
    text += (text.empty() ? "" : ", ") + (place.has_filename() ? place : place.parent_path()).filename().string();
  }
  return text;
}

ReportStrip read_strip(const fs::path& folder, const std::string& name, const std::string& note) {
  ReportStrip strip{name, note, {}};
  for (const ImageKind& kind : kKinds) {
    const std::string bytes = text_or_empty((folder / (name + kind.suffix)).string());
    if (!bytes.empty()) strip.images.push_back({kind.caption, std::vector<std::uint8_t>(bytes.begin(), bytes.end())});
  }
  return strip;
}

// `apart`: frames that are shown elsewhere.
std::vector<ReportStrip> read_strips(const fs::path& folder, int most_frames, const std::set<std::string>& apart) {
  std::set<std::string> frames, with_truth;  // frames shown beside their truth come first
  if (fs::is_directory(folder)) {
    for (const fs::directory_entry& entry : sorted_folder(folder.string())) {
      const std::string name = entry.path().filename().string();
      if (name.ends_with("_rgb.png")) frames.insert(name.substr(0, name.size() - 8));
      if (name.ends_with("_rgb_truth.png")) with_truth.insert(name.substr(0, name.size() - 14));
    }
  }
  if (!with_truth.empty()) frames = with_truth;
  std::vector<std::string> all;
  std::set_difference(frames.begin(), frames.end(), apart.begin(), apart.end(), std::back_inserter(all));
  const std::size_t count = std::min(all.size(), static_cast<std::size_t>(std::max(0, most_frames)));
  std::vector<ReportStrip> strips;
  for (std::size_t i = 0; i < count; ++i) strips.push_back(read_strip(folder, all[i * all.size() / count], {}));
  return strips;
}

}  // namespace

std::string worst_frames_json(const std::vector<WorstFrame>& frames) {
  nlohmann::ordered_json json = nlohmann::ordered_json::array();
  for (const WorstFrame& frame : frames) json.push_back({{"frame", frame.name}, {"score", frame.note}});
  return json.dump(2, ' ', false, nlohmann::ordered_json::error_handler_t::replace) + "\n";
}

std::vector<WorstFrame> parse_worst_frames(std::string_view json, const std::string& name) {
  std::vector<WorstFrame> frames;
  try {
    for (const nlohmann::json& row : nlohmann::json::parse(json)) frames.push_back({row.at("frame"), row.at("score")});
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' cannot be read: {}", name, e.what()),
                "delete it; a report does without");
  }
  return frames;
}

ReportInput read_report_input(const std::vector<std::string>& run_folders, int most_frames) {
  if (run_folders.empty())
    throw Error(ErrorKind::usage, "usage.word.missing", "a report needs a run folder",
                "give one or more folders that `train` printed");
  ReportInput input;
  std::set<std::string> taken;
  std::vector<std::string> names;
  for (const std::string& path : run_folders) {
    const RunFolder folder = RunFolder::read(path);
    ReportRun run;
    run.name = unique_name(path, taken);
    run.rows = read_metrics(folder.metrics_path());
    run.config = text_or_empty(folder.config_path());
    run.scene = scene_of(run.config, folder.config_path());
    const std::string environment = text_or_empty(folder.environment_path());
    if (!environment.empty()) run.environment = parse_environment(environment, folder.environment_path());
    const std::string left_out = text_or_empty(folder.left_out_path());
    if (!left_out.empty()) run.left_out = parse_left_out(left_out, folder.left_out_path());
    const std::string labels = text_or_empty(folder.labels_path());
    if (!labels.empty()) run.labels = parse_label_counts(labels, folder.labels_path());
    const std::string eval = text_or_empty(folder.final_eval_path());
    if (!eval.empty()) run.eval = parse_final_eval(eval, folder.final_eval_path());
    const std::string clicked = text_or_empty(folder.labelling_path());
    if (!clicked.empty()) run.clicked = parse_labelling_record(clicked, folder.labelling_path());
    names.push_back(run.name);
    input.runs.push_back(std::move(run));
  }
  const RunFolder first = RunFolder::read(run_folders.front());
  if (fs::is_regular_file(first.classes_path())) {
    const ClassTable table = ClassTable::load(first.classes_path());
    for (int c = 0; c < table.valid_count(); ++c) input.classes.push_back({table.valid(c).name, table.valid(c).color});
  }
  input.split = report_split(input.runs.front().rows);
  const fs::path render = fs::path(first.path()) / "render" / (input.split.empty() ? "test" : input.split);
  std::set<std::string> apart;
  const std::string worst = text_or_empty(first.worst_frames_path());
  if (!worst.empty()) {
    for (const WorstFrame& frame : parse_worst_frames(worst, first.worst_frames_path())) {
      const std::string file = output_name(frame.name);
      ReportStrip strip = read_strip(render, file, frame.note);
      if (strip.images.empty()) continue;
      apart.insert(file);
      input.worst.push_back(std::move(strip));
    }
  }
  input.strips = read_strips(render, most_frames, apart);
  if (input.strips.empty()) input.strips = read_strips(render, most_frames, {});  // a sample as small as the worst
  if (const std::optional<LabellingRecord>& clicked = input.runs.front().clicked) {
    for (const LabellingRecord::Frame& frame : clicked->shown) {
      ReportStrip strip = read_strip(fs::path(first.path()) / "render" / "labelled", output_name(frame.name),
                                     fmt::format("{} click{}", frame.clicks, frame.clicks == 1 ? "" : "s"));
      strip.name = frame.name;
      if (!strip.images.empty()) input.clicked.push_back(std::move(strip));
    }
  }
  input.title = join(names, " · ");
  return input;
}

}  // namespace semfield
