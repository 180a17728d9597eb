#include "scene/loading/capture/prepare.h"

#include <fmt/format.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <nlohmann/json.hpp>
#include <set>
#include <unordered_set>

#include "compute/parallel.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "scene/survey/bundle.h"

namespace semfield {

using Json = nlohmann::ordered_json;

PrepareState::PrepareState(std::string file, std::string identity)
    : file_(std::move(file)), identity_(std::move(identity)) {
  if (!fs::exists(file_)) {
    write();
    return;
  }
  const Json root = Json::parse(read_text_file(file_), nullptr, false);
  const bool ours = root.is_object() && root.contains("made_from") && root["made_from"] == identity_ &&
                    root.contains("steps") && root["steps"].is_object();
  if (!ours)
    throw Error(ErrorKind::cannot_create, "capture.scene.other",
                "the scene of '" + file_ + "' was begun from other photographs or with other options",
                "name another folder with --out, or remove this one");
  for (const auto& [step, found] : root["steps"].items())
    steps_[step] = found.is_string() ? found.get<std::string>() : "";
}

const std::string* PrepareState::done(const std::string& step) const {
  const auto found = steps_.find(step);
  return found == steps_.end() ? nullptr : &found->second;
}

std::vector<std::string> PrepareState::lines(const std::string& step) const {
  std::vector<std::string> out;
  const std::string* const found = done(step);
  std::string_view rest = found == nullptr ? std::string_view() : *found;
  for (std::string_view line; next_line(rest, line);) out.emplace_back(line);
  return out;
}

void PrepareState::mark(const std::string& step, const std::string& found) {
  steps_[step] = found;
  write();
}

void PrepareState::forget(const std::string& step) {
  if (steps_.erase(step) > 0) write();
}

void PrepareState::write() const {
  write_file_atomic(
      file_,
      Json{{"made_from", identity_}, {"steps", steps_}}.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

PrepareFolder::PrepareFolder(const std::string& scene) : prepare_(scene + "/prepare") {
  std::error_code unknown;
  if (is_there(scene) && !is_there(prepare_) && !fs::is_empty(scene, unknown))
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + scene + "' is there already",
                "name another folder with --out");
  create_folders(logs());
  create_folders(work());
  if (const int cause = lock_.take(prepare_); cause == EWOULDBLOCK)
    throw Error(ErrorKind::cannot_create, "capture.scene.busy",
                "the scene '" + scene + "' is in use by " + lock_.holder(), "wait until it has ended");
  else if (cause != 0)
    throw write_error("lock", prepare_, cause);
}

PrepareState PrepareFolder::steps(const std::string& text) const { return {prepare_ + "/steps.json", sha256_of(text)}; }

std::vector<Pair> all_pairs(std::size_t count) {
  std::vector<Pair> out;
  for (std::size_t apart = 1; apart < count; ++apart)
    for (std::size_t i = 0; i + apart < count; ++i) out.emplace_back(i, i + apart);
  return out;
}

std::vector<Pair> pairs_in_order(std::size_t count) {
  constexpr std::size_t kBehind = 10, kSpread = 50;
  std::vector<Pair> out;
  std::set<Pair> seen;
  const auto add = [&](std::size_t i, std::size_t j) {
    if (j < count && seen.emplace(i, j).second) out.emplace_back(i, j);
  };
  for (std::size_t i = 0; i < count; ++i) {
    for (std::size_t k = 1; k <= kBehind; ++k) add(i, i + k);
    for (std::size_t k = 16; k < count; k *= 2) add(i, i + k);
  }
  const std::size_t spread = std::min(count, kSpread);
  for (const auto& [i, j] : all_pairs(spread)) add(i * count / spread, j * count / spread);
  return out;
}

double last_number_after(const std::string& text, const std::string& before) {
  const std::size_t at = text.rfind(before);
  if (at == std::string::npos) return 0;
  const std::size_t first = at + before.size();
  std::size_t end = first;
  while (end < text.size() && is_digit(text[end])) ++end;
  double value = 0;
  return parse_number(std::string_view(text).substr(first, end - first), value) ? value : 0;
}

// What is asked of an image that joins: one at a wrong place does more harm than one without, and things that repeat
// look alike.
const std::vector<std::string> kStrict = word_list(
    "--Mapper.min_num_matches 30 --Mapper.abs_pose_min_num_inliers 60 --Mapper.abs_pose_min_inlier_ratio 0.4");
const std::vector<std::string> kRelaxed = word_list(
    "--Mapper.init_min_num_inliers 50 --Mapper.init_min_tri_angle 8 --Mapper.abs_pose_min_num_inliers 15 "
    "--Mapper.abs_pose_min_inlier_ratio 0.15 --Mapper.min_num_matches 10");

std::string ColmapSteps::database(const FeatureSettings& settings) const {
  return (fs::path(work_) / (settings.name + ".db")).string();
}

std::string ColmapSteps::log(const std::string& name) const { return (fs::path(logs_) / (name + ".txt")).string(); }

void ColmapSteps::run(std::vector<std::string> words, const std::string& log, const CaptureStep& step,
                      const std::function<double()>& done, std::size_t total) const {
  run_program(programs_, "colmap", {.words = std::move(words), .log = log, .tick = [&] {
                                      progress_(step, done(), static_cast<double>(total));
                                    }});
}

void ColmapSteps::extract(const FeatureSettings& s, bool camera_per_folder, std::size_t images) const {
  const std::string file = log("features_" + s.name);
  for (const char* end : {"", "-wal", "-shm", "-journal"}) fs::remove(database(s) + end);
  const std::vector<std::string> settings = word_list(fmt::format(
      "--ImageReader.camera_model {} --ImageReader.default_focal_length_factor {:g} --ImageReader.single_camera{} 1 "
      "--SiftExtraction.use_gpu 0 --SiftExtraction.num_threads {} --SiftExtraction.max_image_size {} "
      "--SiftExtraction.max_num_features {} --SiftExtraction.max_num_orientations {} --SiftExtraction.peak_threshold "
      "{:f}",
      s.lens, s.focal, camera_per_folder ? "_per_folder" : "", threads_, s.size_px, s.features, s.orientations,
      s.contrast));
  run(
      all_words({{"feature_extractor", "--database_path", database(s), "--image_path", images_}, settings}), file,
      {"finding features of", "photographs"}, [&] { return last_number_after(log_text(file), "Processed file ["); },
      images);
}

// In parts: each is in the database when its call has ended, and its end is known.
void ColmapSteps::match(const FeatureSettings& s, const std::vector<std::string>& names,
                        const std::vector<Pair>& pairs) const {
  constexpr std::size_t kPart = 100;
  const std::string list = (fs::path(work_) / "pairs.txt").string();
  for (std::size_t first = 0; first < pairs.size(); first += kPart) {
    std::string text;
    for (std::size_t i = first; i < std::min(pairs.size(), first + kPart); ++i)
      text += names[pairs[i].first] + " " + names[pairs[i].second] + "\n";
    write_file_atomic(list, text);
    progress_({"matching", "pairs"}, static_cast<double>(first), static_cast<double>(pairs.size()));
    run(
        {"matches_importer", "--database_path", database(s), "--match_list_path", list, "--match_type", "pairs",
         "--SiftMatching.use_gpu", "0", "--SiftMatching.num_threads", std::to_string(threads_)},
        log("matches_" + s.name), {"matching", "pairs"}, [&] { return static_cast<double>(first); }, pairs.size());
  }
}

void ColmapSteps::need_matches(const FeatureSettings& s, const std::vector<std::string>& names, bool camera_per_folder,
                               const std::function<std::vector<Pair>()>& pairs, PrepareState& state,
                               const std::string& suffix) const {
  const std::string features = "features" + suffix, matches = "matches" + suffix;
  if (!fs::exists(database(s))) {
    state.forget(features);
    state.forget(matches);
  }
  if (state.done(features) == nullptr) {
    extract(s, camera_per_folder, names.size());
    state.mark(features);
  }
  if (state.done(matches) == nullptr) {
    match(s, names, pairs());
    state.mark(matches);
  }
}

std::vector<std::string> ColmapSteps::map(const FeatureSettings& s, bool relaxed, std::size_t images) const {
  const std::string name = s.name + (relaxed ? "_relaxed" : ""), file = log("models_" + name);
  const fs::path folder = fs::path(work_) / ("models_" + name);
  fs::remove_all(folder);
  create_folders(folder.string());
  // All is adjusted at the end once more, so less often on the way.
  const std::vector<std::string> usual =
      word_list(fmt::format("--Mapper.num_threads {} --Mapper.max_num_models 10 --Mapper.min_model_size {} "
                            "--Mapper.ba_global_max_num_iterations 20 --Mapper.ba_global_images_ratio 1.4 "
                            "--Mapper.ba_global_points_ratio 1.4",
                            threads_, std::clamp<std::size_t>(images / 3, 3, 10)));
  const auto registered = [&] {
    const std::string text = log_text(file);
    const std::size_t at = text.rfind("Registering image #");
    return at == std::string::npos ? 0 : last_number_after(text.substr(at), " (");
  };
  try {
    run(all_words(
            {{"mapper", "--database_path", database(s), "--image_path", images_, "--output_path", folder.string()},
             usual,
             relaxed ? kRelaxed : kStrict}),
        file, {"finding poses of", "photographs"}, registered, images);
  } catch (const Error& e) {
    // So ends a mapper that finds no two images to begin with.
    if (e.kind() != ErrorKind::failure || log_text(file).find("sparse model") == std::string::npos) throw;
  }
  std::vector<std::string> out;
  for (const fs::directory_entry& entry : sorted_folder(folder.string()))
    if (fs::exists(entry.path() / "images.bin")) out.push_back(entry.path().string());
  return out;
}

// A program that makes one model of another.
void ColmapSteps::model_step(const std::string& name, const std::string& from, const std::string& to,
                             std::vector<std::string> words) const {
  fs::remove_all(to);
  create_folders(to);
  words.insert(words.end(), {"--input_path", from, "--output_path", to});
  const CaptureStep step{"adjusting all poses,", "passes"};
  progress_(step, 0, 1);
  run(
      std::move(words), log(name), step, [] { return 0.0; }, 1);
}

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
constexpr double kPhotographFocal = 1.2, kFisheyeFocal = 0.4;

std::vector<Attempt> ladder(bool is_fisheye) {
  const FeatureSettings quick{"quick", "SIMPLE_RADIAL", kPhotographFocal, 1024, 2048, 1, 0.0067},
      patient{"patient", "OPENCV", kPhotographFocal, 1600, 6144, 2, 0.004},
      wide_quick{"fisheye_quick", "OPENCV_FISHEYE", kFisheyeFocal, 1024, 2048, 1, 0.0067},
      wide{"fisheye", "OPENCV_FISHEYE", kFisheyeFocal, 1600, 6144, 2, 0.004};
  if (is_fisheye) return {{wide_quick, false, false}, {wide_quick, true, false}, {wide, true, true}};
  return {{quick, false, false}, {quick, true, false}, {patient, true, true}, {wide, true, true}};
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

void need_matches(const Attempt& attempt, const ReconstructTask& task, const ColmapSteps& colmap, PrepareState& state) {
  colmap.need_matches(
      attempt.features, task.names, task.camera_per_folder, [&] { return pairs_of(task, attempt.patient); }, state,
      " " + attempt.features.name);
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

constexpr double kRounds[] = {3, 2, 2};  // times the mean error
constexpr std::size_t kMostTorn = 3;     // of which one of the images may be torn; more are no outliers

ColmapModel read_known(const std::string& folder) {
  Diagnostics known;  // said when the model was found
  return read_colmap_model(folder, known);
}

// The model `from` with OPENCV lenses or fisheyes, into `to`.
void free_lenses(const std::string& from, const std::string& to) {
  fs::remove_all(to);
  create_folders(to);
  write_file_atomic((fs::path(to) / "cameras.bin").string(), colmap_cameras_file(read_known(from).cameras));
  for (const char* name : {"images.bin", "points3D.bin"}) fs::copy_file(fs::path(from) / name, fs::path(to) / name);
}

// A mapper ends with observations that are wrong among those that are right, and least squares [Schonberger16] weighs
// the wrong ones most. So torn_images() are placed anew among the points of the others, misplaced_images() are left
// out, lenses become OPENCV ones or fisheyes, and three times what misses its point by more than 3, 2 and 2 times the
// mean error is left out and all else adjusted. Models on the way lie in the task's folder, in which "refined" is the
// last. Returns the names of the misplaced images.
std::vector<std::string> settle_model(const std::string& model, const FeatureSettings& features,
                                      const ReconstructTask& task, const ColmapSteps& colmap) {
  const auto at = [&](const char* name) { return (fs::path(task.work) / name).string(); };
  // The model `from` without what misses its point by over `most_px` pixels; its errors are those that are left.
  const auto filter = [&](const std::string& from, double most_px, const char* to) {
    colmap.model_step("filtered", from, at(to),
                      {"point_filtering", "--max_reproj_error", fmt::format("{:g}", most_px)});
  };
  const auto remove = [&](const std::string& from, const std::vector<std::string>& names, const char* to) {
    const std::string list = at("removed.txt");
    write_file_atomic(list, join(names, "\n") + "\n");
    colmap.model_step("removed", from, at(to), {"image_deleter", "--image_names_path", list});
  };
  std::string current = model;
  const ColmapModel found = read_known(current);
  filter(current, kRounds[0] * found.error_px, "filtered");
  const std::vector<std::string> torn = torn_images(found, read_known(at("filtered")));
  if (!torn.empty() && kMostTorn * torn.size() <= found.images.size()) {
    remove(at("filtered"), torn, "sound");
    // Images of the database without a pose get one among the points of the others, where enough of these say so.
    colmap.model_step("placed", at("sound"), current = at("placed"),
                      all_words({{"image_registrator", "--database_path", colmap.database(features)}, kStrict}));
  }
  const std::vector<std::string> misplaced = misplaced_images(read_known(current), task.names);
  if (!misplaced.empty()) {
    remove(current, misplaced, "kept");
    current = at("kept");
  }
  free_lenses(current, at("refined"));
  for (const double times : kRounds) {
    const double most_px = times * read_known(at("refined")).error_px;
    filter(at("refined"), most_px, "filtered");
    // The errors in its files stay those of the model before.
    colmap.model_step("adjusted", at("filtered"), at("adjusted"), {"bundle_adjuster"});
    filter(at("adjusted"), most_px, "refined");
  }
  return misplaced;
}

// "photographs 12 to 19 (a.jpg to h.jpg)".
std::string range_text(const std::vector<std::string>& names, std::size_t first, std::size_t last) {
  if (first == last) return fmt::format("photograph {} ({})", first + 1, names[first]);
  return fmt::format("photographs {} to {} ({} to {})", first + 1, last + 1, names[first], names[last]);
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
  const std::vector<Attempt> attempts = ladder(task.fisheye);
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
  if (out.best.images.size() < 3)
    throw Error(ErrorKind::data, "capture.poses.none",
                fmt::format("COLMAP found no poses: no {} of the {} photographs share enough of what they show, in {} "
                            "attempts",
                            out.best.images.empty() ? "two" : "three", count, out.attempts),
                "take more photographs, each showing two thirds of what the one before shows, sharp, of things with "
                "texture, and walk rather than turn on the spot");
  if (is_new) {
    state.forget("refined");
    need_matches(*best, task, colmap, state);
    state.mark("misplaced", join(settle_model(out.best.folder, best->features, task, colmap), "\n"));
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
  // What is said of each cause, by its place; of one photograph, where `are` is "is" and so on, or of several.
  constexpr const char *kMisplaced =
                           "{range} {were} placed far from the photographs before and after {them}, at "
                           "something that looks the same, and {are} left out: {between}",
                       *kBlurred = "{range} {are} blurred: take {them} again, standing still or with more light",
                       *kElsewhere =
                           "{range} fit{s} others that are missing, but not the rest: {between}, or prepare "
                           "another place as a scene of its own",
                       *kAlone = "{range} share{s} too little with the others: {between}";
  const auto why = [&](const std::string& name) -> const char* {  // null: it has a pose
    if (posed.contains(name)) return nullptr;
    if (misplaced.contains(name)) return kMisplaced;
    if (unsharp.contains(name)) return kBlurred;
    return elsewhere.contains(name) ? kElsewhere : kAlone;
  };
  std::vector<Missing> out;
  for (std::size_t i = 0; i < names.size(); ++i) {
    const char* const cause = why(names[i]);
    if (cause == nullptr) continue;
    std::size_t last = i;
    while (last + 1 < names.size() && why(names[last + 1]) == cause) ++last;
    const std::string between = i > 0 && last + 1 < names.size()
                                    ? fmt::format("take some between photographs {} and {}", i, last + 2)
                                    : "take some between them and the others";
    const bool one = i == last;
    const char *were = one ? "was" : "were", *are = one ? "is" : "are", *them = one ? "it" : "them",
               *s = one ? "s" : "";
    out.push_back(
        {i, last,
         fmt::format(fmt::runtime(cause), fmt::arg("range", range_text(names, i, last)), fmt::arg("were", were),
                     fmt::arg("are", are), fmt::arg("them", them), fmt::arg("s", s), fmt::arg("between", between))});
    i = last;
  }
  return out;
}

namespace {

constexpr std::size_t kLongestRun = 3;
constexpr double kJump = 5;              // times the way between neighbours
constexpr std::size_t kNeighbours = 30;  // points that the photographs around it share, at least
constexpr double kFew = 0.05;            // of these, or else of its own, shared with it
constexpr double kLeft = 0.6;            // of its points, in an image that fits them; blurred ones keep 0.7
constexpr double kWeak = 0.5;            // of the usual number of points, seen in an image that is hardly held

class Shares {
 public:
  explicit Shares(const std::vector<const ColmapImage*>& images) {
    for (const ColmapImage* image : images) points_.emplace_back(image->points.begin(), image->points.end());
  }
  std::size_t count(std::size_t image) const { return points_[image].size(); }
  std::size_t of(std::size_t a, std::size_t b) const {
    const auto& [few, many] =
        points_[a].size() < points_[b].size() ? std::tie(points_[a], points_[b]) : std::tie(points_[b], points_[a]);
    return static_cast<std::size_t>(
        std::count_if(few.begin(), few.end(), [&many = many](std::int64_t id) { return many.contains(id); }));
  }

 private:
  std::vector<std::unordered_set<std::int64_t>> points_;
};

}  // namespace

std::vector<std::string> misplaced_images(const ColmapModel& model, const std::vector<std::string>& names) {
  std::map<std::string, const ColmapImage*> by_name;
  for (const ColmapImage& image : model.images) by_name[image.name] = &image;
  std::vector<const ColmapImage*> images;  // with a pose, in the order in which they were taken
  for (const std::string& name : names)
    if (const auto found = by_name.find(name); found != by_name.end()) images.push_back(found->second);
  std::vector<std::string> out;
  if (images.size() < 2 * kLongestRun) return out;
  const auto apart = [&](std::size_t a, std::size_t b) {
    return length(images[a]->world_from_camera.t - images[b]->world_from_camera.t);
  };
  const Shares shares(images);
  std::vector<double> steps, seen;
  for (std::size_t i = 0; i < images.size(); ++i) {
    if (i > 0) steps.push_back(apart(i - 1, i));
    seen.push_back(static_cast<double>(shares.count(i)));
  }
  const double usual_step = median_of(steps), usual_count = median_of(seen);
  for (std::size_t first = 1; first + 1 < images.size(); ++first) {
    for (std::size_t run = 1; run <= kLongestRun && first + run < images.size(); ++run) {
      const std::size_t before = first - 1, last = first + run - 1, after = first + run;
      const double least = kJump * std::max(usual_step, apart(before, after) / static_cast<double>(run + 1));
      if (apart(before, first) < least || apart(last, after) < least) continue;
      const auto shares_few = [&](std::size_t of) {
        return static_cast<double>(shares.of(before, first)) < kFew * static_cast<double>(of) &&
               static_cast<double>(shares.of(last, after)) < kFew * static_cast<double>(of);
      };
      const std::size_t around = shares.of(before, after);
      const bool denied = around >= kNeighbours && shares_few(around);
      const double most = *std::max_element(seen.begin() + static_cast<std::ptrdiff_t>(first),
                                            seen.begin() + static_cast<std::ptrdiff_t>(after));
      const bool weak = most < kWeak * usual_count && shares_few(static_cast<std::size_t>(most));
      if (!denied && !weak) continue;
      for (std::size_t i = first; i <= last; ++i) out.push_back(images[i]->name);
      first = last;
      break;
    }
  }
  std::sort(out.begin(), out.end());
  return out;
}

std::vector<std::string> torn_images(const ColmapModel& model, const ColmapModel& kept) {
  std::map<std::string, std::size_t> left;
  for (const ColmapImage& image : kept.images) left[image.name] = image.points.size();
  std::vector<std::string> out;
  for (const ColmapImage& image : model.images)
    if (static_cast<double>(left[image.name]) < kLeft * static_cast<double>(image.points.size()))
      out.push_back(image.name);
  std::sort(out.begin(), out.end());
  return out;
}

namespace {

struct Folders {
  fs::path images, logs, work, model;
};

// All that the steps depend on.
std::string identity_of(const CaptureSource& source, const PrepareOptions& options) {
  std::string out = fmt::format("{}\nframes {}\n", source.path, options.frames);
  const auto add = [&](const std::string& name, const std::string& path) {
    std::error_code unknown;
    out += fmt::format("{} {} {}\n", name, fs::file_size(path, unknown),
                       fs::last_write_time(path, unknown).time_since_epoch().count());
  };
  if (options.fisheye) out += "fisheye\n";
  if (source.video) add("video", source.path);
  for (const Photograph& one : source.photographs) add(one.name, one.path);
  return out;
}

// Lists of COLMAP part names by blanks and begin a comment with '#'.
std::string plain_name(std::string name) {
  for (std::size_t i = 0; i < name.size();) {
    const std::size_t length = utf8_length(name, i);
    if (length < 1 || (length == 1 && (static_cast<unsigned char>(name[i]) <= ' ' || name[i] == '#' || name[i] == 127)))
      name[i] = '_';
    i += std::max<std::size_t>(length, 1);
  }
  return name;
}

// Two folders stay two, because each is a camera.
std::vector<std::string> plain_names(const std::vector<Photograph>& photographs) {
  std::set<fs::path> taken;
  const auto free_name = [&](const fs::path& wanted) {
    fs::path name = wanted;
    for (int k = 2; !taken.insert(name).second; ++k)
      name = wanted.parent_path() / fmt::format("{}_{}{}", wanted.stem().string(), k, wanted.extension().string());
    return name;
  };
  std::map<fs::path, fs::path> folders{{"", ""}};
  std::vector<std::string> out;
  for (const Photograph& one : photographs) {
    const fs::path name(one.name), folder = name.parent_path();
    if (!folders.contains(folder)) folders[folder] = free_name(plain_name(folder.string()));
    out.push_back(free_name(folders[folder] / plain_name(name.filename().string())).string());
  }
  return out;
}

void copy_whole(const std::string& from, const std::string& to) {
  AtomicFile file(to);
  const std::string bytes = read_text_file(from, std::size_t{1} << 32);
  file.append(std::as_bytes(std::span<const char>(bytes)));
  file.commit();
}

std::string cut_text(const VideoFrames& cut) {
  return fmt::format(
      "{} frames of {:.1f} s, the sharpest of each of {} intervals; {} intervals were left out because nothing had "
      "moved, {} because they were blurred",
      cut.names.size(), cut.seconds, cut.intervals, cut.still, cut.blurred);
}

// Names of the images that are brought into `folders.images`, in the order in which they were taken.
std::vector<std::string> bring_images(const CaptureSource& source, const PrepareOptions& options,
                                      const Folders& folders, PrepareState& state, const Programs& programs,
                                      const CaptureProgress& progress) {
  if (source.video) {
    if (state.done("frames") == nullptr) {
      const std::string cut_folder = (folders.work / "frames").string();
      const VideoFrames cut =
          cut_video({source.path, cut_folder, folders.logs.string(), options.frames}, programs, progress);
      fs::remove_all(folders.images);
      fs::rename(cut_folder, folders.images);
      state.mark("frames", join(cut.names, "\n"));
      state.mark("cut", cut_text(cut));
    }
    return state.lines("frames");
  }
  std::vector<std::string> names = plain_names(source.photographs);
  if (state.done("images") != nullptr) return names;
  for (std::size_t i = 0; i < names.size(); ++i) {
    progress({"copying", "photographs"}, static_cast<double>(i), static_cast<double>(names.size()));
    const fs::path to = folders.images / names[i];
    create_folders(to.parent_path().string());
    const std::string& from = source.photographs[i].path;
    if (fs::exists(to)) continue;
    if (fs::path(from).extension() == to.extension()) {
      copy_whole(from, to.string());
    } else {
      const Image<std::uint8_t> photograph = read_rgb(from);
      write_png_rgb(to.string(), photograph.width_px, photograph.height_px, photograph.pixels);
    }
  }
  state.mark("images");
  return names;
}

// Of the images without a pose, those that are much less sharp than those with one.
std::vector<std::string> blurred_among_missing(const std::vector<std::string>& names, const FoundModel& model,
                                               const fs::path& images) {
  if (model.images.size() == names.size()) return {};
  std::vector<double> sharp(names.size());
  parallel_for(static_cast<std::int64_t>(names.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    try {
      sharp[i] = sharpness_of((images / names[i]).string());
    } catch (const Error&) {
      sharp[i] = 0;  // what cannot be decoded has no sharpness
    }
  });
  const auto has_pose = [&](const std::string& name) {
    return std::binary_search(model.images.begin(), model.images.end(), name);
  };
  std::vector<double> of_posed;
  for (std::size_t i = 0; i < names.size(); ++i)
    if (has_pose(names[i])) of_posed.push_back(sharp[i]);
  const double least = kBlurredShare * median_of(of_posed);
  std::vector<std::string> out;
  for (std::size_t i = 0; i < names.size(); ++i)
    if (!has_pose(names[i]) && sharp[i] < least) out.push_back(names[i]);
  return out;
}

// The model appears whole or not at all; one of fewer attempts makes room for it.
void publish(const FoundModel& model, const Folders& folders) {
  const fs::path fresh = folders.work / "model";
  fs::remove_all(fresh);
  create_folders(fresh.string());
  for (const char* name : {"cameras.bin", "images.bin", "points3D.bin"})
    copy_whole((fs::path(model.folder) / name).string(), (fresh / name).string());
  create_folders(folders.model.parent_path().string());
  const fs::path old = folders.work / "model_before";
  fs::remove_all(old);
  std::error_code failed;
  if (fs::exists(folders.model)) fs::rename(folders.model, old, failed);
  if (!failed) fs::rename(fresh, folders.model, failed);
  if (failed) throw write_error("rename", folders.model.string(), failed.value());
  sync_folder_of(folders.model.string());
}

}  // namespace

PrepareReport prepare_scene(const PrepareOptions& options, const Programs& programs, const CaptureProgress& progress) {
  PrepareReport report;
  const CaptureSource source = look_at_source(options.source);
  check_photographs(source, report.findings);
  report.findings.throw_if_errors(ErrorKind::data, "the photographs cannot be one scene:");
  for (const char* name : {"colmap", "ffmpeg", "ffprobe"})
    if (source.video || std::string_view(name) == "colmap") (void)program_file(programs, name);
  const std::string scene = fs::absolute(options.out).lexically_normal().string();
  if (!source.video && (scene + "/").starts_with(source.path + "/"))
    throw Error(ErrorKind::cannot_create, "capture.scene.inside",
                "the scene '" + scene + "' would lie in the folder of the photographs, which is never written to",
                "name a folder next to it with --out");
  const PrepareFolder folder(scene);
  const Folders folders{fs::path(scene) / "images", folder.logs(), folder.work(), fs::path(scene) / "sparse" / "0"};
  PrepareState state = folder.steps(identity_of(source, options));
  if (const std::string* refined = state.done("refined");
      refined != nullptr && state.done("published") == nullptr && fs::exists(folders.model))
    state.mark("published", std::string(*refined));

  const std::vector<std::string> names = bring_images(source, options, folders, state, programs, progress);
  if (const std::string* cut = state.done("cut")) report.cut = *cut;
  report.photographs = names.size();
  const ImageSize size = image_size((folders.images / names.front()).string());
  report.width_px = size.width_px;
  report.height_px = size.height_px;
  const ColmapSteps colmap(programs, progress, folders.images.string(), folders.work.string(), folders.logs.string(),
                           options.threads > 0 ? options.threads : hardware_threads());
  const Reconstruction found = reconstruct({.names = names,
                                            .in_order = source.video,
                                            .camera_per_folder = source.camera_per_folder,
                                            .work = folders.work.string(),
                                            .fisheye = options.fisheye,
                                            .attempts = options.attempts,
                                            .note = options.note},
                                           colmap, state);
  report.registered = found.best.images.size();
  report.points = found.best.points;
  report.error_px = found.best.error_px;
  report.attempts = found.attempts;
  report.missing = missing_images(names, found, blurred_among_missing(names, found.best, folders.images));
  const std::string refined = *state.done("refined"), *const published = state.done("published");
  if (!fs::exists(folders.model) || published == nullptr || *published != refined) {
    publish(found.best, folders);
    state.mark("published", refined);
  }
  for (const fs::directory_entry& entry : sorted_folder(folders.work.string()))
    if (entry.path().extension() == ".db") fs::remove(entry.path());
  return report;
}

}  // namespace semfield
