// The section `objects`: how segments of images become objects. Declared here, where sections are read; used in
// objects/.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"

namespace semfield {

struct ObjectsParams {
  std::int64_t steps = 1500;
  std::int64_t views = 8;
  std::int64_t view_points = 256;
  double learning_rate = 1e-2;
  std::int64_t frequencies = 9;
  std::int64_t hidden_width = 64;
  std::int64_t hidden_layers = 2;
  std::int64_t rays = 1'500'000;
  std::int64_t points = 200'000;
  double reach = 0.25;
  std::int64_t neighbours = 4;
  double agree = 0.5;
  std::int64_t least_views = 1;
  std::int64_t least_points = 20;
  std::vector<std::string> stuff{"wall", "floor", "ceiling"};
  std::uint32_t seed = 1;
};
void describe(ParamVisitor& visit, ObjectsParams& params);

/// Shares from 0 to 1; all of it happens in each image for itself.
struct SegmentDamage {
  bool shuffle = false;        ///< segments get new numbers in random order
  double split = 0;            ///< segments cut in two along a random line through their middle
  double merge = 0;            ///< segments joined with a random neighbour
  double missing = 0;          ///< segments that are not there
  std::int64_t border_px = 0;  ///< borders are moved by up to so many pixels, in patches

  bool any() const { return shuffle || split > 0 || merge > 0 || missing > 0 || border_px > 0; }
};
void describe(ParamVisitor& visit, SegmentDamage& damage);

}  // namespace semfield
