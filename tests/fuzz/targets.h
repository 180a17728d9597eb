// The functions that the fuzzers call and that the replay test calls with kept inputs: each takes any bytes as a file
// of one kind. A reader may refuse them with an Error of a sentence and must do nothing else: no other exception, no
// Error(internal), no crash, no access outside an array, no allocation that the bytes do not justify.
#pragma once

#include <span>
#include <string_view>

namespace semfield::fuzz {

struct Target {
  std::string_view name;
  /// Throws std::logic_error for a broken promise, and lets pass what a reader should not have thrown.
  void (*run)(std::string_view bytes);
};

/// By folder of the corpus.
std::span<const Target> targets();
/// Null for a name that is none.
const Target* find_target(std::string_view name);

// config_targets.cpp
void fuzz_config(std::string_view bytes);
void fuzz_sweep(std::string_view bytes);
// scene_targets.cpp
void fuzz_poses(std::string_view bytes);
void fuzz_cameras(std::string_view bytes);
void fuzz_transforms(std::string_view bytes);
void fuzz_llff(std::string_view bytes);
void fuzz_replica(std::string_view bytes);
void fuzz_scannet(std::string_view bytes);
void fuzz_colmap_binary(std::string_view bytes);
void fuzz_colmap_text(std::string_view bytes);
void fuzz_obj(std::string_view bytes);
void fuzz_packed(std::string_view bytes);
void fuzz_png(std::string_view bytes);
// class_targets.cpp
void fuzz_classes(std::string_view bytes);
void fuzz_class_rules(std::string_view bytes);
// label_targets.cpp
void fuzz_labelme(std::string_view bytes);
void fuzz_coco(std::string_view bytes);
void fuzz_clicks(std::string_view bytes);
void fuzz_label_event(std::string_view bytes);
void fuzz_click_log(std::string_view bytes);
void fuzz_label_image(std::string_view bytes);
void fuzz_npy(std::string_view bytes);
void fuzz_npz(std::string_view bytes);
// run_targets.cpp
void fuzz_checkpoint(std::string_view bytes);
void fuzz_metrics(std::string_view bytes);
// page_targets.cpp
void fuzz_page(std::string_view bytes);
void fuzz_http(std::string_view bytes);

}  // namespace semfield::fuzz
