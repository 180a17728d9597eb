#include "app/scene/inspect_report.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "core/files.h"
#include "core/text.h"

namespace semfield::app {

namespace {

// To a thousandth of a room, whatever its unit.
std::string extent_text(const Box& box) {
  if (box.empty()) return "none";
  const Vec3d size = box.size();
  const double longest = std::max({size.x, size.y, size.z});
  const int digits = longest > 0 ? std::clamp(3 - static_cast<int>(std::floor(std::log10(longest / 2))), 0, 12) : 3;
  const auto text = [&](Vec3d v) {
    return fmt::format("({:.{}f}, {:.{}f}, {:.{}f})", v.x, digits, v.y, digits, v.z, digits);
  };
  return text(box.lo) + " to " + text(box.hi);
}

std::string size_list(const LoadedScene& scene) {
  std::map<std::pair<int, int>, int> sizes;
  for (const FrameInfo& f : scene.info.frames) ++sizes[{f.camera.width_px, f.camera.height_px}];
  std::vector<std::string> parts;
  for (const auto& [size, count] : sizes)
    parts.push_back(fmt::format("{} x {} ({} frames)", size.first, size.second, count));
  return parts.size() > 4 ? fmt::format("{} different sizes", parts.size()) : join(parts);
}

std::string share_text(std::int64_t part, std::int64_t whole) {
  return whole == 0 ? "-" : fmt::format("{:.2f} %", 100.0 * static_cast<double>(part) / static_cast<double>(whole));
}

struct SplitCounts {
  std::vector<std::int64_t> pixels;  // a class, then void
  std::vector<int> frames;           // labelled frames that see it
  std::int64_t total = 0;
  int labelled = 0;
};

SplitCounts counts_of(const LoadedScene& scene, Split split) {
  const auto size = static_cast<std::size_t>(scene.info.classes.valid_count()) + 1;
  SplitCounts out{std::vector<std::int64_t>(size), std::vector<int>(size), 0, 0};
  for (const int i : scene.frames_of(split)) {
    const std::vector<std::int64_t>& counts = scene.class_pixels[static_cast<std::size_t>(i)];
    if (counts.empty()) continue;
    ++out.labelled;
    for (std::size_t c = 0; c < size; ++c) {
      out.pixels[c] += counts[c];
      out.frames[c] += counts[c] > 0 ? 1 : 0;
      out.total += counts[c];
    }
  }
  return out;
}

std::string class_table(const LoadedScene& scene) {
  const ClassTable& classes = scene.info.classes;
  const SplitCounts train = counts_of(scene, Split::train), test = counts_of(scene, Split::test);
  if (train.labelled + test.labelled == 0) return "classes     no labels\n";
  std::string out = fmt::format(
      "classes     {} in the table; labelled frames: {} train, {} test; shares are of all pixels of labelled frames\n",
      classes.valid_count(), train.labelled, test.labelled);
  constexpr const char* kRow = "  {:>5}  {:<20} {:>9} {:>9}  {}{}\n";
  out += fmt::format(fmt::runtime(kRow), "id", "class", "train", "test", "train frames", "");
  int unseen = 0;
  for (int c = 0; c <= classes.valid_count(); ++c) {
    const auto i = static_cast<std::size_t>(c);
    const bool is_void = c == classes.valid_count();
    if (train.pixels[i] + test.pixels[i] == 0) {
      unseen += is_void ? 0 : 1;
      continue;
    }
    const std::string id = is_void ? "-" : std::to_string(classes.valid(c).id);
    const std::string name = is_void ? "(void)" : classes.valid(c).name;
    out += fmt::format(fmt::runtime(kRow), id, name, share_text(train.pixels[i], train.total),
                       share_text(test.pixels[i], test.total), fmt::format("{} of {}", train.frames[i], train.labelled),
                       !is_void && train.pixels[i] == 0 ? "  cannot be learned" : "");
  }
  if (unseen > 0) out += fmt::format("  {} classes of the table occur in no label\n", unseen);
  return out;
}

struct Counted {
  int depth = 0, read = 0;
  Box cameras;
};

Counted count_frames(const LoadedScene& scene) {
  Counted counted;
  for (std::size_t i = 0; i < scene.info.frames.size(); ++i) {
    counted.depth += scene.info.frames[i].has_depth ? 1 : 0;
    counted.read += scene.frames[i].width_px > 0 ? 1 : 0;
    counted.cameras.include(scene.info.frames[i].world_from_camera.t);
  }
  return counted;
}

// "12 of 35 frames, 3.1 % of their pixels, most in 'a' (30 %)"; "" where nothing is masked.
std::string masks_text(const LoadedScene& scene) {
  std::int64_t frames = 0, masked = 0, all = 0;
  double most = 0;
  std::string name;
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const StoredFrame& frame = scene.frames[i];
    if (frame.mask.empty()) continue;
    const std::int64_t pixels = std::int64_t{frame.width_px} * frame.height_px, own = frame.mask.masked_px();
    ++frames;
    masked += own;
    all += pixels;
    const double share = static_cast<double>(own) / static_cast<double>(pixels);
    if (share <= most) continue;
    most = share;
    name = scene.info.frames[i].name;
  }
  if (frames == 0) return {};
  return fmt::format("{} of {} frames, {:.1f} % of their pixels, most in '{}' ({:.1f} %)", frames, scene.frames.size(),
                     100 * static_cast<double>(masked) / static_cast<double>(all), name, 100 * most);
}

const char* severity_word(Severity severity) {
  return severity == Severity::error ? "error" : severity == Severity::warning ? "warning" : "note";
}

std::string problems(const Diagnostics& diagnostics) {
  const std::vector<Diagnostic> findings = folded(diagnostics);
  const bool none =
      std::all_of(findings.begin(), findings.end(), [](const Diagnostic& d) { return d.severity == Severity::note; });
  std::string out = none ? "problems    none\n" : "";
  for (const Severity severity : {Severity::error, Severity::warning, Severity::note}) {
    for (const Diagnostic& d : findings) {
      if (d.severity == severity) out += fmt::format("{:<11} {}\n", severity_word(severity), d.shown());
    }
  }
  return out;
}

std::string forward_text(const LoadedScene& scene) {
  return fmt::format("forward-facing: {} views from one side", scene.info.frames.size());
}

constexpr const char* kFromThere = "; render, and look at the mesh, from there: nothing shows it from behind";

// The distance from the cameras' common focus beyond which one corner in twenty lies, in distances of the cameras from
// it; 0 where too few corners were found again to say.
double reach_of_surroundings(const LoadedScene& scene) {
  constexpr std::size_t kFewestCorners = 100;
  const SurveyPoints& c = scene.corners;
  if (c.x.size() < kFewestCorners || !(scene.rig.distance_m > 0)) return 0;
  std::vector<double> away;
  for (std::size_t i = 0; i < c.x.size(); ++i) away.push_back(length(Vec3d{c.x[i], c.y[i], c.z[i]} - scene.rig.focus));
  const auto far = away.begin() + static_cast<std::ptrdiff_t>(0.95 * static_cast<double>(away.size()));
  std::nth_element(away.begin(), far, away.end());
  return *far / scene.rig.distance_m;
}

}  // namespace

std::string inspect_report(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use) {
  const std::vector<int> train = scene.frames_of(Split::train), test = scene.frames_of(Split::test);
  const auto [depth, read, cameras] = count_frames(scene);
  std::string out = fmt::format("scene       {}\n", scene.info.name);
  out += fmt::format("frames      {} ({} train, {} test), {} read, {} with depth\n", scene.info.frames.size(),
                     train.size(), test.size(), read, depth);
  out += fmt::format("size        {}\n", size_list(scene));
  out += fmt::format("unit        {}\n", scene.info.metric ? "metres" : "unknown (poses without a scale)");
  out += fmt::format("cameras     {}\n", extent_text(cameras));
  if (scene.rig.forward) out += "views       " + forward_text(scene) + kFromThere + "\n";
  out += fmt::format("bounds      {}{}\n", extent_text(scene.bounds),
                     scene.bounds_from.empty() ? "" : " from " + scene.bounds_from);
  out += fmt::format("near, far   {:.4g}, {:.4g}{}\n", scene.near_m, scene.far_m,
                     scene.near_far_from.empty() ? "" : " from " + scene.near_far_from);
  out += fmt::format("pixel       {:.4g} at the middle depth\n", scene.pixel_footprint_m);
  if (const std::string masked = masks_text(scene); !masked.empty()) out += "masked      " + masked + "\n";
  if (!depth_use.empty()) out += "depth       " + depth_use + "\n";
  if (!scene.geometry.empty()) out += "geometry    " + scene.geometry + "\n";
  if (const auto advice = advised_preset(scene)) out += "preset      " + advice->text() + "\n";
  return out + class_table(scene) + problems(diagnostics);
}

Json inspect_json(const LoadedScene& scene, const Diagnostics& diagnostics, const std::string& depth_use) {
  const auto vector = [](Vec3d v) { return Json{v.x, v.y, v.z}; };
  const auto box = [&](const Box& b) {
    return b.empty() ? Json(nullptr) : Json{{"low", vector(b.lo)}, {"high", vector(b.hi)}};
  };
  const Counted counted = count_frames(scene);
  Json out{{"scene", scene.info.name},
           {"frames", scene.info.frames.size()},
           {"train_frames", scene.frames_of(Split::train).size()},
           {"test_frames", scene.frames_of(Split::test).size()},
           {"frames_read", counted.read},
           {"frames_with_depth", counted.depth},
           {"depth", depth_use},
           {"metric", scene.info.metric},
           {"cameras", box(counted.cameras)},
           {"forward_facing", scene.rig.forward},
           {"bounds", box(scene.bounds)},
           {"bounds_from", scene.bounds_from},
           {"near", scene.near_m},
           {"far", scene.far_m},
           {"pixel", scene.pixel_footprint_m},
           {"geometry", scene.geometry},
           {"cameras_fit", scene.cameras.corners > 0 ? Json(!scene.cameras_are_off()) : Json(nullptr)},
           {"masked", Json::object()},
           {"preset", nullptr},
           {"preset_why", nullptr}};
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const StoredFrame& frame = scene.frames[i];
    if (frame.mask.empty()) continue;
    out["masked"][scene.info.frames[i].name] =
        static_cast<double>(frame.mask.masked_px()) / (static_cast<double>(frame.width_px) * frame.height_px);
  }
  if (const auto advice = advised_preset(scene)) {
    out["preset"] = advice->preset;
    out["preset_why"] = advice->why;
    if (advice->background) out["background"] = *advice->background;
  }
  const ClassTable& classes = scene.info.classes;
  const SplitCounts train = counts_of(scene, Split::train), test = counts_of(scene, Split::test);
  out["labelled_train_frames"] = train.labelled;
  out["labelled_test_frames"] = test.labelled;
  out["classes"] = Json::array();
  for (int c = 0; c < classes.valid_count(); ++c) {
    const auto i = static_cast<std::size_t>(c);
    out["classes"].push_back({{"id", classes.valid(c).id},
                              {"name", classes.valid(c).name},
                              {"train_px", train.pixels[i]},
                              {"test_px", test.pixels[i]},
                              {"train_frames", train.frames[i]}});
  }
  out["findings"] = Json::array();
  for (const Diagnostic& d : folded(diagnostics)) {
    out["findings"].push_back({{"severity", severity_word(d.severity)},
                               {"code", d.code.text()},
                               {"where", d.where},
                               {"message", d.message},
                               {"remedy", d.remedy}});
  }
  return out;
}

std::string PresetAdvice::text() const {
  const std::string set = background ? fmt::format(" with rendering.background: [{:.3g}, {:.3g}, {:.3g}]",
                                                   (*background)[0], (*background)[1], (*background)[2])
                                     : "";
  return preset + set + ": " + why;
}

std::optional<PresetAdvice> advised_preset(const LoadedScene& scene) {
  constexpr double kOpen = 2;  // a room that the cameras all but fill ends nearer
  if (scene.bounds.empty()) return std::nullopt;
  PresetAdvice out{"presets/room.yaml", "", std::nullopt};
  if (scene.plain_background) {
    const auto& c = scene.plain_background->color;
    out.preset = "presets/object.yaml";
    out.why = fmt::format("the cameras stand around an object before one colour, ({}, {}, {})", c[0], c[1], c[2]);
    if (c[0] != 255 || c[1] != 255 || c[2] != 255) out.background = {c[0] / 255.0, c[1] / 255.0, c[2] / 255.0};
    return out;
  }
  const bool depth =
      std::any_of(scene.info.frames.begin(), scene.info.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
  if (depth || !scene.rig.inward) {
    out.why = depth               ? "depth images show where the scene ends"
              : scene.rig.forward ? forward_text(scene)
                                  : "the cameras do not stand around one place";
    return out;
  }
  const double reach = reach_of_surroundings(scene);
  const std::string around = "the cameras stand around one place";
  if (reach > 0 && reach < kOpen) {
    out.why =
        fmt::format("{}, and what lies behind it ends within {:.2g} times their distance, as in a room", around, reach);
    return out;
  }
  out.preset = "presets/unbounded.yaml";
  out.why = around + (reach > 0 ? fmt::format(" and see what lies behind it, beyond {:.2g} times their distance", reach)
                                : " and see what lies behind it");
  return out;
}

std::vector<NextStep> next_of_scene(const std::string& folder, const std::string& name) {
  const std::string file = "configs/" + name + ".yaml";
  if (is_there(file)) return {{"inspect " + shell_word(file), "the configuration that is there already"}};
  return {{"init " + shell_word(folder), "writes a configuration, and says what to do with it"}};
}

std::vector<NextStep> next_of_run(const std::string& run, bool held_out) {
  const std::string word = shell_word(run);
  std::vector<NextStep> steps;
  if (held_out) {
    steps.push_back({"eval " + word, "scores every pixel of the held-out views"});
    steps.push_back({"render " + word + " --split test", "colour, labels and depth of them"});
  }
  steps.push_back({"mesh " + word + " --format ply,html", "the surface, and a page that shows it"});
  return steps;
}

std::vector<NextStep> next_of_look([[maybe_unused]] const std::string& run) {
#ifdef SEMFIELD_WITH_SERVE
  return {{"view " + shell_word(run), "the run in the browser"}};
#else
  return {};
#endif
}

void print_findings(const AppContext& context, const Diagnostics& diagnostics, const std::string& config) {
  const bool brief = context.terminal && !config.empty();
  std::size_t shortened = 0;
  for (const Diagnostic& finding : folded(diagnostics)) {
    const bool note = finding.severity == Severity::note;
    if (!brief) {
      print_note(context, finding.shown());
    } else if (!note) {
      const std::string where = finding.where.substr(0, finding.where.find(" ("));
      const std::string what = finding.message.substr(0, finding.message.find_first_of(":;("));
      print_note(context, fmt::format("{}: {}{}{} [{}]", severity_word(finding.severity), where,
                                      where.empty() ? "" : ": ", what, finding.code.text()));
    }
    shortened += brief && !note ? 1 : 0;
  }
  if (shortened > 0)
    print_note(context, fmt::format("{} finding{} in full: `semfield inspect {}`", shortened, shortened == 1 ? "" : "s",
                                    config));
}

OpenedRun run_of(const std::string& run, const std::vector<std::string>& set, OpenFor what, AppContext& context) {
  Diagnostics diagnostics;
  OpenedRun opened = open_run(run, set, context.registry, diagnostics, what, context.ranks.get());
  context.adopt(opened.session.config);
  print_findings(context, diagnostics);
  return opened;
}

}  // namespace semfield::app
