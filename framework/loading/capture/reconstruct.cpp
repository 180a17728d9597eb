#include "loading/capture/reconstruct.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <optional>
#include <set>

#include "core/text.h"
#include "loading/capture/settle_model.h"
#include "loading/colmap_model.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr double kEnough = 0.95;
constexpr double kMostErrorPx = 1.1;  // a lens that fits leaves 0.5 to 1.05 (docs/evidence/capture.md)
constexpr double kMostBend = 0.15;
constexpr std::size_t kMostForAllPairs = 150;

struct Attempt {
  FeatureSettings features;
  bool relaxed;
  bool patient;  // all pairs of a film too
};

// A fisheye whose image holds a half sphere from corner to corner has a focal length of a third of its diagonal.
constexpr double kPhotographFocal = 1.2, kFisheyeFocal = 0.4, kViewFocal = 0.5;

std::vector<Attempt> ladder(LensAsked asked) {
  const auto quick = [](const char* name, const char* lens, double focal) {
    return FeatureSettings{name, lens, focal, 1024, 2048, 1, 0.0067};
  };
  const auto patient = [](const char* name, const char* lens, double focal) {
    return FeatureSettings{name, lens, focal, 1600, 6144, 2, 0.004};
  };
  const auto steps = [](const FeatureSettings& first, const FeatureSettings& last) {
    return std::vector<Attempt>{{first, false, false}, {first, true, false}, {last, true, true}};
  };
  const FeatureSettings wide = patient("fisheye", "OPENCV_FISHEYE", kFisheyeFocal);
  if (asked == LensAsked::fisheye) return steps(quick("fisheye_quick", "OPENCV_FISHEYE", kFisheyeFocal), wide);
  if (asked == LensAsked::equirectangular)
    return steps(quick("views_quick", "SIMPLE_PINHOLE", kViewFocal), patient("views", "SIMPLE_PINHOLE", kViewFocal));
  std::vector<Attempt> all =
      steps(quick("quick", "SIMPLE_RADIAL", kPhotographFocal), patient("patient", "OPENCV", kPhotographFocal));
  all.push_back({wide, true, true});
  return all;
}

// How much nearer to the middle than without distortion a lens shows what lies at the left or the upper border of its
// image: 0.01 to 0.05 of photographs, 0.3 of a fisheye of 140 degrees that is taken for an OPENCV lens.
double border_bend(const Camera& camera) {
  const auto bend = [](Vec3d ray, double across, double pixels) {
    return ray.z > 0 ? std::abs(1 - std::abs(pixels * ray.z / across)) : 1;  // no ray: beyond the lens
  };
  const Vec3d left = camera.direction(0, camera.cy), top = camera.direction(camera.cx, 0);
  return std::max(bend(left, left.x, camera.cx / camera.fx), bend(top, top.y, camera.cy / camera.fy));
}

FoundModel model_in(const std::string& folder) {
  Diagnostics unread;
  const ColmapModel model = read_colmap_model(folder, unread);
  unread.throw_if_errors(ErrorKind::data, "COLMAP's model has problems:");
  FoundModel out;
  out.folder = folder;
  out.points = model.points.size();
  out.error_px = model.error_px;
  for (const ColmapImage& image : model.images) out.images.push_back(image.name);
  for (const auto& [id, camera] : model.cameras)
    out.bent = out.bent || (!camera.is_wide() && border_bend(camera) > kMostBend);
  return out;
}

bool has_enough(const FoundModel& model, std::size_t count) {
  return static_cast<double>(model.images.size()) >= kEnough * static_cast<double>(count);
}
// A lens that does not fit gives wrong poses to every image.
bool is_enough(const FoundModel& model, std::size_t count) {
  return has_enough(model, count) && model.error_px <= kMostErrorPx && !model.bent;
}

bool is_better(const FoundModel& a, const FoundModel& b, std::size_t count) {
  if (is_enough(a, count) != is_enough(b, count)) return is_enough(a, count);
  if (a.images.size() != b.images.size()) return a.images.size() > b.images.size();
  return a.error_px < b.error_px;
}

std::vector<Pair> pairs_of(const ReconstructTask& task, bool patient) {
  const std::size_t count = task.names.size();
  const bool few = count <= kMostForAllPairs;
  return few && (patient || !task.in_order) ? all_pairs(count) : pairs_in_order(count);
}

// Runs `step` unless an earlier call of the program did.
template <class Step>
void once(PrepareState& state, const std::string& name, const Step& step) {
  if (state.done(name) != nullptr) return;
  step();
  state.mark(name);
}

// Features and matches, found anew where prepare_scene() has removed them at the end of an earlier call.
void need_matches(const Attempt& attempt, const ReconstructTask& task, const ColmapSteps& colmap, PrepareState& state) {
  const FeatureSettings& s = attempt.features;
  const std::string features = "features " + s.name, matches = "matches " + s.name;
  if (!fs::exists(colmap.database(s))) {
    state.forget(features);
    state.forget(matches);
  }
  once(state, features, [&] { colmap.extract(s, task.camera_per_folder, task.names.size()); });
  once(state, matches, [&] { colmap.match(s, task.names, pairs_of(task, attempt.patient)); });
}

// Models of one attempt, the best first.
std::vector<FoundModel> models_of(const Attempt& attempt, const ReconstructTask& task, const ColmapSteps& colmap,
                                  PrepareState& state) {
  const FeatureSettings& s = attempt.features;
  const std::string name = "models " + s.name + (attempt.relaxed ? " relaxed" : "");
  if (state.done(name) == nullptr) {
    need_matches(attempt, task, colmap, state);
    std::string folders;
    for (const std::string& folder : colmap.map(s, attempt.relaxed, task.names.size())) folders += folder + "\n";
    state.mark(name, folders);
  }
  std::vector<FoundModel> out;
  for (const std::string& folder : state.lines(name)) out.push_back(model_in(folder));
  std::stable_sort(out.begin(), out.end(),
                   [&](const FoundModel& a, const FoundModel& b) { return is_better(a, b, task.names.size()); });
  return out;
}

// "photographs 12 to 19 (a.jpg to h.jpg)".
std::string range_text(const std::vector<std::string>& names, std::size_t first, std::size_t last) {
  if (first == last) return "photograph " + std::to_string(first + 1) + " (" + names[first] + ")";
  return "photographs " + std::to_string(first + 1) + " to " + std::to_string(last + 1) + " (" + names[first] + " to " +
         names[last] + ")";
}

// What is said before an attempt that follows another.
std::string next_attempt(const Reconstruction& found, std::size_t count) {
  std::string said = fmt::format("{} of {} photographs have a pose", found.best.images.size(), count);
  if (has_enough(found.best, count) && found.best.bent)
    said += ", but the lens bends borders as a fisheye does";
  else if (has_enough(found.best, count))
    said += fmt::format(", but the lens misses their points by {:.2f} pixels", found.best.error_px);
  return said +
         fmt::format("; attempt {0} takes longer. To do without, stop and give the same command with --attempts {1}",
                     found.attempts, found.attempts - 1);
}

}  // namespace

Reconstruction reconstruct(const ReconstructTask& task, const ColmapSteps& colmap, PrepareState& state) {
  Reconstruction out;
  double earlier = 0;  // attempts of an earlier call, whose best model has been refined
  if (const std::string* refined = state.done("refined")) (void)parse_number(*refined, earlier);
  const double asked = task.attempts > 0 ? task.attempts : earlier > 0 ? earlier : kMostAttempts;
  const double most = std::max(asked, earlier);
  const std::size_t count = task.names.size();
  const std::vector<Attempt> attempts = ladder(task.lens);
  const Attempt* best = nullptr;  // which made the best model
  bool is_new = false;
  for (const Attempt& attempt : attempts) {
    if (out.attempts >= most || is_enough(out.best, count)) break;
    if (has_enough(out.best, count) && !attempt.patient) continue;  // it asks less of images, and none are missing
    if (out.attempts++ > 0 && out.attempts > earlier) task.note(next_attempt(out, count));
    std::vector<FoundModel> models = models_of(attempt, task, colmap, state);
    if (models.empty() || !(out.best.images.empty() || is_better(models.front(), out.best, count))) continue;
    out.best = std::move(models.front());
    best = &attempt;
    is_new = out.attempts > earlier;
    models.erase(models.begin());
    out.others = std::move(models);
  }
  if (out.best.images.size() < 3) {
    throw Error(ErrorKind::data, "capture.poses.none",
                "COLMAP found no poses: no " + std::string(out.best.images.empty() ? "two" : "three") + " of the " +
                    std::to_string(task.names.size()) + " photographs share enough of what they show, in " +
                    std::to_string(out.attempts) + " attempts",
                "take more photographs, each showing two thirds of what the one before shows, sharp, of things with "
                "texture, and walk rather than turn on the spot");
  }
  if (is_new) {
    state.forget("refined");
    need_matches(*best, task, colmap, state);
    state.mark("misplaced", join(settle_model({out.best.folder, best->features, task.names, task.work}, colmap), "\n"));
  }
  if (out.attempts > earlier) state.mark("refined", std::to_string(out.attempts));
  out.misplaced = state.lines("misplaced");
  out.best = model_in((fs::path(task.work) / "refined").string());
  return out;
}

std::vector<Missing> missing_images(const std::vector<std::string>& names, const Reconstruction& found,
                                    const std::vector<std::string>& blurred) {
  const std::set<std::string> posed(found.best.images.begin(), found.best.images.end()),
      unsharp(blurred.begin(), blurred.end());
  const std::set<std::string> misplaced(found.misplaced.begin(), found.misplaced.end());
  std::set<std::string> elsewhere;
  for (const FoundModel& other : found.others) elsewhere.insert(other.images.begin(), other.images.end());
  enum class Why { has_pose, is_misplaced, is_blurred, fits_others, stands_alone };
  const auto why = [&](const std::string& name) {
    if (posed.contains(name)) return Why::has_pose;
    if (misplaced.contains(name)) return Why::is_misplaced;
    if (unsharp.contains(name)) return Why::is_blurred;
    return elsewhere.contains(name) ? Why::fits_others : Why::stands_alone;
  };
  std::vector<Missing> out;
  for (std::size_t i = 0; i < names.size(); ++i) {
    const Why cause = why(names[i]);
    if (cause == Why::has_pose) continue;
    std::size_t last = i;
    while (last + 1 < names.size() && why(names[last + 1]) == cause) ++last;
    std::string between = "take some between";
    if (i > 0 && last + 1 < names.size())
      between += " photographs " + std::to_string(i) + " and " + std::to_string(last + 2);
    else
      between += " them and the others";
    const bool one = i == last;
    std::string text = range_text(names, i, last);
    if (cause == Why::is_misplaced) {
      text += std::string(one ? " was" : " were") + " placed far from the photographs before and after " +
              (one ? "it" : "them") + ", at something that looks the same, and " + (one ? "is" : "are") +
              " left out: " + between;
    } else if (cause == Why::is_blurred) {
      text += std::string(one ? " is" : " are") + " blurred: take " + (one ? "it" : "them") +
              " again, standing still or with more light";
    } else if (cause == Why::fits_others) {
      text += " fit" + std::string(one ? "s" : "") + " others that are missing, but not the rest: " + between +
              ", or prepare another place as a scene of its own";
    } else {
      text += " share" + std::string(one ? "s" : "") + " too little with the others: " + between;
    }
    out.push_back({i, last, std::move(text)});
    i = last;
  }
  return out;
}

}  // namespace semfield
