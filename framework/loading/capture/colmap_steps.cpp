#include "loading/capture/colmap_steps.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <set>

#include "core/text.h"
#include "loading/colmap_model.h"
#include "system/files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace fs = std::filesystem;

std::vector<Pair> all_pairs(std::size_t count) {
  std::vector<Pair> out;
  for (std::size_t apart = 1; apart < count; ++apart) {
    for (std::size_t i = 0; i + apart < count; ++i) out.emplace_back(i, i + apart);
  }
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
const std::vector<std::string> kStrict{"--Mapper.min_num_matches",           "30",
                                       "--Mapper.abs_pose_min_num_inliers",  "60",
                                       "--Mapper.abs_pose_min_inlier_ratio", "0.4"};

std::string ColmapSteps::database(const FeatureSettings& settings) const {
  return (fs::path(work_) / (settings.name + ".db")).string();
}

std::string ColmapSteps::log(const std::string& name) const { return (fs::path(logs_) / (name + ".txt")).string(); }

void ColmapSteps::extract(const FeatureSettings& s, bool camera_per_folder, std::size_t images) const {
  const std::string file = log("features_" + s.name);
  for (const char* end : {"", "-wal", "-shm", "-journal"}) fs::remove(database(s) + end);
  const std::string camera =
      camera_per_folder ? "--ImageReader.single_camera_per_folder" : "--ImageReader.single_camera";
  run_program(programs_, "colmap",
              {.words = {"feature_extractor",
                         "--database_path",
                         database(s),
                         "--image_path",
                         images_,
                         "--ImageReader.camera_model",
                         s.lens,
                         "--ImageReader.default_focal_length_factor",
                         fmt::format("{:g}", s.focal),
                         camera,
                         "1",
                         "--SiftExtraction.use_gpu",
                         "0",
                         "--SiftExtraction.num_threads",
                         std::to_string(threads_),
                         "--SiftExtraction.max_image_size",
                         std::to_string(s.size_px),
                         "--SiftExtraction.max_num_features",
                         std::to_string(s.features),
                         "--SiftExtraction.max_num_orientations",
                         std::to_string(s.orientations),
                         "--SiftExtraction.peak_threshold",
                         std::to_string(s.contrast)},
               .log = file,
               .tick = [&] {
                 progress_({"finding features of", "photographs"},
                           last_number_after(log_text(file), "Processed file ["), static_cast<double>(images));
               }});
}

// In parts: each is in the database when its call has ended, and its end is known.
void ColmapSteps::match(const FeatureSettings& s, const std::vector<std::string>& names,
                        const std::vector<Pair>& pairs) const {
  constexpr std::size_t kPart = 100;
  const auto total = static_cast<double>(pairs.size());
  const std::string list = (fs::path(work_) / "pairs.txt").string();
  for (std::size_t first = 0; first < pairs.size(); first += kPart) {
    std::string text;
    for (std::size_t i = first; i < std::min(pairs.size(), first + kPart); ++i)
      text += names[pairs[i].first] + " " + names[pairs[i].second] + "\n";
    write_file_atomic(list, text);
    progress_({"matching", "pairs"}, static_cast<double>(first), total);
    run_program(
        programs_, "colmap",
        {.words = {"matches_importer", "--database_path", database(s), "--match_list_path", list, "--match_type",
                   "pairs", "--SiftMatching.use_gpu", "0", "--SiftMatching.num_threads", std::to_string(threads_)},
         .log = log("matches_" + s.name),
         .tick = [&] {
           progress_({"matching", "pairs"}, static_cast<double>(first), total);
         }});
  }
}

std::vector<std::string> ColmapSteps::map(const FeatureSettings& s, bool relaxed, std::size_t images) const {
  const std::string name = s.name + (relaxed ? "_relaxed" : ""), file = log("models_" + name);
  const fs::path folder = fs::path(work_) / ("models_" + name);
  fs::remove_all(folder);
  create_folders(folder.string());
  std::vector<std::string> words{"mapper", "--database_path", database(s), "--image_path", images_, "--output_path",
                                 folder.string(), "--Mapper.num_threads", std::to_string(threads_),
                                 "--Mapper.max_num_models", "10", "--Mapper.min_model_size",
                                 std::to_string(std::clamp<std::size_t>(images / 3, 3, 10)),
                                 // All is adjusted at the end once more, so less often on the way.
                                 "--Mapper.ba_global_max_num_iterations", "20", "--Mapper.ba_global_images_ratio",
                                 "1.4", "--Mapper.ba_global_points_ratio", "1.4"};
  if (!relaxed) {
    words.insert(words.end(), kStrict.begin(), kStrict.end());
  } else {
    words.insert(words.end(), {"--Mapper.init_min_num_inliers", "50", "--Mapper.init_min_tri_angle", "8",
                               "--Mapper.abs_pose_min_num_inliers", "15", "--Mapper.abs_pose_min_inlier_ratio", "0.15",
                               "--Mapper.min_num_matches", "10"});
  }
  try {
    run_program(programs_, "colmap", {.words = words, .log = file, .tick = [&] {
                                        const std::string text = log_text(file);
                                        const std::size_t at = text.rfind("Registering image #");
                                        progress_(
                                            {"finding poses of", "photographs"},
                                            at == std::string::npos ? 0 : last_number_after(text.substr(at), " ("),
                                            static_cast<double>(images));
                                      }});
  } catch (const Error& e) {
    // So ends a mapper that finds no two images to begin with.
    if (e.kind() != ErrorKind::failure || log_text(file).find("sparse model") == std::string::npos) throw;
  }
  std::vector<std::string> out;
  for (const fs::directory_entry& entry : sorted_folder(folder.string())) {
    if (fs::exists(entry.path() / "images.bin")) out.push_back(entry.path().string());
  }
  return out;
}

// A program that makes one model of another.
void ColmapSteps::model_step(const std::string& name, const std::string& from, const std::string& to,
                             std::vector<std::string> words) const {
  fs::remove_all(to);
  create_folders(to);
  words.insert(words.end(), {"--input_path", from, "--output_path", to});
  progress_({"adjusting all poses,", "passes"}, 0, 1);
  run_program(programs_, "colmap", {.words = std::move(words), .log = log(name), .tick = [&] {
                                      progress_({"adjusting all poses,", "passes"}, 0, 1);
                                    }});
}

void ColmapSteps::remove(const std::string& from, const std::vector<std::string>& names, const std::string& to) const {
  std::string text;
  for (const std::string& name : names) text += name + "\n";
  const std::string list = (fs::path(work_) / "removed.txt").string();
  write_file_atomic(list, text);
  model_step("removed", from, to, {"image_deleter", "--image_names_path", list});
}

void ColmapSteps::filter(const std::string& from, double most_px, const std::string& to) const {
  model_step("filtered", from, to, {"point_filtering", "--max_reproj_error", fmt::format("{:g}", most_px)});
}

void ColmapSteps::place(const FeatureSettings& settings, const std::string& from, const std::string& to) const {
  std::vector<std::string> words{"image_registrator", "--database_path", database(settings)};
  words.insert(words.end(), kStrict.begin(), kStrict.end());
  model_step("placed", from, to, std::move(words));
}

void ColmapSteps::free_lenses(const std::string& from, const std::string& to) const {
  fs::remove_all(to);
  create_folders(to);
  Diagnostics unread;
  write_file_atomic((fs::path(to) / "cameras.bin").string(),
                    colmap_cameras_file(read_colmap_model(from, unread).cameras));
  for (const char* name : {"images.bin", "points3D.bin"}) fs::copy_file(fs::path(from) / name, fs::path(to) / name);
}

void ColmapSteps::adjust(const std::string& from, const std::string& to) const {
  model_step("adjusted", from, to, {"bundle_adjuster"});
}

}  // namespace semfield
