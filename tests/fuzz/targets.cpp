#include "tests/fuzz/targets.h"

#include <algorithm>

namespace semfield::fuzz {

std::span<const Target> targets() {
  static constexpr Target kTargets[] = {
      {"config", fuzz_config},
      {"sweep", fuzz_sweep},
      {"poses", fuzz_poses},
      {"cameras", fuzz_cameras},
      {"transforms", fuzz_transforms},
      {"llff", fuzz_llff},
      {"replica", fuzz_replica},
      {"scannet", fuzz_scannet},
      {"colmap_binary", fuzz_colmap_binary},
      {"colmap_text", fuzz_colmap_text},
      {"obj", fuzz_obj},
      {"packed", fuzz_packed},
      {"png", fuzz_png},
      {"classes", fuzz_classes},
      {"class_rules", fuzz_class_rules},
      {"labelme", fuzz_labelme},
      {"coco", fuzz_coco},
      {"clicks", fuzz_clicks},
      {"label_event", fuzz_label_event},
      {"click_log", fuzz_click_log},
      {"label_image", fuzz_label_image},
      {"npy", fuzz_npy},
      {"npz", fuzz_npz},
      {"checkpoint", fuzz_checkpoint},
      {"metrics", fuzz_metrics},
      {"http", fuzz_http},
      {"page", fuzz_page},
  };
  return kTargets;
}

const Target* find_target(std::string_view name) {
  const auto all = targets();
  const auto found = std::find_if(all.begin(), all.end(), [&](const Target& t) { return t.name == name; });
  return found == all.end() ? nullptr : &*found;
}

}  // namespace semfield::fuzz
