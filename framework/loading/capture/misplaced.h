// Images that structure from motion took for a place that looks the same.
#pragma once

#include <string>
#include <vector>

#include "loading/colmap_model.h"

namespace semfield {

/// Names of images of a model, sorted, that stand where the photographs before and after them deny it: a run of at most
/// three of `names` jumps away and back, by five times as far as its two neighbours are apart and as photographs that
/// follow each other usually are, and it shares hardly a point with them, while they share many with each other.
/// `names` is the order in which all images were taken; an order that is none gives no such neighbours.
std::vector<std::string> misplaced_images(const ColmapModel& model, const std::vector<std::string>& names);

}  // namespace semfield
