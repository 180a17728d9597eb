#include "eval/report/report.h"

#include <fmt/format.h>

#include <array>
#include <charconv>
#include <initializer_list>
#include <iterator>
#include <nlohmann/json.hpp>
#include <set>

#include "config/config_tree.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/labelling_record.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "train/metrics_log.h"

namespace semfield {

std::string html_escape(std::string_view text) {
  static const std::map<char, const char*> marks{
      {'&', "&amp;"}, {'<', "&lt;"}, {'>', "&gt;"}, {'"', "&quot;"}, {'\'', "&#39;"}};
  std::string out;
  for (const char c : text) {
    const auto mark = marks.find(c);
    const bool control = static_cast<unsigned char>(c) < 0x20 && c != '\n' && c != '\t';
    out += mark != marks.end() ? mark->second : control ? "\xEF\xBF\xBD" : std::string(1, c);
  }
  return out;
}

std::string base64(std::span<const std::uint8_t> bytes) {
  constexpr std::string_view kDigits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  out.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    const std::size_t left = bytes.size() - i;
    const std::uint32_t group = static_cast<std::uint32_t>(bytes[i]) << 16 |
                                (left > 1 ? static_cast<std::uint32_t>(bytes[i + 1]) << 8 : 0u) |
                                (left > 2 ? static_cast<std::uint32_t>(bytes[i + 2]) : 0u);
    out += kDigits[group >> 18];
    out += kDigits[group >> 12 & 63];
    out += left > 1 ? kDigits[group >> 6 & 63] : '=';
    out += left > 2 ? kDigits[group & 63] : '=';
  }
  return out;
}

std::string script_json(std::string json) {
  for (std::size_t at = json.find('<'); at != std::string::npos; at = json.find('<', at + 6))
    json.replace(at, 1, "\\u003c");
  return json;
}

std::string filled_page(const std::string& page, std::map<std::string, std::string> parts) {
  std::string out;
  for (std::size_t from = 0;;) {
    std::size_t at = std::string::npos;
    auto next = parts.end();
    for (auto part = parts.begin(); part != parts.end(); ++part)
      if (const std::size_t found = page.find(part->first, from); found < at) {
        at = found;
        next = part;
      }
    out += page.substr(from, at == std::string::npos ? at : at - from);
    if (next == parts.end()) break;
    out += next->second;
    from = at + next->first.size();
    parts.erase(next);
  }
  if (parts.empty()) return out;
  throw Error(ErrorKind::no_input, "files.shared.missing", "the page has no place '" + parts.begin()->first + "'",
              "install the component 'app' whole, or run the program from its build folder");
}

namespace {

using Json = nlohmann::ordered_json;

const std::string kPage =
#include "report_page.inc"
    ;

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

// What `read` makes of a file; null without one.
template <class Read>
Json read_if_there(const std::string& path, const Read& read) {
  const std::string text = text_or_empty(path);
  return text.empty() ? Json() : read(text, path);
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

// Split of the last evaluation, of a sample of it too; one of training frames only where there is no other.
std::string report_split(const std::vector<MetricsRow>& rows) {
  std::string last, held_out;
  for (const MetricsRow& row : rows) {
    if (row.kind != "eval") continue;
    last = row.split.substr(0, row.split.size() - (row.split.ends_with(kSampleSuffix) ? kSampleSuffix.size() : 0));
    if (last != "train") held_out = last;
  }
  return held_out.empty() ? last : held_out;
}

// Of training rows the losses alone, but for the last one: there are many, and nothing else of them is drawn.
Json rows_json(const std::vector<MetricsRow>& rows) {
  Json out = Json::array();
  std::size_t last = rows.size();
  while (last > 0 && rows[last - 1].kind != "train") --last;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    MetricsRow row = rows[i];
    if (row.kind == "train" && i + 1 != last)
      std::erase_if(row.values, [](const auto& value) { return !value.first.starts_with("loss"); });
    out.push_back(Json::parse(metrics_line(row)));
  }
  return out;
}

Json strip_json(const fs::path& folder, const std::string& file, const std::string& name, const std::string& note) {
  Json images = Json::array();
  for (const ImageKind& kind : kKinds) {
    const std::string png = text_or_empty((folder / (file + kind.suffix)).string());
    const std::span<const std::uint8_t> bytes(reinterpret_cast<const std::uint8_t*>(png.data()), png.size());
    if (!png.empty()) images.push_back({{"caption", kind.caption}, {"png", "data:image/png;base64," + base64(bytes)}});
  }
  return {{"name", name}, {"note", note}, {"images", images}};
}

// `apart`: frames that are shown elsewhere.
Json read_strips(const fs::path& folder, int most_frames, const std::set<std::string>& apart) {
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
  Json strips = Json::array();
  for (std::size_t i = 0; i < count; ++i) {
    const std::string& frame = all[i * all.size() / count];
    strips.push_back(strip_json(folder, frame, frame, ""));
  }
  return strips;
}

// A list of rows that have these texts.
Json parse_rows(const std::string& text, const std::string& name, std::initializer_list<const char*> keys) {
  try {
    const auto rows = Json::parse(text).get<Json::array_t>();
    for (const Json& row : rows)
      for (const char* key : keys) (void)row.at(key).get<std::string>();
    return rows;
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' cannot be read: {}", name, e.what()),
                "delete it; a report does without");
  }
}

Json run_json(const RunFolder& folder, const std::vector<MetricsRow>& rows, const std::string& name) {
  Json run{{"name", name}, {"rows", rows_json(rows)}, {"rounds", Json::array()}};
  const std::string config = text_or_empty(folder.config_path());
  run["config"] = config;
  run["scene"] = scene_of(config, folder.config_path());
  run["environment"] = Json::array();
  if (const std::string text = text_or_empty(folder.environment_path()); !text.empty())
    run["environment"] = parse_environment(text, folder.environment_path());
  run["left_out"] = read_if_there(folder.left_out_path(), [](const std::string& text, const std::string& path) {
    return parse_rows(text, path, {"component", "rule", "evidence", "proof", "saving_estimate"});
  });
  if (run["left_out"].is_null()) run["left_out"] = Json::array();
  run["labels"] = read_if_there(folder.labels_path(), [&](const std::string& text, const std::string& path) {
    for (const SelfTrainingRound& round : check_label_counts(text, path)) run["rounds"].push_back(round.text());
    return Json::parse(text);
  });
  run["eval"] = read_if_there(folder.final_eval_path(), [](const std::string& text, const std::string& path) {
    (void)check_final_eval(text, path);
    return Json::parse(text);
  });
  run["clicked"] = read_if_there(folder.labelling_path(), [](const std::string& text, const std::string& path) {
    return Json::parse(labelling_record_json(parse_labelling_record(text, path)));
  });
  return run;
}

}  // namespace

std::string read_report(const std::vector<std::string>& run_folders, int most_frames) {
  if (run_folders.empty())
    throw Error(ErrorKind::usage, "usage.word.missing", "a report needs a run folder",
                "give one or more folders that `train` printed");
  Json runs = Json::array(), classes = Json::array(), worst = Json::array(), clicked = Json::array();
  std::set<std::string> taken, apart;
  std::vector<std::string> names;
  std::string split;
  for (const std::string& path : run_folders) {
    const RunFolder folder = RunFolder::read(path);
    const std::vector<MetricsRow> rows = read_metrics(folder.metrics_path());
    if (names.empty()) split = report_split(rows);
    names.push_back(unique_name(path, taken));
    runs.push_back(run_json(folder, rows, names.back()));
  }
  const RunFolder first = RunFolder::read(run_folders.front());
  if (fs::is_regular_file(first.classes_path())) {
    const ClassTable table = ClassTable::load(first.classes_path());
    for (int c = 0; c < table.valid_count(); ++c)
      classes.push_back({{"name", table.valid(c).name}, {"color", table.valid(c).color}});
  }
  const fs::path render = fs::path(first.path()) / "render", pictures = render / (split.empty() ? "test" : split);
  const Json lowest = read_if_there(first.worst_frames_path(), [](const std::string& text, const std::string& path) {
    return parse_rows(text, path, {"frame", "score"});  // worst first
  });
  for (const Json& row : lowest) {
    const std::string file = output_name(row["frame"].get<std::string>());
    Json strip = strip_json(pictures, file, file, row["score"]);
    if (strip["images"].empty()) continue;
    apart.insert(file);
    worst.push_back(std::move(strip));
  }
  Json strips = read_strips(pictures, most_frames, apart);
  if (strips.empty()) strips = read_strips(pictures, most_frames, {});  // a sample as small as the worst
  if (const Json& record = runs[0]["clicked"]; !record.is_null()) {
    for (const Json& frame : record["shown"]) {
      const std::string name = frame["frame"];
      const auto clicks = frame["clicks"].get<std::int64_t>();
      Json strip = strip_json(render / "labelled", output_name(name), name,
                              fmt::format("{} click{}", clicks, clicks == 1 ? "" : "s"));
      if (!strip["images"].empty()) clicked.push_back(std::move(strip));
    }
  }
  return Json{{"title", join(names, " · ")},
              {"split", split},
              {"classes", classes},
              {"runs", runs},
              {"strips", strips},
              {"worst", worst},
              {"clicked", clicked}}
      .dump(-1, ' ', false, Json::error_handler_t::replace);
}

namespace {

// The digest of the first script element without attributes, as a policy names what may run [CSP3].
std::string allowed_script(std::string_view page) {
  constexpr std::string_view kBegin = "<script>", kEnd = "</script>";
  const std::size_t begin = page.find(kBegin);
  if (begin == std::string_view::npos) return {};
  const std::size_t from = begin + kBegin.size();
  const std::string digits = sha256_of(page.substr(from, page.find(kEnd, from) - from));
  std::vector<std::uint8_t> bytes(digits.size() / 2);
  for (std::size_t i = 0; i < bytes.size(); ++i)
    std::from_chars(digits.data() + 2 * i, digits.data() + 2 * i + 2, bytes[i], 16);
  return " 'sha256-" + base64(bytes) + "'";
}

}  // namespace

// A page inside has the policy of the one around it too [CSP3, Sec. 7.8].
std::string report_page(std::string_view json, const std::string& scene) {
  Json data = Json::parse(json);
  if (!scene.empty()) data["scene"] = scene;
  return filled_page(kPage,
                     {{"<!--policy-->", "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src" +
                                            allowed_script(kPage) + allowed_script(scene)},
                      {"<!--title-->", html_escape(data["title"].get<std::string>())},
                      {"/*data*/", script_json(data.dump(-1, ' ', false, Json::error_handler_t::replace))}});
}

namespace {

// The six pictures of a strip, under the names that a report looks for.
void write_strip(const RunFolder& folder, const Session& s, int frame, const RenderedFrame& maps) {
  const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frame)];
  const StoredFrame& truth = s.scene.frames[static_cast<std::size_t>(frame)];
  const MapSize size{maps.width_px, maps.height_px};
  const auto path = [&](const char* kind) { return folder.render_path("test", info.name, kind); };
  const auto rgb = [&](const char* kind, const std::vector<std::uint8_t>& pixels) {
    write_png_rgb(path(kind), size.width_px, size.height_px, pixels);
  };
  const Camera& camera = info.camera;
  rgb("rgb_truth", strided(truth.rgb, camera.width_px, camera.height_px, 3, maps.stride));
  write_color(path("rgb"), size, maps.rgb);
  const DepthRange range = robust_depth_range(truth.depth_m.empty() ? maps.depth_m : truth.depth_m.expand());
  rgb("depth_vis", depth_colors(maps.depth_m, range.near_m, range.far_m));
  if (maps.label.empty()) return;
  if (!truth.label.empty())
    rgb("label_truth_vis",
        label_colors(strided(truth.label.expand(), camera.width_px, camera.height_px, 1, maps.stride),
                     s.scene.info.classes));
  write_label_ids(path("label"), size, maps.label, s.scene.info.classes);
  rgb("label_vis", label_colors(maps.label, s.scene.info.classes));
  rgb("entropy_vis", entropy_colors(maps.entropy, std::log(s.plan.class_of_logit.size())));
}

std::string score_text(const FrameScore& score) {
  std::string out = score.miou_present ? fmt::format("mIoU (present) {:.2f}", *score.miou_present) : std::string();
  if (score.psnr_db) out += fmt::format("{}PSNR {:.1f} dB", out.empty() ? "" : ", ", *score.psnr_db);
  return out;
}

}  // namespace

std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames,
                             const std::string& scene) {
  Json worst = Json::array();
  for (const auto& [score, maps] : frames.strips()) write_strip(folder, session, score.frame, maps);
  for (const auto& [score, maps] : frames.worst()) {
    write_strip(folder, session, score.frame, maps);
    worst.push_back({{"frame", score.name}, {"score", score_text(score)}});
  }
  write_file_atomic(folder.worst_frames_path(), worst.dump(2, ' ', false, Json::error_handler_t::replace) + "\n");
  const std::string data = read_report({folder.path()}, static_cast<int>(frames.strips().size()));
  write_file_atomic(folder.report_path(), report_page(data, scene));
  return folder.report_path();
}

}  // namespace semfield
