// A sweep over a tiny room, and what its cells leave, for tests that run it through the program.
#pragma once

#include <chrono>
#include <map>
#include <sstream>
#include <thread>

#include "tests/scene/tiny_scene.h"

namespace semfield::testing_sweep {

/// Writes a room of five frames, three of which train, its base.yaml and tiny.yaml: two variants that train and one
/// that fuses. `more` ends the sweep file. Returns its path.
inline std::string write_sweep(const std::string& folder, int steps, const std::string& more = "") {
  std::filesystem::create_directories(folder + "/room");
  testing_room::write_replica(folder + "/room", 5);
  const std::string base = "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                           "/configs/experiments/editions/hash_field.yaml\n" +
                           "scene: {type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1}\n"
                           "train: {steps: " +
                           std::to_string(steps) + ", rays: 64}\n";
  write_file_atomic(folder + "/base.yaml", std::string_view(base));
  const std::string sweep =
      "base: base.yaml\nsplit: train\nscenes: {room: {pack: true}}\nmetrics: [miou_present, given_miou_present]\n"
      "variants:\n"
      "  clean: {x: 0}\n"
      "  noisy: {x: 50, set: {scene.labels.degrade: [{type: pixel_noise, ratio: 0.5}]}}\n"
      "  fused: {fuse: {method: bayesian, field: noisy}, set: {scene.labels.degrade: [{type: pixel_noise, ratio: "
      "0.5}]}}\n" +
      more;
  write_file_atomic(folder + "/tiny.yaml", std::string_view(sweep));
  return folder + "/tiny.yaml";
}

/// Text of cells/ID/NAME by ID, for the cells that have it.
inline std::map<std::string, std::string> files_of_cells(const std::string& out, const std::string& name) {
  std::map<std::string, std::string> found;
  std::error_code none;
  for (const auto& cell : std::filesystem::directory_iterator(out + "/cells", none)) {
    const std::filesystem::path file = cell.path() / name;
    if (std::filesystem::exists(file)) found[cell.path().filename().string()] = read_text_file(file.string());
  }
  return found;
}

/// results.csv of a sweep without what is measured of processes, which differs from run to run.
inline std::string results_without_times(const std::string& out) {
  std::istringstream lines(read_text_file(out + "/results.csv"));
  std::string kept;
  for (std::string line; std::getline(lines, line);) {
    const bool time = line.find(",train_s,") != std::string::npos || line.find(",processor_s,") != std::string::npos ||
                      line.find(",peak_mb,") != std::string::npos;
    if (!time) kept += line + "\n";
  }
  return kept;
}

/// Cells whose runs have taken a step.
inline std::vector<std::string> begun_cells(const std::string& out) {
  std::vector<std::string> ids;
  for (const auto& [id, rows] : files_of_cells(out, "run/metrics.jsonl")) {
    if (!rows.empty()) ids.push_back(id);
  }
  return ids;
}

template <class Condition>
bool wait_until(const Condition& condition) {
  for (int i = 0; i < 6000 && !condition(); ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  return condition();
}

}  // namespace semfield::testing_sweep
