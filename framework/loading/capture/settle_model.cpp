#include "loading/capture/settle_model.h"

#include <filesystem>

#include "loading/capture/misplaced.h"
#include "loading/colmap_model.h"

namespace semfield {

namespace {

constexpr double kRounds[] = {3, 2, 2};  // times the mean error
constexpr std::size_t kMostTorn = 3;     // of which one of the images may be torn; more are no outliers

ColmapModel settled_model(const std::string& folder) {
  Diagnostics known;  // said when the model was found
  return read_colmap_model(folder, known);
}

}  // namespace

std::vector<std::string> settle_model(const SettleTask& task, const ColmapSteps& colmap) {
  const auto at = [&](const char* name) { return (std::filesystem::path(task.work) / name).string(); };
  std::string current = task.model;
  const ColmapModel found = settled_model(current);
  colmap.filter(current, kRounds[0] * found.error_px, at("filtered"));
  const std::vector<std::string> torn = torn_images(found, settled_model(at("filtered")));
  if (!torn.empty() && kMostTorn * torn.size() <= found.images.size()) {
    colmap.remove(at("filtered"), torn, at("sound"));
    colmap.place(task.features, at("sound"), current = at("placed"));
  }
  const std::vector<std::string> misplaced = misplaced_images(settled_model(current), task.names);
  if (!misplaced.empty()) {
    colmap.remove(current, misplaced, at("kept"));
    current = at("kept");
  }
  colmap.free_lenses(current, at("refined"));
  for (const double times : kRounds) {
    const double most_px = times * settled_model(at("refined")).error_px;
    colmap.filter(at("refined"), most_px, at("filtered"));
    colmap.adjust(at("filtered"), at("adjusted"));
    colmap.filter(at("adjusted"), most_px, at("refined"));
  }
  return misplaced;
}

}  // namespace semfield
