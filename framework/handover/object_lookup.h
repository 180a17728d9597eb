// Objects that `semfield objects` found in a run, read back from its files, and which of them a point belongs to.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"

namespace semfield {

class ObjectLookup {
 public:
  /// From objects.json and objects.ply of a folder; nothing where there is neither. Throws Error(data) naming the file
  /// for one that the other does not fit, or that cannot be read.
  static std::optional<ObjectLookup> read(const std::string& folder);

  /// Names of classes by the objects' ids.
  const std::map<std::int32_t, std::string>& names() const { return names_; }
  std::int64_t step() const { return step_; }  ///< of the checkpoint that they were found in

  /// The object of each point [N]: that of the nearest point of the table's surface within kReach of its cells, 0 where
  /// there is none.
  std::vector<std::int32_t> ids_of(std::span<const Vec3d> points) const;
  static constexpr double kReach = 4;

 private:
  std::map<std::int32_t, std::string> names_;
  std::int64_t step_ = 0;
  double reach_ = 0;
  std::vector<Vec3d> places_;
  std::vector<std::int32_t> ids_;
};

}  // namespace semfield
