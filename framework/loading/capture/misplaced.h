// Images that structure from motion took for a place that looks the same.
#pragma once

#include <string>
#include <vector>

#include "loading/colmap_model.h"

namespace semfield {

/// Names of images of a model, sorted, that stand where the photographs before and after them deny it: a run of at most
/// three of `names` jumps away and back, by five times the step between its two neighbours and the usual step, and it
/// shares hardly a point with them, while they share many with each other or it sees less than half of the usual number
/// of points. `names` is the order in which all images were taken; an order that is none gives no such neighbours.
std::vector<std::string> misplaced_images(const ColmapModel& model, const std::vector<std::string>& names);
/// Names of images, sorted, that see in `kept`, a part of `model`, less than 60 % of the points that they see in
/// `model`: their place hardly fits what they show.
std::vector<std::string> torn_images(const ColmapModel& model, const ColmapModel& kept);

}  // namespace semfield
