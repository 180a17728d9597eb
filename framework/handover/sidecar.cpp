#include "handover/sidecar.h"

#include <filesystem>
#include <nlohmann/json.hpp>

namespace semfield {

std::string sidecar_json(const Sidecar& sidecar) {
  using Json = nlohmann::ordered_json;
  Json world{{"unit", sidecar.metric ? "m" : "scene"},
             {"axes", "those of the input"},
             {"pose_scale", sidecar.convention.pose_scale},
             {"poses_inverted", sidecar.convention.invert_poses},
             {"camera_axes_flipped", sidecar.convention.flip_camera_axes}};
  if (sidecar.up) world["up"] = {sidecar.up->x, sidecar.up->y, sidecar.up->z};
  Json out{{"format", "semfield-handover-1"},
           {"run", sidecar.run},
           {"scene", sidecar.scene},
           {"step", sidecar.step},
           {"world", world},
           {"files", Json::array()}};
  for (const HandedFile& file : sidecar.files) {
    Json& row = out["files"].emplace_back();
    row = {{"file", std::filesystem::path(file.path).filename().string()},
           {"holds", file.holds},
           {"offset", {file.offset.x, file.offset.y, file.offset.z}}};
    if (file.edge) row["edge"] = *file.edge;
  }
  if (sidecar.classes != nullptr) {
    out["classes"] = Json::array();
    for (const ClassEntry& entry : sidecar.classes->entries())
      out["classes"].push_back(
          {{"id", entry.id}, {"name", entry.name}, {"color", entry.color}, {"ignore", entry.ignore}});
  }
  for (const auto& [id, name] : sidecar.objects) out["objects"].push_back({{"id", id}, {"name", name}});
  return out.dump(1, ' ', false, Json::error_handler_t::replace) + "\n";
}

}  // namespace semfield
