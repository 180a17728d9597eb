// Panoramas as perspective views, which COLMAP can find the poses of.
#pragma once

#include <string>
#include <vector>

#include "loading/capture/programs.h"

namespace semfield {

/// Equirectangular images, twice as wide as high, and where their views go.
struct PanoramaCut {
  std::vector<std::string> names;  ///< in `from`, in the order in which they were taken
  std::string from, to;            ///< folders; `to` is made anew
  std::string logs;                ///< folder
};

/// Eight views of 90 degrees around the horizon of each panorama, an eighth turn apart, as high as half of it: every
/// point of the horizon is in two. Returns their names, those of a panorama in order. Throws Error(data) for images of
/// another shape, naming one, and as run_program() does.
std::vector<std::string> cut_panoramas(const PanoramaCut& cut, const Programs& programs,
                                       const CaptureProgress& progress);

}  // namespace semfield
